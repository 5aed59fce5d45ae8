//! What a robot is to do: whom it asks what, when, and for how long.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::place::Network;

/// What a robot does.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Plan {
    /// Where its stub finds the server; the place says it.
    pub server: String,
    /// Who answers.
    pub node: Node,
    /// A rosbag file.
    pub recording: PathBuf,
    /// The topic whose messages are requests; they begin with a header.
    pub request: String,
    /// Recorded topics that are no inputs.
    pub left_out: Vec<String>,
    /// Recorded topics that `rosbag play` plays beside the requests.
    #[serde(default)]
    pub besides: Vec<String>,
    /// The topic of answers, with the header of what they answer.
    pub answer: String,
    /// Answers begin like a `geometry_msgs/PoseStamped`.
    pub tells_pose: bool,
    /// A topic with a header and three float64, seconds: acquisition, computation, rendering.
    pub timing: Option<String>,
    /// A topic of `nav_msgs/OccupancyGrid`.
    pub map: Option<String>,
    /// One request after the other's answer, or as they were recorded.
    pub pace: Pace,
    /// Every so many of the recorded requests is asked.
    pub every: usize,
    /// Requests at the most, without the first ones, which are not counted.
    pub most: usize,
    /// Seconds after which a request counts as not answered.
    pub give_up: f64,
    /// Seconds after which the whole run does.
    pub patience: f64,
    /// Of requests at a rate: before this one, counted from 1, the network becomes that one.
    #[serde(default)]
    pub changes: Vec<(usize, Network)>,
}

/// When requests are published.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Pace {
    /// After the answer to the one before.
    OneByOne,
    /// At their recorded times, so much faster.
    Recorded(f64),
    /// At a rate, all again from the first after the last, once some were answered in time.
    Rate {
        /// Requests per second.
        hertz: f64,
        /// Seconds within which an answer is in time.
        in_time: f64,
    },
    /// By `rosbag play`, at its own rate and with its own stamps, so many seconds of the recording.
    Played(f64),
}

/// Who answers on the robot.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Node {
    /// The package itself, in the file system that was made of it.
    Native {
        /// Shell commands that execute their arguments there.
        script: String,
        /// The node's program in it.
        program: String,
        /// Its arguments.
        argv: Vec<String>,
    },
    /// Its stub.
    Stub {
        /// The package.
        package: String,
        /// The node's program.
        executable: String,
        /// Its arguments.
        argv: Vec<String>,
        /// Lines of `stub.toml` beside the server's address.
        settings: String,
        /// Variables in its environment.
        #[serde(default)]
        environment: Vec<(String, String)>,
    },
}
