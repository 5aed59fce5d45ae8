//! The plan of a robot: what it sends to whom, when, and for how long.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::network::NetworkProfile;

/// Stamps of measured requests, which are their numbers, are at least this number.
pub const FIRST: u32 = 1000;
/// Warm-up requests, which are not counted: after them everything is connected and running.
pub const WARM_UP: usize = 3;

/// A robot's plan.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct RobotPlan {
    /// Address of the server for its stub; set by the sandbox.
    pub server: String,
    pub node: NodeUnderTest,
    pub recording: PathBuf,
    /// Topic of the requests; its messages begin with a header.
    pub request: String,
    pub left_out: Vec<String>,
    /// Recorded topics that `rosbag play` plays in addition to the requests.
    pub besides: Vec<String>,
    /// Topic of the answers, each with the header of its request.
    pub answer: String,
    /// True if answers begin like a `geometry_msgs/PoseStamped`.
    pub tells_pose: bool,
    /// A topic with a header and three float64 in seconds: acquisition, computation, rendering.
    pub timing: Option<String>,
    /// A topic of `nav_msgs/OccupancyGrid`.
    pub map: Option<String>,
    pub pace: RequestPacing,
    /// Interval at which recorded requests are used: every n-th one.
    pub every: usize,
    pub most: usize,
    /// Seconds after which a request counts as unanswered.
    pub give_up: f64,
    /// Seconds after which the whole run counts as failed.
    pub patience: f64,
    /// For requests at a rate: before which request, counted from 1, the network changes, and to which one.
    pub changes: Vec<(usize, NetworkProfile)>,
}

impl RobotPlan {
    /// Creates the plan of a robot that makes one request after the other.
    pub fn new(node: NodeUnderTest, recording: PathBuf, request: &str, answer: &str) -> Self {
        Self {
            server: String::new(),
            node,
            recording,
            request: request.to_owned(),
            left_out: Vec::new(),
            besides: Vec::new(),
            answer: answer.to_owned(),
            tells_pose: false,
            timing: None,
            map: None,
            pace: RequestPacing::OneByOne,
            every: 1,
            most: 1,
            give_up: 30.0,
            patience: 600.0,
            changes: Vec::new(),
        }
    }
}

/// Pacing of the requests.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RequestPacing {
    /// Each request after the answer to the previous one.
    OneByOne,
    Recorded(f64),
    /// At a fixed rate, repeating the recording, once some warm-up requests were answered in time.
    Rate {
        hertz: f64,
        in_time: f64,
    },
    /// By `rosbag play`, at its own rate and with its own stamps, for this number of seconds of the recording.
    Played(f64),
}

/// The node that answers on the robot.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NodeUnderTest {
    /// The package itself, in the file system of its image.
    Native {
        /// Shell commands that execute their arguments there.
        script: String,
        program: String,
        argv: Vec<String>,
    },
    Stub {
        package: String,
        executable: String,
        argv: Vec<String>,
        /// Lines of `stub.toml` besides the server's address.
        settings: String,
        /// Environment variables.
        environment: Vec<(String, String)>,
    },
}
