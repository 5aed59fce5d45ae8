//! How messages are written, and how their definitions are, in the words of the protocol
//! (<https://mcap.dev/spec/registry> has the same).

use ros::bus::RosVersion;

/// What a servant's messages are to a viewer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Format {
    /// How messages, requests and answers are written.
    pub encoding: &'static str,
    /// How definitions are written: the text of the message, followed by those of all that it contains.
    pub schema: &'static str,
}

impl Format {
    /// That of a version of ROS.
    pub fn of(version: RosVersion) -> Self {
        match version {
            RosVersion::One => Self {
                encoding: "ros1",
                schema: "ros1msg",
            },
            RosVersion::Two => Self {
                encoding: "cdr",
                schema: "ros2msg",
            },
        }
    }
}
