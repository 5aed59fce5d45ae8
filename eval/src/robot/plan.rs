//! The plan of a robot: what it sends to whom, when, and for how long.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::network::NetworkProfile;

/// A robot's plan.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct RobotPlan {
    /// Address of the server for its stub; set by the sandbox.
    pub server: String,
    /// The node that answers.
    pub node: NodeUnderTest,
    /// A rosbag file.
    pub recording: PathBuf,
    /// Topic of the requests; its messages begin with a header.
    pub request: String,
    /// Recorded topics that are not inputs.
    pub left_out: Vec<String>,
    /// Recorded topics that `rosbag play` plays in addition to the requests.
    #[serde(default)]
    pub besides: Vec<String>,
    /// Topic of the answers, each with the header of its request.
    pub answer: String,
    /// True if answers begin like a `geometry_msgs/PoseStamped`.
    pub tells_pose: bool,
    /// A topic with a header and three float64 in seconds: acquisition, computation, rendering.
    pub timing: Option<String>,
    /// A topic of `nav_msgs/OccupancyGrid`.
    pub map: Option<String>,
    /// When requests are published.
    pub pace: RequestPacing,
    /// Interval at which recorded requests are used: every n-th one.
    pub every: usize,
    /// Maximum number of requests, without the warm-up.
    pub most: usize,
    /// Seconds after which a request counts as unanswered.
    pub give_up: f64,
    /// Seconds after which the whole run counts as failed.
    pub patience: f64,
    /// For requests at a rate: before which request, counted from 1, the network changes, and to which one.
    #[serde(default)]
    pub changes: Vec<(usize, NetworkProfile)>,
}

/// Pacing of the requests.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RequestPacing {
    /// Each request after the answer to the previous one.
    OneByOne,
    /// At the recorded times, divided by this factor.
    Recorded(f64),
    /// At a fixed rate, repeating the recording, once some warm-up requests were answered in time.
    Rate {
        /// Requests per second.
        hertz: f64,
        /// Seconds within which an answer is in time.
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
        /// The node's program in that file system.
        program: String,
        /// Arguments of the program.
        argv: Vec<String>,
    },
    /// A stub of the package.
    Stub {
        /// Name of the package.
        package: String,
        /// The node's executable.
        executable: String,
        /// Arguments of the executable.
        argv: Vec<String>,
        /// Lines of `stub.toml` besides the server's address.
        settings: String,
        /// Environment variables.
        #[serde(default)]
        environment: Vec<(String, String)>,
    },
}
