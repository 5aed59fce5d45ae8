//! A Debian package at a version, and its relations to others.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

/// A Debian package at a version.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Deb {
    /// Name, without architecture.
    pub name: String,
    /// Version as in the archive.
    pub version: String,
    /// Architecture, such as `amd64` or `all`.
    pub architecture: String,
}

/// Relations of a package to others.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Relations {
    /// Source package that it was built from.
    pub source: String,
    /// Packages named in Depends and Pre-Depends, including alternatives.
    pub needs: BTreeSet<String>,
    /// Packages named in Pre-Depends, including alternatives.
    pub before: BTreeSet<String>,
    /// Virtual packages that it provides.
    pub provides: BTreeSet<String>,
}

impl std::fmt::Display for Deb {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}={}:{}", self.name, self.version, self.architecture)
    }
}

impl Deb {
    /// Returns the file name that apt uses, in which the colon of the epoch is escaped.
    pub(crate) fn file_name(&self) -> String {
        format!("{}_{}_{}.deb", self.name, self.version.replace(':', "%3a"), self.architecture)
    }
}
