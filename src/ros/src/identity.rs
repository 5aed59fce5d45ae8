//! Identity of a program's node in the terms of its ROS version.

use std::collections::BTreeMap;

/// Arguments and environment that set a program's node name or namespace.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeIdentity {
    /// Arguments to add to the command line: at its end, or where [`crate::flavour::Flavour::insert_arguments`] puts
    /// them.
    pub arguments: Vec<String>,
    /// Variables to add to the environment.
    pub environment: BTreeMap<String, String>,
}

/// The parts of a node's name that are set on its command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Naming {
    /// The name, without namespace.
    pub name: bool,
    /// The namespace.
    pub namespace: bool,
}

/// Sets both parts.
impl Default for Naming {
    fn default() -> Self {
        Self { name: true, namespace: true }
    }
}

/// The name of a program's node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeRename {
    /// Name used by the program, including a namespace set by the program; `None` if it differs at each start.
    pub own: Option<String>,
    /// Absolute name to give it.
    pub node: String,
}
