//! The packages that are evaluated, the services made of them, and the recordings that they are asked with.

mod packages;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use sha2::{Digest, Sha256};
use support::binaries;
use support::daemon::Daemon;
use support::site::{image_config, in_image};
use tempfile::TempDir;

use crate::robot::{Node, Pace, Plan};
use crate::stereo;
use crate::weights;
use crate::{attempts, deadline};

pub use packages::{
    ALL, DETECTOR, DISPARITY, Example, GRAPH_SLAM, Input, LASER_SLAM, LASER_SLAM_SIMULATED, Origin,
    PEOPLE,
};
use packages::{DATA, DRIVE, SIMULATED, VIDEO};

/// Where packages that were compiled are, in images.
const COMPILED: &str = "/opt/cloudroid/install/lib";
/// Where those of Debian are.
const PACKAGED: &str = "/usr/lib";
/// Seconds after which a request counts as not answered.
const GIVE_UP: f64 = 30.0;
/// For making one recording.
const CONVERTS: Duration = Duration::from_secs(300);
/// The file that the converter writes.
const BAG: &str = "recording.bag";

/// Where an example answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Where {
    /// On the robot.
    Native,
    /// In a servant, by the stub.
    Outsourced,
}

/// What runs need that is made once: services, root file systems and recordings.
pub struct Workshop<'a> {
    /// Where services are.
    pub daemon: &'a Daemon,
    place: &'a Path,
}

impl<'a> Workshop<'a> {
    /// With files below `place`.
    pub fn new(daemon: &'a Daemon, place: &'a Path) -> Self {
        Self { daemon, place }
    }

    /// Publishes an example, unless that was done before or has failed before.
    pub fn publishes(&self, example: &Example) -> Result<()> {
        let services = self.daemon.deployer().asks(&["services"])?;
        let known = services
            .as_array()
            .is_some_and(|all| all.iter().any(|service| service["name"] == example.name));
        if known {
            return Ok(());
        }
        attempts::once(example.name, || self.pushes(example))
    }

    fn pushes(&self, example: &Example) -> Result<()> {
        eprintln!(
            "pushing {}: the first time takes some minutes",
            example.name
        );
        example.input.is_there()?;
        let mut push = vec!["push".to_owned()];
        match example.origin {
            Origin::Checkout => {
                let package = binaries::checkout().join("examples").join(example.name);
                if example.name == DETECTOR.name {
                    weights::put_into(&package)?;
                }
                push.push(package.to_str().context("a path of UTF-8")?.to_owned());
            }
            Origin::Debian => {
                push.extend(["--apt", example.name].map(str::to_owned));
                // What it says is learned from a start of it.
                for parameter in example.parameters {
                    let words = parameter.trim_start_matches('_').replace(":=", "=");
                    push.extend(["--param".to_owned(), words]);
                }
            }
        }
        let limits = ["--node", example.executable, "--cpus", "1", "--memory"];
        push.extend(limits.into_iter().chain(["2G"]).map(str::to_owned));
        let push: Vec<&str> = push.iter().map(String::as_str).collect();
        self.daemon.deployer().types(&push)?.succeeded()?;
        Ok(())
    }

    /// A directory that goes with the value, for one run.
    pub fn directory(&self) -> Result<TempDir> {
        Ok(tempfile::Builder::new()
            .prefix("run-")
            .tempdir_in(self.place)?)
    }

    /// What the robot does, as one request after the other.
    pub fn plan(&self, example: &Example, at: Where, directory: &Path) -> Result<Plan> {
        let (name, installed) = match example.origin {
            Origin::Checkout => (example.name, COMPILED),
            Origin::Debian => (example.executable, PACKAGED),
        };
        let mut argv = vec![format!("__name:={name}")];
        argv.extend(example.parameters.iter().map(|word| (*word).to_owned()));
        let node = match at {
            Where::Native => {
                // As somebody who sourced its setup.sh.
                let config = image_config(self.daemon, example.name)?;
                let environment = config["config"]["Env"].as_array();
                let words = environment.into_iter().flatten();
                let mut words: Vec<String> = words
                    .filter_map(|one| one.as_str().map(str::to_owned))
                    // Where its Master is, the robot says.
                    .filter(|one| {
                        !one.starts_with("ROS_MASTER_URI=") && !one.starts_with("ROS_HOSTNAME=")
                    })
                    .collect();
                words.push(format!(
                    "{installed}/{}/{}",
                    example.name, example.executable
                ));
                words.extend(argv);
                Node::Native {
                    script: in_image(self.daemon, example.name, &directory.join("root"))?,
                    program: "/usr/bin/env".to_owned(),
                    argv: words,
                }
            }
            Where::Outsourced => Node::Stub {
                package: example.name.to_owned(),
                executable: example.executable.to_owned(),
                argv,
                settings: format!("service = \"{}\"\nlocal = \"none\"", example.name),
                environment: Vec::new(),
            },
        };
        Ok(Plan {
            server: String::new(),
            node,
            recording: self.recording(example.input)?,
            request: example.request.to_owned(),
            left_out: vec!["/ground_truth".to_owned()],
            besides: match example.input {
                Input::Drive | Input::Simulated => vec!["/odom".to_owned()],
                Input::Pictures | Input::Stereo => Vec::new(),
            },
            answer: example.answer.to_owned(),
            tells_pose: matches!(example.input, Input::Drive | Input::Simulated),
            timing: example.timing.map(str::to_owned),
            map: example.map.map(str::to_owned),
            pace: Pace::OneByOne,
            every: 1,
            most: example.requests,
            give_up: GIVE_UP,
            patience: 600.0,
            changes: Vec::new(),
        })
    }

    /// What it is asked with; made when it is first asked for.
    pub fn recording(&self, input: Input) -> Result<PathBuf> {
        let path = self.place.join(match input {
            Input::Drive => "drive.bag",
            Input::Simulated => "simulated.bag",
            Input::Pictures => "pedestrians.raw",
            Input::Stereo => "plant.stereo",
        });
        if !path.exists() {
            let half = path.with_extension("half");
            match input {
                Input::Drive => self.drive(DRIVE, &half)?,
                Input::Simulated => self.drive(SIMULATED, &half)?,
                Input::Pictures => pictures(&half)?,
                Input::Stereo => stereo::write(&half)?,
            }
            std::fs::rename(half, &path)?;
        }
        Ok(path)
    }

    /// A recording of MRPT as a rosbag file: the converter is a program of the example package.
    fn drive(&self, rawlog: &str, to: &Path) -> Result<()> {
        self.publishes(&LASER_SLAM)?;
        let directory = self.directory()?;
        let root = directory.path().join("root");
        let script = in_image(self.daemon, LASER_SLAM.name, &root)?;
        let program = format!("{COMPILED}/{}/rawlog_to_bag", LASER_SLAM.name);
        // What the converter reads and writes is on this machine.
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

/// What the packages are made of (SHA-256), so that runs of other ones are not taken for runs of these.
pub fn fingerprint() -> Result<String> {
    let mut files = Vec::new();
    let directories = ["examples", "eval/packages", "tests/packages/receipts_py"];
    let mut pending = directories
        .map(|name| binaries::checkout().join(name))
        .to_vec();
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
        // The weights are checked where they are fetched.
        if file.extension().is_none_or(|ending| ending != "onnx") {
            whole.update(file.to_string_lossy().as_bytes());
            whole.update(std::fs::read(&file)?);
        }
    }
    Ok(format!("{:x}", whole.finalize()))
}

/// Pedestrians of opencv-doc, 640x480, bgr8, one after the other.
fn pictures(to: &Path) -> Result<()> {
    let mut child = Command::new("ffmpeg")
        .args(["-v", "error", "-i", VIDEO, "-vf", "scale=640:480"])
        .args([
            "-frames:v",
            "60",
            "-pix_fmt",
            "bgr24",
            "-f",
            "rawvideo",
            "-y",
        ])
        .arg(to)
        .spawn()
        .context("ffmpeg")?;
    let status = deadline::ends(&mut child, "ffmpeg", CONVERTS)?;
    ensure!(status.success(), "ffmpeg ended with {status}");
    Ok(())
}
