//! The packages under evaluation, the services created from them, and the recordings that they process.

mod packages;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use sha2::{Digest, Sha256};
use support::binaries;
use support::daemon::Daemon;
use support::site::{image_config, image_shell};
use tempfile::TempDir;

use crate::place::{NetworkProfile, RobotHardware, RobotSandbox, RunCost};
use crate::robot::{NodeUnderTest, RobotPlan};
use crate::trace::Trace;
use crate::{deadline, pictures};

pub use packages::{
    ALL, DETECTOR, DISPARITY, EvalPackage, InputRecording, LASER_SLAM, LASER_SLAM_SIMULATED, Origin, PEOPLE,
};
use packages::{DATA, DRIVE, SIMULATED};

/// Directory of compiled packages in images.
const COMPILED: &str = "/opt/cloudroid/install/lib";
/// Directory of Debian's packages in images.
const PACKAGED: &str = "/usr/lib";
/// Maximum time to fetch some tens of megabytes.
const FETCHES: Duration = Duration::from_secs(600);
/// Maximum time to create one recording.
const CONVERTS: Duration = Duration::from_secs(300);
/// File that the converter writes.
const BAG: &str = "recording.bag";

/// Place where an example runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExecutionSite {
    Native,
    Outsourced,
}

/// Services, root file systems and recordings that are created once and shared by runs.
pub struct EvalFixtures<'a> {
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
        publish_once(self.daemon, example.name, || self.push(example))
    }

    fn push(&self, example: &EvalPackage) -> Result<()> {
        example.input.check_files()?;
        let mut push = vec!["push".to_owned()];
        match example.origin {
            Origin::Checkout => {
                let package = binaries::checkout().join("examples").join(example.name);
                if example.name == DETECTOR.name {
                    fetch_weights(&package)?;
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
        let is_drive = matches!(example.input, InputRecording::Drive | InputRecording::Simulated);
        Ok(RobotPlan {
            left_out: vec!["/ground_truth".to_owned()],
            besides: if is_drive { vec!["/odom".to_owned()] } else { Vec::new() },
            tells_pose: is_drive,
            timing: example.timing.map(str::to_owned),
            map: example.map.map(str::to_owned),
            most: example.requests,
            ..RobotPlan::new(node, self.recording(example.input)?, example.request, example.answer)
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
            InputRecording::Pictures => "pedestrians.messages",
            InputRecording::Stereo => "plant.messages",
        });
        if !path.exists() {
            let half = path.with_extension("half");
            match input {
                InputRecording::Drive => self.convert_rawlog(DRIVE, &half)?,
                InputRecording::Simulated => self.convert_rawlog(SIMULATED, &half)?,
                InputRecording::Pictures => pictures::write_video(&half)?,
                InputRecording::Stereo => pictures::write_stereo(&half)?,
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

/// Fetches the trained weights of the detector, unless this user has them.
fn fetch_weights(package: &Path) -> Result<()> {
    let script = package.join("fetch_weights");
    let mut child = Command::new(&script).stdout(Stdio::null()).spawn().context("fetch_weights")?;
    let status = deadline::wait_for_exit(&mut child, "fetch_weights", FETCHES)?;
    let how = "which takes them from the registry of npm";
    ensure!(
        status.success(),
        "the detector's weights could not be fetched ({status}): run {}, {how}",
        script.display()
    );
    Ok(())
}

/// Errors of pushes that have failed in this run of the evaluation, by the name of the service: a push takes minutes.
static FAILED: Mutex<BTreeMap<String, String>> = Mutex::new(BTreeMap::new());

/// Publishes a service by `push`, unless it has been published, or has failed, before.
pub fn publish_once(daemon: &Daemon, name: &str, push: impl FnOnce() -> Result<()>) -> Result<()> {
    let services = daemon.deployer().run_json(&["services"])?;
    if services.as_array().is_some_and(|all| all.iter().any(|service| service["name"] == name)) {
        return Ok(());
    }
    let failed = || FAILED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(why) = failed().get(name) {
        bail!("{why} (it failed before in this run and was not tried again)");
    }
    eprintln!("pushing {name}: the first time may take some minutes");
    push().inspect_err(|error| {
        failed().insert(name.to_owned(), format!("{error:#}"));
    })
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
