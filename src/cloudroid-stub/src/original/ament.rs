//! Finds executables as `ros2 run` and launch files do (ROS 2): in `lib/PKG` of an install space, which also holds
//! console scripts of Python packages.

use std::path::{Path, PathBuf};

use super::{OriginalSearch, find_below, is_executable};

/// Returns the next executable of this name after the stub.
pub fn find(search: &OriginalSearch<'_>) -> Option<PathBuf> {
    let mut prefixes = search.entries("AMENT_PREFIX_PATH");
    // Output of colcon: one install space for all packages, or one for each.
    for installed in search.entries("COLCON_PREFIX_PATH") {
        prefixes.push(installed.join(&search.node.package));
        prefixes.push(installed);
    }
    prefixes.extend(search.distribution());
    prefixes.iter().find_map(|prefix| in_prefix(prefix, search))
}

fn in_prefix(prefix: &Path, search: &OriginalSearch<'_>) -> Option<PathBuf> {
    let node = search.node;
    let direct = prefix.join("lib").join(&node.package).join(&node.node);
    if is_executable(&direct) {
        return Some(direct);
    }
    // Programs in a package's share directory have launchers in the stub, too.
    find_below(&prefix.join("share").join(&node.package), &node.node)
}

#[cfg(test)]
mod tests {
    use super::super::tests::executable;
    use super::super::{find, without_overlay};
    use crate::arguments::NodeArgs;

    #[test]
    fn the_next_install_space_is_found_and_the_stub_is_not() {
        let root = tempfile::tempdir().unwrap();
        let root = root.path();
        let (stub, other, merged, isolated) =
            (root.join("stub"), root.join("other"), root.join("merged"), root.join("isolated"));
        executable(&stub.join("lib/p/node"));
        executable(&merged.join("lib/p/node"));
        executable(&isolated.join("p/lib/p/node"));
        executable(&merged.join("share/p/tools/shared"));
        std::fs::create_dir_all(other.join("lib/p")).unwrap();
        std::fs::write(other.join("lib/p/node"), "no program").unwrap();
        let share = stub.join("share/p");
        std::fs::create_dir_all(&share).unwrap();
        std::fs::write(share.join("revision.toml"), "ros = 2\n").unwrap();
        let found = |node: &str, ament: &[&std::path::Path], colcon: &[&std::path::Path]| {
            let node = NodeArgs { package: "p".into(), node: node.into(), share: share.clone() };
            let list = |paths: &[&std::path::Path]| {
                let list = std::env::join_paths(paths).unwrap();
                Some(list.into_string().unwrap())
            };
            find(&node, &|name| match name {
                "AMENT_PREFIX_PATH" => list(ament),
                "COLCON_PREFIX_PATH" => list(colcon),
                // A ROS 1 variable.
                "CMAKE_PREFIX_PATH" => list(&[&merged]),
                _ => None,
            })
        };
        assert_eq!(found("node", &[&stub, &other, &merged], &[]), Some(merged.join("lib/p/node")));
        assert_eq!(found("node", &[&stub], &[&isolated]), Some(isolated.join("p/lib/p/node")));
        assert_eq!(found("node", &[&stub], &[&merged]), Some(merged.join("lib/p/node")));
        assert_eq!(found("shared", &[&stub, &merged], &[]), Some(merged.join("share/p/tools/shared")));
        assert_eq!(found("node", &[&stub, &other], &[]), None);
        let left = std::env::join_paths([&stub, &merged]).unwrap();
        assert_eq!(without_overlay(&left, &stub), Some(merged.into_os_string()));
    }
}
