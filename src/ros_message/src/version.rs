//! ROS versions.

/// The generations of ROS.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum RosVersion {
    /// ROS 1: Master, TCPROS, actionlib.
    One,
    /// ROS 2: DDS.
    Two,
}

impl RosVersion {
    /// Returns 1 or 2.
    pub fn number(self) -> u8 {
        match self {
            Self::One => 1,
            Self::Two => 2,
        }
    }

    /// Returns the other version.
    pub fn other(self) -> RosVersion {
        match self {
            Self::One => Self::Two,
            Self::Two => Self::One,
        }
    }
}
