//! Which node a program is, as its version of ROS is told.

use std::collections::BTreeMap;

/// What tells a program which node it is, or in which namespace.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Identity {
    /// To be added to its command line: at its end, or where [`crate::flavour::Flavour::put`] puts them.
    pub arguments: Vec<String>,
    /// To be added to its environment.
    pub environment: BTreeMap<String, String>,
}
