//! Which node a program is, as its version of ROS is told.

/// What tells a program which node it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// To be added to its command line.
    pub argument: String,
    /// To be added to its environment.
    pub environment: (String, String),
}
