//! Needs of the packages of a push, or of an underlay, at run time.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

/// Packages and libraries that are needed at run time.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct RuntimeNeeds {
    /// ROS packages, still to be gathered.
    pub(crate) ros: BTreeSet<String>,
    /// Debian packages.
    pub(crate) debs: BTreeSet<String>,
    /// Shared libraries.
    pub(crate) libraries: BTreeSet<String>,
    /// True if Python code uses the ROS packages.
    pub(crate) python: bool,
}

impl RuntimeNeeds {
    /// Adds what others need.
    pub(crate) fn extend(&mut self, others: &Self) {
        self.ros.extend(others.ros.iter().cloned());
        self.debs.extend(others.debs.iter().cloned());
        self.libraries.extend(others.libraries.iter().cloned());
        self.python |= others.python;
    }
}
