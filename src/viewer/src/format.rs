//! Encodings of messages and of their definitions, by the names of the protocol (the same as in
//! <https://mcap.dev/spec/registry>).

use ros::bus::RosVersion;

/// Encoding names of a servant's messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ViewerFormat {
    /// Encoding of messages, requests and responses.
    pub encoding: &'static str,
    /// Encoding of definitions: the message text followed by the texts of all types it contains.
    pub schema: &'static str,
}

impl ViewerFormat {
    /// Returns the encodings of a ROS version.
    pub fn for_version(version: RosVersion) -> Self {
        match version {
            RosVersion::One => Self { encoding: "ros1", schema: "ros1msg" },
            RosVersion::Two => Self { encoding: "cdr", schema: "ros2msg" },
        }
    }
}
