//! Words of the generated texts, by ROS version.

use ros::bus::RosVersion;

use super::{ament, catkin};

/// Terms in the generated texts that differ between the ROS versions.
pub(super) struct RosTerms {
    /// Command that starts a node.
    pub(super) run: &'static str,
    /// Reason why the overlay's setup file is sourced last.
    pub(super) order: &'static str,
    /// Description of what cannot be loaded on the robot.
    pub(super) plugins: &'static str,
    /// Where a robot may give a setting besides `stub.toml`.
    pub(super) settings: &'static str,
}

impl RosTerms {
    pub(super) fn for_ros(ros: RosVersion) -> &'static RosTerms {
        match ros {
            RosVersion::One => &catkin::WORDS,
            RosVersion::Two => &ament::WORDS,
        }
    }
}
