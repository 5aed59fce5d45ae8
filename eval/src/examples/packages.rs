//! The packages, what they speak, and what they are asked with.

use std::path::{Path, PathBuf};

use anyhow::{Result, ensure};

use crate::stereo;

/// Recordings of MRPT, of Debian's mrpt-common.
pub const DATA: &str = "/usr/share/mrpt/datasets";
/// A real drive of 76 m through a floor of a faculty, with a SICK laser.
pub const DRIVE: &str = "2006-01ENE-21-SENA_Telecom Faculty_one_loop_only.rawlog";

/// A simulated drive of 200 m, with the simulator's own path of it beside it.
pub const SIMULATED: &str = "graphslam-engine-demos/action_observations_map/simul.rawlog";
/// Pedestrians, of Debian's opencv-doc.
pub const VIDEO: &str = "/usr/share/doc/opencv-doc/examples/data/vtest.avi";

/// A package that is evaluated, and what it speaks.
#[derive(Debug, Clone, Copy)]
pub struct Example {
    /// Of the package and the service.
    pub name: &'static str,
    /// Whose it is.
    pub origin: Origin,
    /// Of which published package it stands in.
    pub stands_for: &'static str,
    /// Its node.
    pub executable: &'static str,
    /// The topic whose messages it is asked by.
    pub request: &'static str,
    /// The topic of its answers.
    pub answer: &'static str,
    /// The topic on which it tells how long it took, if it does.
    pub timing: Option<&'static str>,
    /// The topic of its map.
    pub map: Option<&'static str>,
    /// Parameters of its node.
    pub parameters: &'static [&'static str],
    /// Lasers, or pictures.
    pub input: Input,
    /// Requests of one run.
    pub requests: usize,
}

/// Whose a package is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// Of `examples/`, compiled when it is pushed.
    Checkout,
    /// Of Debian, as it is installed from there.
    Debian,
}

/// What a package is asked with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    /// A robot's drive: scans and odometry.
    Drive,
    /// The same by a simulator, with the true path.
    Simulated,
    /// Pedestrians.
    Pictures,
    /// Pictures of two cameras beside each other.
    Stereo,
}

impl Input {
    /// Whether the files that it is made of are there, so that nothing is built for a recording that cannot be had.
    ///
    /// # Errors
    /// Says which is missing, and which package brings it.
    pub fn is_there(self) -> Result<()> {
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

/// Scans are matched with the map that was made of those before.
pub const LASER_SLAM: Example = Example {
    name: "laser_slam",
    origin: Origin::Checkout,
    stands_for: "RGBD-SLAM",
    executable: "laser_slam_node",
    request: "/scan",
    answer: "/laser_slam/pose",
    timing: Some("/laser_slam/timing"),
    map: Some("/map"),
    parameters: &["_laser_x:=0.78"],
    input: Input::Drive,
    requests: 150,
};

/// Each scan is matched with all earlier ones nearby, and the graph of all poses is made to agree.
pub const GRAPH_SLAM: Example = Example {
    name: "graph_slam",
    origin: Origin::Checkout,
    stands_for: "RTAB-Map",
    executable: "graph_slam_node",
    request: "/scan",
    answer: "/graph_slam/pose",
    timing: Some("/graph_slam/timing"),
    map: None,
    parameters: &["_laser_x:=0.78"],
    input: Input::Drive,
    requests: 150,
};

/// A neural network looks for objects in pictures.
pub const DETECTOR: Example = Example {
    name: "object_detector",
    origin: Origin::Checkout,
    stands_for: "SSD",
    executable: "object_detector_node",
    request: "/image",
    answer: "/object_detector/detections",
    timing: Some("/object_detector/timing"),
    map: None,
    parameters: &[],
    input: Input::Pictures,
    requests: 40,
};

/// The first 78 s of the simulated drive: 80 m that end close to where they began.
pub const LASER_SLAM_SIMULATED: Example = Example {
    parameters: &["_laser_x:=0.2"],
    input: Input::Simulated,
    requests: 760,
    ..LASER_SLAM
};

/// Boxes around pedestrians: histograms of gradients (OpenCV), as Debian packages the node.
pub const PEOPLE: Example = Example {
    name: "opencv_apps",
    origin: Origin::Debian,
    stands_for: "",
    executable: "people_detect",
    request: "/image",
    answer: "/people_detect/found",
    timing: None,
    map: None,
    parameters: &["_debug_view:=false"],
    input: Input::Pictures,
    requests: 40,
};

/// Disparities by block matching (OpenCV), as Debian packages the node. The last of four messages that it needs counts as the request.
pub const DISPARITY: Example = Example {
    name: "stereo_image_proc",
    origin: Origin::Debian,
    stands_for: "",
    executable: "stereo_image_proc",
    request: stereo::LAST,
    answer: "/disparity",
    timing: None,
    map: None,
    parameters: &[],
    input: Input::Stereo,
    requests: 40,
};

/// All of `examples/`, as the published figures have them.
pub const ALL: [Example; 3] = [LASER_SLAM, GRAPH_SLAM, DETECTOR];
