//! The packages that are evaluated, the services made of them, and the recordings that they are asked with.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, ensure};
use sha2::{Digest, Sha256};
use support::binaries;
use support::daemon::Daemon;
use support::site::{image_config, in_image};
use tempfile::TempDir;

use crate::robot::{Node, Pace, Plan};
use crate::weights;

/// Where packages that were compiled are, in images.
const INSTALLED: &str = "/opt/cloudroid/install/lib";
/// Seconds after which a request counts as not answered.
const GIVE_UP: f64 = 30.0;
/// The file that the converter writes.
const BAG: &str = "recording.bag";
/// Recordings of MRPT, of Debian's mrpt-common.
const DATA: &str = "/usr/share/mrpt/datasets";
/// A real drive of 76 m through a floor of a faculty, with a SICK laser.
const DRIVE: &str = "2006-01ENE-21-SENA_Telecom Faculty_one_loop_only.rawlog";

/// Pedestrians, of Debian's opencv-doc.
const VIDEO: &str = "/usr/share/doc/opencv-doc/examples/data/vtest.avi";

/// A package below `examples/`, and what it speaks.
#[derive(Debug, Clone, Copy)]
pub struct Example {
    /// Of its directory, the package and the service.
    pub name: &'static str,
    /// Of which published package it stands in.
    pub stands_for: &'static str,
    /// Its node.
    pub executable: &'static str,
    /// The topic whose messages it is asked by.
    pub request: &'static str,
    /// The topic of its answers.
    pub answer: &'static str,
    /// The topic on which it tells how long it took.
    pub timing: &'static str,
    /// The topic of its map.
    pub map: Option<&'static str>,
    /// Parameters of its node.
    pub parameters: &'static [&'static str],
    /// Lasers, or pictures.
    pub input: Input,
    /// Requests of one run.
    pub requests: usize,
}

/// What a package is asked with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    /// A robot's drive: scans and odometry.
    Drive,
    /// Pedestrians.
    Pictures,
}

impl Input {
    /// Whether the files that it is made of are there, so that nothing is built for a recording that cannot be had.
    ///
    /// # Errors
    /// Says which is missing, and which package brings it.
    pub fn is_there(self) -> Result<()> {
        let (file, package) = match self {
            Self::Drive => (Path::new(DATA).join(DRIVE), "mrpt-common"),
            Self::Pictures => (PathBuf::from(VIDEO), "opencv-doc"),
        };
        ensure!(
            file.exists(),
            "{} is missing; it comes with Debian's {package}: apt-get install {package}",
            file.display()
        );
        Ok(())
    }
}

/// Scans are matched with the map that was made of those before.
pub const LASER_SLAM: Example = Example {
    name: "laser_slam",
    stands_for: "RGBD-SLAM",
    executable: "laser_slam_node",
    request: "/scan",
    answer: "/laser_slam/pose",
    timing: "/laser_slam/timing",
    map: Some("/map"),
    parameters: &["_laser_x:=0.78"],
    input: Input::Drive,
    requests: 150,
};

/// Each scan is matched with all earlier ones nearby, and the graph of all poses is made to agree.
pub const GRAPH_SLAM: Example = Example {
    name: "graph_slam",
    stands_for: "RTAB-Map",
    executable: "graph_slam_node",
    request: "/scan",
    answer: "/graph_slam/pose",
    timing: "/graph_slam/timing",
    map: None,
    parameters: &["_laser_x:=0.78"],
    input: Input::Drive,
    requests: 150,
};

/// A neural network looks for objects in pictures.
pub const DETECTOR: Example = Example {
    name: "object_detector",
    stands_for: "SSD",
    executable: "object_detector_node",
    request: "/image",
    answer: "/object_detector/detections",
    timing: "/object_detector/timing",
    map: None,
    parameters: &[],
    input: Input::Pictures,
    requests: 40,
};

/// All of them, as the published figures have them.
pub const ALL: [Example; 3] = [LASER_SLAM, GRAPH_SLAM, DETECTOR];

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

    /// Publishes an example, unless that was done before.
    pub fn publishes(&self, example: &Example) -> Result<()> {
        let services = self.daemon.deployer().asks(&["services"])?;
        let known = services
            .as_array()
            .is_some_and(|all| all.iter().any(|service| service["name"] == example.name));
        if known {
            return Ok(());
        }
        eprintln!(
            "pushing {}: the first time takes some minutes",
            example.name
        );
        example.input.is_there()?;
        let package = binaries::checkout().join("examples").join(example.name);
        if example.name == DETECTOR.name {
            weights::put_into(&package)?;
        }
        let package = package.to_str().context("a path of UTF-8")?;
        let push = [
            "push",
            package,
            "--node",
            example.executable,
            "--cpus",
            "1",
            "--memory",
            "2G",
        ];
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
        let mut argv = vec![format!("__name:={}", example.name)];
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
                    "{INSTALLED}/{}/{}",
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
                Input::Drive => vec!["/odom".to_owned()],
                Input::Pictures => Vec::new(),
            },
            answer: example.answer.to_owned(),
            tells_pose: example.input == Input::Drive,
            timing: Some(example.timing.to_owned()),
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
            Input::Pictures => "pedestrians.raw",
        });
        if !path.exists() {
            let half = path.with_extension("half");
            match input {
                Input::Drive => self.drive(&half)?,
                Input::Pictures => pictures(&half)?,
            }
            std::fs::rename(half, &path)?;
        }
        Ok(path)
    }

    /// MRPT's own recording as a rosbag file: the converter is a program of the example package.
    fn drive(&self, to: &Path) -> Result<()> {
        self.publishes(&LASER_SLAM)?;
        let directory = self.directory()?;
        let root = directory.path().join("root");
        let script = in_image(self.daemon, LASER_SLAM.name, &root)?;
        let program = format!("{INSTALLED}/{}/rawlog_to_bag", LASER_SLAM.name);
        // What the converter reads and writes is on this machine.
        let bind = format!(
            "mount --bind {} {root}/mnt && mount --bind {DATA} {root}/media && exec chroot",
            directory.path().display(),
            root = root.display()
        );
        let script = script.replace("exec chroot", &bind);
        let output = Command::new("unshare")
            .args(["--mount", "sh", "-c", &script, "sh", &program])
            .args([format!("/mnt/{BAG}"), format!("/media/{DRIVE}")])
            .output()?;
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
    let mut pending = vec![binaries::checkout().join("examples")];
    while let Some(directory) = pending.pop() {
        for entry in std::fs::read_dir(&directory)? {
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
    let status = Command::new("ffmpeg")
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
        .status()
        .context("ffmpeg")?;
    ensure!(status.success(), "ffmpeg ended with {status}");
    Ok(())
}
