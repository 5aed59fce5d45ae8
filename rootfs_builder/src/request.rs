//! What a build is asked, and what it gives.

use std::collections::BTreeMap;
use std::path::PathBuf;

use image::{Digest, LayerInfo};
use package::inventory::Inventory;
use ros::flavour::Flavour;

use crate::launch::LaunchPlan;

/// One push.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PushRequest {
    /// Names the build's directory and its containers: `[a-z0-9-]`, at most 24 characters, unique on this host.
    pub id: String,
    /// The service that it becomes, where that is known.
    pub name: Option<String>,
    /// What is pushed.
    pub source: Source,
    /// Name of the base definition; [`crate::DEFAULT_BASE`] if none.
    pub base: Option<String>,
    /// Launch file: relative to the package, or its bare name.
    pub launch: Option<String>,
    /// Executables to run instead of, or beside, a launch file: `EXE` or `PACKAGE/EXE`, with arguments after it, as
    /// a shell would split them.
    pub nodes: Vec<String>,
    /// Parameters: absolute ones begin with `/`, others are private to every node (`k`, `~k` or `_k`).
    pub params: BTreeMap<String, serde_json::Value>,
    /// Arguments of the launch file.
    pub args: BTreeMap<String, String>,
    /// Names to remap, from → to, for every node.
    pub remaps: BTreeMap<String, String>,
    /// Dependencies by hand: rosdep key or ROS package → Debian package.
    pub map: BTreeMap<String, String>,
    /// More to have, while compiling and at run time: Debian or ROS packages.
    pub with: Vec<String>,
}

/// What is pushed.
#[derive(Debug, Clone, PartialEq)]
pub enum Source {
    /// A directory, unpacked by the caller: a source package, a workspace, or an install space. It is read, and
    /// the modes of its files may be widened.
    Tree(PathBuf),
    /// A ROS package of the distribution's archive (`opencv_apps`), or a Debian one (`ros-opencv-apps`).
    Packaged(String),
}

impl Default for Source {
    fn default() -> Self {
        Self::Packaged(String::new())
    }
}

/// What became of it.
#[derive(Debug)]
pub struct BuildOutcome {
    /// The ROS package that gives the service its name by default.
    pub package: String,
    /// Its version, where its package.xml or the archive says one.
    pub version: String,
    /// The base it stands on, and its ROS.
    pub flavour: Flavour,
    /// The image in the store, untagged.
    pub image: Digest,
    /// Its layers, lowest first.
    pub layers: Vec<BuiltLayer>,
    /// Environment of every process of the image (nodes add theirs).
    pub environment: BTreeMap<String, String>,
    /// What to run.
    pub plan: LaunchPlan,
    /// What the image holds.
    pub inventory: Inventory,
    /// Keeps the garbage collector from the image until it is tagged.
    pub hold: image::Hold,
}

/// A layer of the image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BuiltLayer {
    /// `base`, `dependencies` or `package`.
    pub name: &'static str,
    /// The layer.
    pub info: LayerInfo,
    /// It was there already.
    pub cached: bool,
}
