//! The original: the executable that would run if the stub were not installed.
//!
//! Searched as rosrun and roslaunch do: `lib/PKG/NODE` and then `share/PKG` of each workspace on CMAKE_PREFIX_PATH,
//! the source spaces that its `.catkin` lists, ROS_PACKAGE_PATH, and last `/usr` and `/opt/ros/$ROS_DISTRO`, which
//! upstream's set-up files do not always name.

use std::collections::VecDeque;
use std::ffi::OsString;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use anyhow::bail;

use crate::arguments::Node;

/// How deep executables may lie below `share/PKG` or a source directory.
const DEPTH: usize = 4;

/// Becomes the original, in the environment that it would have had.
pub fn exec(node: &Node, argv: &[String]) -> anyhow::Result<ExitCode> {
    let overlay = overlay(&node.share);
    let Some(path) = find(node, &|name| std::env::var(name).ok()) else {
        bail!(
            "no other {}/{} is installed beside this stub; install the original package, or outsource this node",
            node.package,
            node.node
        );
    };
    let error = Command::new(&path)
        .args(argv)
        .envs(environment(&overlay))
        .exec();
    bail!("{} cannot be executed: {error}", path.display())
}

/// The overlay that `share/PKG` belongs to.
pub fn overlay(share: &Path) -> PathBuf {
    share
        .parent()
        .and_then(Path::parent)
        .unwrap_or(share)
        .to_owned()
}

/// The variables that name workspaces, without this stub's overlay: what the original starts finds originals, too.
pub fn environment(overlay: &Path) -> Vec<(&'static str, OsString)> {
    ["CMAKE_PREFIX_PATH", "ROS_PACKAGE_PATH"]
        .into_iter()
        .filter_map(|name| {
            let value = std::env::var_os(name)?;
            let kept = std::env::split_paths(&value)
                .filter(|entry| !within(entry, overlay))
                .collect::<Vec<_>>();
            Some((name, std::env::join_paths(kept).ok()?))
        })
        .collect()
}

fn within(path: &Path, overlay: &Path) -> bool {
    let canonical = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.to_owned());
    canonical(path).starts_with(canonical(overlay))
}

/// The next executable of this name after the stub, with variables from `variable`.
pub fn find(node: &Node, variable: &dyn Fn(&str) -> Option<String>) -> Option<PathBuf> {
    let overlay = overlay(&node.share);
    let entries = |name| {
        let value = variable(name).unwrap_or_default();
        std::env::split_paths(&value)
            .filter(|entry| entry.is_absolute() && !within(entry, &overlay))
            .collect::<Vec<_>>()
    };
    let mut prefixes = entries("CMAKE_PREFIX_PATH");
    prefixes.retain(|prefix| prefix.join(".catkin").exists());
    prefixes.push("/usr".into());
    if let Some(distribution) = variable("ROS_DISTRO") {
        prefixes.push(Path::new("/opt/ros").join(distribution));
    }
    let in_prefixes = prefixes.iter().find_map(|prefix| {
        let direct = prefix.join("lib").join(&node.package).join(&node.node);
        if is_executable(&direct) {
            return Some(direct);
        }
        let mut below = vec![prefix.join("share").join(&node.package)];
        below.extend(
            sources(prefix)
                .into_iter()
                .flat_map(|source| packages(&source, &node.package)),
        );
        below
            .iter()
            .find_map(|place| below_package(place, &node.node))
    });
    in_prefixes.or_else(|| {
        entries("ROS_PACKAGE_PATH")
            .iter()
            .flat_map(|entry| packages(entry, &node.package))
            .find_map(|place| below_package(&place, &node.node))
    })
}

/// The source spaces of a development space.
fn sources(prefix: &Path) -> Vec<PathBuf> {
    let listed = std::fs::read_to_string(prefix.join(".catkin")).unwrap_or_default();
    listed
        .trim()
        .split(';')
        .filter(|path| !path.is_empty())
        .map(PathBuf::from)
        .collect()
}

/// Directories at or below `root` that hold the package.
fn packages(root: &Path, package: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = VecDeque::from([(root.to_owned(), 0)]);
    while let Some((directory, depth)) = open.pop_front() {
        if directory.join("package.xml").is_file() {
            let text = std::fs::read_to_string(directory.join("package.xml")).unwrap_or_default();
            if text.contains(&format!("<name>{package}</name>")) {
                found.push(directory);
            }
            continue;
        }
        if depth < DEPTH && !directory.join("CATKIN_IGNORE").exists() {
            open.extend(
                children(&directory)
                    .into_iter()
                    .map(|child| (child, depth + 1)),
            );
        }
    }
    found
}

/// An executable of this name at or below a package's directory.
fn below_package(directory: &Path, node: &str) -> Option<PathBuf> {
    let mut open = VecDeque::from([(directory.to_owned(), 0)]);
    while let Some((directory, depth)) = open.pop_front() {
        let here = directory.join(node);
        if is_executable(&here) {
            return Some(here);
        }
        if depth < DEPTH {
            open.extend(
                children(&directory)
                    .into_iter()
                    .map(|child| (child, depth + 1)),
            );
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

/// Executable, and not the stub under another name.
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

    fn executable(path: &Path) {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, "#!/bin/sh\n").unwrap();
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o755)).unwrap();
    }

    #[test]
    fn the_next_workspace_is_found_and_the_stub_is_not() {
        let root = tempfile::tempdir().unwrap();
        let (stub, next) = (root.path().join("stub"), root.path().join("next"));
        for prefix in [&stub, &next] {
            executable(&prefix.join("lib/a_package_of_the_test/node"));
            std::fs::create_dir_all(prefix.join("share/a_package_of_the_test")).unwrap();
            std::fs::write(prefix.join(".catkin"), "").unwrap();
        }
        let node = Node {
            package: "a_package_of_the_test".into(),
            node: "node".into(),
            share: stub.join("share/a_package_of_the_test"),
        };
        let paths = format!("{}:{}", stub.display(), next.display());
        let found = find(&node, &|name| {
            (name == "CMAKE_PREFIX_PATH").then(|| paths.clone())
        });
        assert_eq!(found, Some(next.join("lib/a_package_of_the_test/node")));
        let alone = find(&node, &|name| {
            (name == "CMAKE_PREFIX_PATH").then(|| stub.display().to_string())
        });
        assert_eq!(alone, None);
    }

    #[test]
    fn a_source_space_is_searched() {
        let root = tempfile::tempdir().unwrap();
        let place = root.path().join("src/meta/a_package_of_the_test");
        executable(&place.join("scripts/node.py"));
        std::fs::write(
            place.join("package.xml"),
            "<package><name>a_package_of_the_test</name></package>",
        )
        .unwrap();
        let node = Node {
            package: "a_package_of_the_test".into(),
            node: "node.py".into(),
            share: root.path().join("stub/share/a_package_of_the_test"),
        };
        let paths = root.path().join("src").display().to_string();
        let found = find(&node, &|name| {
            (name == "ROS_PACKAGE_PATH").then(|| paths.clone())
        });
        assert_eq!(found, Some(place.join("scripts/node.py")));
    }
}
