//! The part of a definition about the image that its base was made from.

use std::collections::BTreeMap;

use image::Digest;
use serde::{Deserialize, Serialize};

use crate::error::Error;

/// Image that a base was made from, in its definition.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImportedImage {
    /// Description of what was imported, such as `image docker.io/library/ros:jazzy`.
    pub source: String,
    /// Diff-ids of its layers, lowest first.
    pub layers: Vec<Digest>,
    /// Names of tools for compiling sources that the layers lack.
    pub missing_tools: Vec<String>,
    /// True if packages of Python alone can be installed without these tools.
    pub installs_python: bool,
    /// Table of what was found, and what it means for pushes.
    pub findings: Vec<Finding>,
    /// Packages of dpkg with their versions; empty if the system has no dpkg.
    pub debian: BTreeMap<String, String>,
    /// ROS packages with their versions.
    pub ros: BTreeMap<String, String>,
}

impl ImportedImage {
    /// Returns an error for layers that are missing in the store, to which nothing can bring them back. Blocking.
    pub(crate) fn check_layers(&self, store: &image::Store, base: &str) -> Result<(), Error> {
        for layer in &self.layers {
            if store.layer(layer)?.is_none() {
                return Err(Error::ImageGone { base: base.to_owned(), layer: layer.to_string() });
            }
        }
        Ok(())
    }
}

/// Result of looking for one subject, and what it means.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Finding {
    /// Subject, such as `ROS` or `compiling`.
    pub subject: String,
    /// Description of what was found; begins with `missing` if it is not there.
    pub found: String,
    /// Consequence for pushes; empty if there is none.
    pub consequence: String,
}

impl Finding {
    pub(crate) fn new(subject: &str, found: impl Into<String>, consequence: impl Into<String>) -> Self {
        Self { subject: subject.to_owned(), found: found.into(), consequence: consequence.into() }
    }
}
