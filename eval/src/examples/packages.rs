//! The packages, their topics, and their inputs.

use std::path::{Path, PathBuf};

use anyhow::{Result, ensure};

use crate::stereo;

/// Recordings of MRPT, from Debian's mrpt-common.
pub const DATA: &str = "/usr/share/mrpt/datasets";
/// A real drive of 76 m through one floor of a faculty building, with a SICK laser.
pub const DRIVE: &str = "2006-01ENE-21-SENA_Telecom Faculty_one_loop_only.rawlog";

/// A simulated drive of 200 m, together with the simulator's true path.
pub const SIMULATED: &str = "graphslam-engine-demos/action_observations_map/simul.rawlog";
/// Video of pedestrians, from Debian's opencv-doc.
pub const VIDEO: &str = "/usr/share/doc/opencv-doc/examples/data/vtest.avi";

/// A package under evaluation, and its topics.
#[derive(Debug, Clone, Copy)]
pub struct EvalPackage {
    /// Name of the package and of the service.
    pub name: &'static str,
    /// Origin of the package.
    pub origin: Origin,
    /// The published package that it stands in for.
    pub stands_for: &'static str,
    /// Executable of its node.
    pub executable: &'static str,
    /// Topic of the requests.
    pub request: &'static str,
    /// Topic of the answers.
    pub answer: &'static str,
    /// Topic on which the node publishes its own timing, if it does.
    pub timing: Option<&'static str>,
    /// Topic of its map.
    pub map: Option<&'static str>,
    /// Parameters of its node.
    pub parameters: &'static [&'static str],
    /// Kind of its input.
    pub input: InputRecording,
    /// Requests per run.
    pub requests: usize,
}

/// Origin of a package.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A package in `examples/`, compiled when it is pushed.
    Checkout,
    /// A package of Debian, as installed.
    Debian,
}

/// Input of a package.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputRecording {
    /// A robot's drive: laser scans and odometry.
    Drive,
    /// A simulated drive, with the true path.
    Simulated,
    /// Images of pedestrians.
    Pictures,
    /// Images of a stereo camera.
    Stereo,
}

impl InputRecording {
    /// Checks that the source files exist, so that nothing is built for a recording that cannot be created.
    ///
    /// # Errors
    /// If a file is missing; the error names the Debian package that contains it.
    pub fn check_files(self) -> Result<()> {
        let (file, package) = match self {
            Self::Drive => (Path::new(DATA).join(DRIVE), "mrpt-common"),
            Self::Simulated => (Path::new(DATA).join(SIMULATED), "mrpt-common"),
            Self::Pictures => (PathBuf::from(VIDEO), "opencv-doc"),
            Self::Stereo => (PathBuf::from(stereo::PICTURES[0]), "opencv-doc"),
        };
        ensure!(
            file.exists(),
            "{} is missing; it comes with Debian's {package}: apt-get install {package}",
            file.display()
        );
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
    origin: Origin::Checkout,
    stands_for: "RTAB-Map",
    executable: "graph_slam_node",
    request: "/scan",
    answer: "/graph_slam/pose",
    timing: Some("/graph_slam/timing"),
    map: None,
    parameters: &["_laser_x:=0.78"],
    input: InputRecording::Drive,
    requests: 150,
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
    stands_for: "",
    executable: "people_detect",
    request: "/image",
    answer: "/people_detect/found",
    timing: None,
    map: None,
    parameters: &["_debug_view:=false"],
    input: InputRecording::Pictures,
    requests: 40,
};

/// Computes disparities by block matching (OpenCV), as Debian packages the node. The last of the four messages that it
/// needs counts as the request.
pub const DISPARITY: EvalPackage = EvalPackage {
    name: "stereo_image_proc",
    origin: Origin::Debian,
    stands_for: "",
    executable: "stereo_image_proc",
    request: stereo::LAST,
    answer: "/disparity",
    timing: None,
    map: None,
    parameters: &[],
    input: InputRecording::Stereo,
    requests: 40,
};

/// All packages of `examples/`, as in the published figures.
pub const ALL: [EvalPackage; 3] = [LASER_SLAM, GRAPH_SLAM, DETECTOR];
