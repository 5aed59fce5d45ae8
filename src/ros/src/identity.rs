//! Which node a program is, as its version of ROS is told.

use std::collections::BTreeMap;

/// What tells a program which node it is, or in which namespace.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Identity {
    /// To be added at the end of its command line.
    pub arguments: Vec<String>,
    /// To be added to its environment.
    pub environment: BTreeMap<String, String>,
}
