//! Input and output of a build.

use std::collections::BTreeMap;
use std::path::PathBuf;

use image::{Digest, LayerInfo};
use package::inventory::Inventory;
use package::selection::PackageQuery;
use ros::flavour::Flavour;

use crate::launch::LaunchPlan;
use crate::underlay::{NamedUnderlay, UnderlayContents};

/// A push to build.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PushRequest {
    /// Name of the build's directory and containers: `[a-z0-9-]`, at most 24 characters, unique on this host.
    pub id: String,
    /// Name of the service, if known.
    pub name: Option<String>,
    /// Content of the push.
    pub source: PushSource,
    /// Name of the base definition (default: [`crate::DEFAULT_BASE`]).
    pub base: Option<String>,
    /// Launch file, relative to the package, or its bare name.
    pub launch: Option<String>,
    /// Executables to run instead of or in addition to a launch file: `EXE` or `PACKAGE/EXE`, followed by arguments
    /// that are split as by a shell.
    pub nodes: Vec<String>,
    /// Parameters: absolute ones begin with `/`, others are private to every node (`k`, `~k` or `_k`).
    pub params: BTreeMap<String, serde_json::Value>,
    /// Arguments of the launch file.
    pub args: BTreeMap<String, String>,
    /// Name remappings for every node, from → to.
    pub remaps: BTreeMap<String, String>,
    /// Manual dependency mapping: rosdep key or ROS package → Debian packages, or packages of the push or the base;
    /// nothing for a key that needs none.
    pub map: BTreeMap<String, String>,
    /// Additional Debian or ROS packages, while compiling and at run time.
    pub with: Vec<String>,
    /// Time of the newest source in seconds since 1970, which becomes that of the image (default: the time to which
    /// those of files in layers are clamped).
    pub created: Option<u64>,
    /// Packages of the workspace to build, with those that they need; empty for what the chosen nodes need.
    pub packages_up_to: Vec<String>,
    /// Packages of the workspace that are not built.
    pub packages_skip: Vec<String>,
    /// Arguments of CMake for the packages of the push, after those of the base.
    pub cmake_args: Vec<String>,
    /// Underlays that it is compiled and runs upon, lowest first.
    pub underlays: Vec<NamedUnderlay>,
    /// True if it becomes an underlay, of which nothing is run.
    pub as_underlay: bool,
}

impl PushRequest {
    /// Returns whether an option is about compiling.
    pub(crate) fn has_build_options(&self) -> bool {
        let has_none = self.packages_up_to.is_empty()
            && self.packages_skip.is_empty()
            && self.cmake_args.is_empty()
            && self.underlays.is_empty();
        self.as_underlay || !has_none
    }

    /// Returns the name of the base, as far as the options determine it: that of an underlay, unless another is asked
    /// for.
    pub(crate) fn base_name(&self) -> Option<&str> {
        let of_underlay = self.underlays.first().map(|underlay| underlay.contents.base.as_str());
        self.base.as_deref().or(of_underlay)
    }

    /// Returns what the request says about the packages to build.
    pub(crate) fn package_query(&self) -> PackageQuery<'_> {
        // Plugins are named in parameters.
        let values = self.params.values().map(ToString::to_string);
        PackageQuery {
            up_to: &self.packages_up_to,
            skip: &self.packages_skip,
            launch: self.launch.as_deref(),
            nodes: &self.nodes,
            texts: values.chain(self.args.values().cloned()).chain(self.map.values().cloned()).collect(),
        }
    }
}

/// Content of a push.
#[derive(Debug, Clone, PartialEq)]
pub enum PushSource {
    /// A directory, unpacked by the caller: a source package, a workspace, or an install space. It is read, and the
    /// permissions of its files may be extended.
    Tree(PathBuf),
    /// A ROS package of the distribution's archive (`opencv_apps`), or a Debian package (`ros-opencv-apps`).
    Packaged(String),
}

impl Default for PushSource {
    fn default() -> Self {
        Self::Packaged(String::new())
    }
}

/// Result of a build.
#[derive(Debug)]
pub enum BuildResult {
    /// The image of a service.
    Service(Box<BuildOutcome>),
    /// An underlay.
    Underlay(Box<BuiltUnderlay>),
}

/// A compiled underlay.
#[derive(Debug)]
pub struct BuiltUnderlay {
    /// Main package, whose name is the default name of the underlay.
    pub package: String,
    /// Facts for packages that are built upon it.
    pub contents: UnderlayContents,
    /// Base and ROS flavour.
    pub flavour: Flavour,
    /// Digest of the image with all its layers in the store, untagged. Nothing can be run in it: it keeps the layers.
    pub image: Digest,
    /// Layers of the underlay itself.
    pub layers: Vec<BuiltLayer>,
    /// Guard that protects the image from the garbage collector until it is tagged.
    pub hold: image::GcHold,
}

/// Result of a build.
#[derive(Debug)]
pub struct BuildOutcome {
    /// ROS package whose name is the default name of the service.
    pub package: String,
    /// Version of the package, if stated in its package.xml or the archive.
    pub version: String,
    /// Base and ROS flavour.
    pub flavour: Flavour,
    /// Digest of the image in the store, untagged.
    pub image: Digest,
    /// Layers of the image, lowest first.
    pub layers: Vec<BuiltLayer>,
    /// Environment of every process of the image (nodes may add to it).
    pub environment: BTreeMap<String, String>,
    /// Launch plan.
    pub plan: LaunchPlan,
    /// Inventory of the image.
    pub inventory: Inventory,
    /// Guard that protects the image from the garbage collector until it is tagged.
    pub hold: image::GcHold,
}

/// A layer of the image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BuiltLayer {
    /// Name of the layer: `base`, `dependencies`, `underlay` or `package`.
    pub name: &'static str,
    /// Layer in the store.
    pub info: LayerInfo,
    /// True if the layer already existed.
    pub cached: bool,
}
