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

/// Which parts of a node's name its program is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Naming {
    /// Its name, without namespace.
    pub name: bool,
    /// Its namespace.
    pub namespace: bool,
}

/// All of it.
impl Default for Naming {
    fn default() -> Self {
        Self {
            name: true,
            namespace: true,
        }
    }
}

/// What a node of a program is called.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Called {
    /// What its program calls it, with a namespace that the program gives it; none where that is another name each time.
    pub own: Option<String>,
    /// Its absolute name.
    pub node: String,
}
