//! Finds executables as rosrun and roslaunch do (ROS 1).

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use super::{DEPTH, OriginalSearch, children, find_below, is_executable};

/// Returns the next executable of this name after the stub.
pub fn find(search: &OriginalSearch<'_>) -> Option<PathBuf> {
    let node = search.node;
    let mut prefixes = search.entries("CMAKE_PREFIX_PATH");
    prefixes.retain(|prefix| prefix.join(".catkin").exists());
    prefixes.push("/usr".into());
    prefixes.extend(search.distribution());
    let in_prefixes = prefixes.iter().find_map(|prefix| {
        let direct = prefix.join("lib").join(&node.package).join(&node.node);
        if is_executable(&direct) {
            return Some(direct);
        }
        let mut below = vec![prefix.join("share").join(&node.package)];
        below.extend(sources(prefix).into_iter().flat_map(|source| packages(&source, &node.package)));
        below.iter().find_map(|place| find_below(place, &node.node))
    });
    in_prefixes.or_else(|| {
        search
            .entries("ROS_PACKAGE_PATH")
            .iter()
            .flat_map(|entry| packages(entry, &node.package))
            .find_map(|place| find_below(&place, &node.node))
    })
}

/// Returns the source spaces of a development space.
fn sources(prefix: &Path) -> Vec<PathBuf> {
    let listed = std::fs::read_to_string(prefix.join(".catkin")).unwrap_or_default();
    listed.trim().split(';').filter(|path| !path.is_empty()).map(PathBuf::from).collect()
}

/// Returns the directories at or below `root` that contain the package.
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
            open.extend(children(&directory).into_iter().map(|child| (child, depth + 1)));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::super::find;
    use super::super::tests::executable;
    use crate::arguments::NodeArgs;

    #[test]
    fn the_next_workspace_is_found_and_the_stub_is_not() {
        let root = tempfile::tempdir().unwrap();
        let (stub, next) = (root.path().join("stub"), root.path().join("next"));
        for prefix in [&stub, &next] {
            executable(&prefix.join("lib/a_package_of_the_test/node"));
            std::fs::create_dir_all(prefix.join("share/a_package_of_the_test")).unwrap();
            std::fs::write(prefix.join(".catkin"), "").unwrap();
        }
        let node = NodeArgs {
            package: "a_package_of_the_test".into(),
            node: "node".into(),
            share: stub.join("share/a_package_of_the_test"),
        };
        let paths = format!("{}:{}", stub.display(), next.display());
        let found = find(&node, &|name| (name == "CMAKE_PREFIX_PATH").then(|| paths.clone()));
        assert_eq!(found, Some(next.join("lib/a_package_of_the_test/node")));
        let alone = find(&node, &|name| (name == "CMAKE_PREFIX_PATH").then(|| stub.display().to_string()));
        assert_eq!(alone, None);
    }

    #[test]
    fn a_source_space_is_searched() {
        let root = tempfile::tempdir().unwrap();
        let place = root.path().join("src/meta/a_package_of_the_test");
        executable(&place.join("scripts/node.py"));
        std::fs::write(place.join("package.xml"), "<package><name>a_package_of_the_test</name></package>").unwrap();
        let node = NodeArgs {
            package: "a_package_of_the_test".into(),
            node: "node.py".into(),
            share: root.path().join("stub/share/a_package_of_the_test"),
        };
        let paths = root.path().join("src").display().to_string();
        let found = find(&node, &|name| (name == "ROS_PACKAGE_PATH").then(|| paths.clone()));
        assert_eq!(found, Some(place.join("scripts/node.py")));
    }
}
