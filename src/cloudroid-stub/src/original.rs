//! The original: the executable that would run if the stub were not installed.
//!
//! Searched as the tools of the robot's ROS version do. ROS 1: `lib/PKG/NODE` and then `share/PKG` of each workspace on
//! CMAKE_PREFIX_PATH, the source spaces that its `.catkin` lists, ROS_PACKAGE_PATH, and last `/usr` and
//! `/opt/ros/$ROS_DISTRO`, which upstream's setup files do not always name. ROS 2: `lib/PKG/EXE` of each install space
//! on AMENT_PREFIX_PATH, of those on COLCON_PREFIX_PATH, and of `/opt/ros/$ROS_DISTRO`.

mod ament;
mod catkin;

use std::collections::VecDeque;
use std::ffi::{OsStr, OsString};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use anyhow::bail;
use ros::bus::RosVersion;

use crate::arguments::NodeArgs;
use crate::revision::Revision;

/// Maximum depth of executables below `share/PKG` or a source directory.
const DEPTH: usize = 4;
/// Variables that list workspaces.
const WORKSPACE_VARIABLES: [&str; 4] =
    ["CMAKE_PREFIX_PATH", "ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH", "COLCON_PREFIX_PATH"];

/// Replaces this process with the original, in the environment that it would have had.
pub fn exec(node: &NodeArgs, argv: &[String]) -> anyhow::Result<ExitCode> {
    let overlay = overlay(&node.share);
    let Some(path) = find(node, &|name| std::env::var(name).ok()) else {
        bail!(
            "no original {}/{} is installed beside this stub; install the original package, or outsource this node",
            node.package,
            node.node
        );
    };
    let error = Command::new(&path).args(argv).envs(environment(&overlay)).exec();
    bail!("cannot execute {}: {error}", path.display())
}

/// Returns the overlay that `share/PKG` belongs to.
pub fn overlay(share: &Path) -> PathBuf {
    share.parent().and_then(Path::parent).unwrap_or(share).to_owned()
}

/// Returns the variables that list workspaces, without this stub's overlay, so that programs started by the original
/// find originals, too.
pub fn environment(overlay: &Path) -> Vec<(&'static str, OsString)> {
    WORKSPACE_VARIABLES
        .into_iter()
        .filter_map(|name| Some((name, without_overlay(&std::env::var_os(name)?, overlay)?)))
        .collect()
}

/// Returns the list of directories without those in the overlay.
fn without_overlay(list: &OsStr, overlay: &Path) -> Option<OsString> {
    let kept = std::env::split_paths(list).filter(|entry| !is_within(entry, overlay));
    std::env::join_paths(kept).ok()
}

fn is_within(path: &Path, overlay: &Path) -> bool {
    let canonical = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.to_owned());
    canonical(path).starts_with(canonical(overlay))
}

/// Search for the original of a node.
struct OriginalSearch<'a> {
    node: &'a NodeArgs,
    overlay: PathBuf,
    variable: &'a dyn Fn(&str) -> Option<String>,
}

impl OriginalSearch<'_> {
    /// Returns the directories that a variable lists, without the stub's.
    fn entries(&self, name: &str) -> Vec<PathBuf> {
        let value = (self.variable)(name).unwrap_or_default();
        std::env::split_paths(&value).filter(|entry| entry.is_absolute() && !is_within(entry, &self.overlay)).collect()
    }

    /// Returns the directory of the ROS distribution, which may not be installed in `/usr`.
    fn distribution(&self) -> Option<PathBuf> {
        let name = (self.variable)("ROS_DISTRO")?;
        Some(Path::new("/opt/ros").join(name))
    }
}

/// Returns the next executable of this name after the stub, with variables from `variable`.
pub fn find(node: &NodeArgs, variable: &dyn Fn(&str) -> Option<String>) -> Option<PathBuf> {
    let search = OriginalSearch { node, overlay: overlay(&node.share), variable };
    match Revision::read(&node.share).ros() {
        RosVersion::One => catkin::find(&search),
        RosVersion::Two => ament::find(&search),
    }
}

/// Returns an executable of this name at or below a package's directory.
fn find_below(directory: &Path, node: &str) -> Option<PathBuf> {
    let mut open = VecDeque::from([(directory.to_owned(), 0)]);
    while let Some((directory, depth)) = open.pop_front() {
        let here = directory.join(node);
        if is_executable(&here) {
            return Some(here);
        }
        if depth < DEPTH {
            open.extend(children(&directory).into_iter().map(|child| (child, depth + 1)));
        }
    }
    None
}

fn children(directory: &Path) -> Vec<PathBuf> {
    let mut children: Vec<_> = std::fs::read_dir(directory)
        .into_iter()
        .flatten()
        .flatten()
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()))
        .filter(|entry| !entry.file_name().as_encoded_bytes().starts_with(b"."))
        .map(|entry| entry.path())
        .collect();
    children.sort();
    children
}

/// Returns whether the file is executable and not this stub under another name.
fn is_executable(path: &Path) -> bool {
    let Ok(metadata) = std::fs::metadata(path) else {
        return false;
    };
    let own = std::env::current_exe().and_then(std::fs::metadata);
    let is_own = own.is_ok_and(|own| (own.dev(), own.ino()) == (metadata.dev(), metadata.ino()));
    metadata.is_file() && metadata.permissions().mode() & 0o111 != 0 && !is_own
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Creates an executable.
    pub(super) fn executable(path: &Path) {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, "#!/bin/sh\n").unwrap();
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o755)).unwrap();
    }
}
