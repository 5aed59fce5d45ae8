//! The packages under evaluation, the services created from them, and the recordings that they process.

mod packages;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use sha2::{Digest, Sha256};
use support::binaries;
use support::daemon::Daemon;
use support::site::{image_config, image_shell};
use tempfile::TempDir;

use crate::place::{NetworkProfile, RobotHardware, RobotSandbox, RunCost};
use crate::robot::{NodeUnderTest, RequestPacing, RobotPlan};
use crate::stereo;
use crate::trace::Trace;
use crate::weights;
use crate::{attempts, deadline};

pub use packages::{
    ALL, DETECTOR, DISPARITY, EvalPackage, GRAPH_SLAM, InputRecording, LASER_SLAM, LASER_SLAM_SIMULATED, Origin, PEOPLE,
};
use packages::{DATA, DRIVE, SIMULATED, VIDEO};

/// Directory of compiled packages in images.
const COMPILED: &str = "/opt/cloudroid/install/lib";
/// Directory of Debian's packages in images.
const PACKAGED: &str = "/usr/lib";
/// Seconds after which a request counts as unanswered.
const GIVE_UP: f64 = 30.0;
/// Maximum time to create one recording.
const CONVERTS: Duration = Duration::from_secs(300);
/// File that the converter writes.
const BAG: &str = "recording.bag";

/// Place where an example runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExecutionSite {
    /// On the robot.
    Native,
    /// In a servant, through the stub.
    Outsourced,
}

/// Services, root file systems and recordings that are created once and shared by runs.
pub struct EvalFixtures<'a> {
    /// The daemon that has the services.
    pub daemon: &'a Daemon,
    place: &'a Path,
}

impl<'a> EvalFixtures<'a> {
    /// Uses `place` for its files.
    pub fn new(daemon: &'a Daemon, place: &'a Path) -> Self {
        Self { daemon, place }
    }

    /// Publishes an example, unless it has been published, or has failed, before.
    pub fn publish(&self, example: &EvalPackage) -> Result<()> {
        let services = self.daemon.deployer().run_json(&["services"])?;
        let known = services.as_array().is_some_and(|all| all.iter().any(|service| service["name"] == example.name));
        if known {
            return Ok(());
        }
        attempts::try_once(example.name, || self.push(example))
    }

    fn push(&self, example: &EvalPackage) -> Result<()> {
        eprintln!("pushing {}: the first time takes some minutes", example.name);
        example.input.check_files()?;
        let mut push = vec!["push".to_owned()];
        match example.origin {
            Origin::Checkout => {
                let package = binaries::checkout().join("examples").join(example.name);
                if example.name == DETECTOR.name {
                    weights::install(&package)?;
                }
                push.push(package.to_str().context("a path of UTF-8")?.to_owned());
            }
            Origin::Debian => {
                push.extend(["--apt", example.name].map(str::to_owned));
                // The interface is determined by starting the node once.
                for parameter in example.parameters {
                    let words = parameter.trim_start_matches('_').replace(":=", "=");
                    push.extend(["--param".to_owned(), words]);
                }
            }
        }
        let limits = ["--node", example.executable, "--cpus", "1", "--memory"];
        push.extend(limits.into_iter().chain(["2G"]).map(str::to_owned));
        let push: Vec<&str> = push.iter().map(String::as_str).collect();
        self.daemon.deployer().run(&push)?.expect_success()?;
        Ok(())
    }

    /// Creates a temporary directory for one run.
    pub fn directory(&self) -> Result<TempDir> {
        Ok(tempfile::Builder::new().prefix("run-").tempdir_in(self.place)?)
    }

    /// Returns the plan of a robot that makes one request after the other.
    pub fn plan(&self, example: &EvalPackage, at: ExecutionSite, directory: &Path) -> Result<RobotPlan> {
        let (name, installed) = match example.origin {
            Origin::Checkout => (example.name, COMPILED),
            Origin::Debian => (example.executable, PACKAGED),
        };
        let mut argv = vec![format!("__name:={name}")];
        argv.extend(example.parameters.iter().map(|word| (*word).to_owned()));
        let node = match at {
            ExecutionSite::Native => {
                // The environment that setup.sh would set.
                let config = image_config(self.daemon, example.name)?;
                let environment = config["config"]["Env"].as_array();
                let words = environment.into_iter().flatten();
                let mut words: Vec<String> = words
                    .filter_map(|one| one.as_str().map(str::to_owned))
                    // The Master's address comes from the robot.
                    .filter(|one| !one.starts_with("ROS_MASTER_URI=") && !one.starts_with("ROS_HOSTNAME="))
                    .collect();
                words.push(format!("{installed}/{}/{}", example.name, example.executable));
                words.extend(argv);
                NodeUnderTest::Native {
                    script: image_shell(self.daemon, example.name, &directory.join("root"))?,
                    program: "/usr/bin/env".to_owned(),
                    argv: words,
                }
            }
            ExecutionSite::Outsourced => NodeUnderTest::Stub {
                package: example.name.to_owned(),
                executable: example.executable.to_owned(),
                argv,
                settings: format!("service = \"{}\"\nlocal = \"none\"", example.name),
                environment: Vec::new(),
            },
        };
        Ok(RobotPlan {
            server: String::new(),
            node,
            recording: self.recording(example.input)?,
            request: example.request.to_owned(),
            left_out: vec!["/ground_truth".to_owned()],
            besides: match example.input {
                InputRecording::Drive | InputRecording::Simulated => vec!["/odom".to_owned()],
                InputRecording::Pictures | InputRecording::Stereo => Vec::new(),
            },
            answer: example.answer.to_owned(),
            tells_pose: matches!(example.input, InputRecording::Drive | InputRecording::Simulated),
            timing: example.timing.map(str::to_owned),
            map: example.map.map(str::to_owned),
            pace: RequestPacing::OneByOne,
            every: 1,
            most: example.requests,
            give_up: GIVE_UP,
            patience: 600.0,
            changes: Vec::new(),
        })
    }

    /// Runs an example on a robot of this class over this network; `adapt` changes the robot's plan before.
    pub fn run(
        &self,
        example: &EvalPackage,
        at: ExecutionSite,
        (class, network): (RobotHardware, NetworkProfile),
        adapt: impl FnOnce(&mut RobotPlan),
    ) -> Result<(Trace, RunCost)> {
        self.publish(example)?;
        let directory = self.directory()?;
        let mut plan = self.plan(example, at, directory.path())?;
        adapt(&mut plan);
        let place = RobotSandbox::new(&self.daemon.address, class, network)?;
        place.run(&plan, directory.path())
    }

    /// Returns the file of a recording; it is created when it is first requested.
    pub fn recording(&self, input: InputRecording) -> Result<PathBuf> {
        let path = self.place.join(match input {
            InputRecording::Drive => "drive.bag",
            InputRecording::Simulated => "simulated.bag",
            InputRecording::Pictures => "pedestrians.raw",
            InputRecording::Stereo => "plant.stereo",
        });
        if !path.exists() {
            let half = path.with_extension("half");
            match input {
                InputRecording::Drive => self.convert_rawlog(DRIVE, &half)?,
                InputRecording::Simulated => self.convert_rawlog(SIMULATED, &half)?,
                InputRecording::Pictures => extract_pictures(&half)?,
                InputRecording::Stereo => stereo::write(&half)?,
            }
            std::fs::rename(half, &path)?;
        }
        Ok(path)
    }

    /// Converts a recording of MRPT to a rosbag file, with a program of the example package.
    fn convert_rawlog(&self, rawlog: &str, to: &Path) -> Result<()> {
        self.publish(&LASER_SLAM)?;
        let directory = self.directory()?;
        let root = directory.path().join("root");
        let script = image_shell(self.daemon, LASER_SLAM.name, &root)?;
        let program = format!("{COMPILED}/{}/rawlog_to_bag", LASER_SLAM.name);
        // The converter reads and writes files of this machine.
        let bind = format!(
            "mount --bind {} {root}/mnt && mount --bind {DATA} {root}/media && exec chroot",
            directory.path().display(),
            root = root.display()
        );
        let script = script.replace("exec chroot", &bind);
        let mut command = Command::new("unshare");
        command
            .args(["--mount", "sh", "-c", &script, "sh", &program])
            .args([format!("/mnt/{BAG}"), format!("/media/{rawlog}")]);
        let output = deadline::output(&mut command, CONVERTS)?;
        ensure!(
            output.status.success(),
            "the recording of MRPT could not be converted: {}",
            String::from_utf8_lossy(&output.stderr).trim()
        );
        std::fs::copy(directory.path().join(BAG), to)?;
        Ok(())
    }
}

/// Returns the SHA-256 of the packages' sources, so that results of other versions are not mistaken for results of
/// these.
pub fn fingerprint() -> Result<String> {
    let mut files = Vec::new();
    let directories = ["examples", "eval/packages", "tests/packages/receipts_py"];
    let mut pending = directories.map(|name| binaries::checkout().join(name)).to_vec();
    while let Some(directory) = pending.pop() {
        let entries = std::fs::read_dir(&directory);
        for entry in entries.with_context(|| directory.display().to_string())? {
            let path = entry?.path();
            if path.is_dir() {
                pending.push(path);
            } else if path.extension().is_none_or(|ending| ending != "md") {
                files.push(path);
            }
        }
    }
    files.sort();
    let mut whole = Sha256::new();
    for file in files {
        // The weights are checked when they are fetched.
        if file.extension().is_none_or(|ending| ending != "onnx") {
            whole.update(file.to_string_lossy().as_bytes());
            whole.update(std::fs::read(&file)?);
        }
    }
    Ok(format!("{:x}", whole.finalize()))
}

/// Extracts images of pedestrians from opencv-doc: 640x480, bgr8, concatenated.
fn extract_pictures(to: &Path) -> Result<()> {
    let mut child = Command::new("ffmpeg")
        .args(["-v", "error", "-i", VIDEO, "-vf", "scale=640:480"])
        .args(["-frames:v", "60", "-pix_fmt", "bgr24", "-f", "rawvideo", "-y"])
        .arg(to)
        .spawn()
        .context("ffmpeg")?;
    let status = deadline::wait_for_exit(&mut child, "ffmpeg", CONVERTS)?;
    ensure!(status.success(), "ffmpeg ended with {status}");
    Ok(())
}
