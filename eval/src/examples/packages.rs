//! The packages, their topics, and their inputs.

use std::path::Path;

use anyhow::{Result, ensure};

use crate::pictures;

/// Recordings of MRPT, from Debian's mrpt-common.
pub const DATA: &str = "/usr/share/mrpt/datasets";
/// A real drive of 76 m through one floor of a faculty building, with a SICK laser.
pub const DRIVE: &str = "2006-01ENE-21-SENA_Telecom Faculty_one_loop_only.rawlog";

/// A simulated drive of 200 m, together with the simulator's true path.
pub const SIMULATED: &str = "graphslam-engine-demos/action_observations_map/simul.rawlog";
/// A package under evaluation, and its topics.
#[derive(Debug, Clone, Copy)]
pub struct EvalPackage {
    pub name: &'static str,
    pub origin: Origin,
    pub stands_for: &'static str,
    pub executable: &'static str,
    pub request: &'static str,
    pub answer: &'static str,
    /// Topic on which the node publishes its own timing, if it does.
    pub timing: Option<&'static str>,
    pub map: Option<&'static str>,
    pub parameters: &'static [&'static str],
    pub input: InputRecording,
    pub requests: usize,
}

/// Origin of a package.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A package in `examples/`, compiled when it is pushed.
    Checkout,
    Debian,
}

/// Input of a package.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputRecording {
    Drive,
    Simulated,
    Pictures,
    Stereo,
}

impl InputRecording {
    /// Checks that the source files exist, so that nothing is built for a recording that cannot be created.
    ///
    /// # Errors
    /// If a file is missing; the error names the Debian package that contains it.
    pub fn check_files(self) -> Result<()> {
        let rawlog = match self {
            Self::Drive => DRIVE,
            Self::Simulated => SIMULATED,
            Self::Pictures => return pictures::check_source(pictures::VIDEO),
            Self::Stereo => return pictures::check_source(pictures::STEREO[0]),
        };
        let file = Path::new(DATA).join(rawlog);
        let how = "it comes with Debian's mrpt-common: apt-get install mrpt-common";
        ensure!(file.exists(), "{} is missing; {how}", file.display());
        Ok(())
    }
}

/// Matches scans with the map built from the earlier ones.
pub const LASER_SLAM: EvalPackage = EvalPackage {
    name: "laser_slam",
    origin: Origin::Checkout,
    stands_for: "RGBD-SLAM",
    executable: "laser_slam_node",
    request: "/scan",
    answer: "/laser_slam/pose",
    timing: Some("/laser_slam/timing"),
    map: Some("/map"),
    parameters: &["_laser_x:=0.78"],
    input: InputRecording::Drive,
    requests: 150,
};

/// Matches each scan with all earlier ones nearby, and optimizes the graph of all poses.
pub const GRAPH_SLAM: EvalPackage = EvalPackage {
    name: "graph_slam",
    stands_for: "RTAB-Map",
    executable: "graph_slam_node",
    answer: "/graph_slam/pose",
    timing: Some("/graph_slam/timing"),
    map: None,
    ..LASER_SLAM
};

/// Detects objects in images with a neural network.
pub const DETECTOR: EvalPackage = EvalPackage {
    name: "object_detector",
    origin: Origin::Checkout,
    stands_for: "SSD",
    executable: "object_detector_node",
    request: "/image",
    answer: "/object_detector/detections",
    timing: Some("/object_detector/timing"),
    map: None,
    parameters: &[],
    input: InputRecording::Pictures,
    requests: 40,
};

/// The first 78 s of the simulated drive: 80 m that end close to their start.
pub const LASER_SLAM_SIMULATED: EvalPackage =
    EvalPackage { parameters: &["_laser_x:=0.2"], input: InputRecording::Simulated, requests: 760, ..LASER_SLAM };

/// Finds pedestrians by histograms of gradients (OpenCV), as Debian packages the node.
pub const PEOPLE: EvalPackage = EvalPackage {
    name: "opencv_apps",
    origin: Origin::Debian,
    executable: "people_detect",
    answer: "/people_detect/found",
    timing: None,
    parameters: &["_debug_view:=false"],
    ..DETECTOR
};

/// Computes disparities by block matching (OpenCV), as Debian packages the node. The last of the four messages that it
/// needs counts as the request.
pub const DISPARITY: EvalPackage = EvalPackage {
    name: "stereo_image_proc",
    executable: "stereo_image_proc",
    request: pictures::LAST,
    answer: "/disparity",
    parameters: &[],
    input: InputRecording::Stereo,
    ..PEOPLE
};

/// All packages of `examples/`, as in the published figures.
pub const ALL: [EvalPackage; 3] = [LASER_SLAM, GRAPH_SLAM, DETECTOR];
