//! ROS packages that are already in the install spaces of layers: packages of a base, from wheels, apt or an image,
//! need not be listed anywhere else.

use std::collections::BTreeSet;
use std::path::PathBuf;

use ros::flavour::Version;
use serde::{Deserialize, Serialize};

use crate::archive::Archive;
use crate::base::Base;
use crate::blocking;
use crate::cache::LayerCache;
use crate::error::Error;
use crate::key::Key;

/// Existing packages.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct IndexedPackages {
    /// Available while compiling.
    pub(crate) build: BTreeSet<String>,
    /// Available at run time.
    pub(crate) run: BTreeSet<String>,
    /// Python modules available at run time, which may have other names than their packages.
    pub(crate) modules: BTreeSet<String>,
}

/// Returns the directories of shared libraries searched by a base's own programs, relative to the root.
pub(crate) fn library_directories(base: &Base) -> Vec<String> {
    let mut places: Vec<String> =
        base.install_prefixes().iter().map(|prefix| format!("{}/lib", prefix.trim_matches('/'))).collect();
    if !places.is_empty() {
        let given = base.environment.get("LD_LIBRARY_PATH");
        let given = given.map_or("", String::as_str).split(':');
        let given = given.map(|place| place.trim_matches('/'));
        places.extend(given.filter(|place| !place.is_empty()).map(str::to_owned));
    }
    places
}

/// Returns the key of the note with the packages of a base, which covers what they are selected by.
fn known_key(base: &Base, archive: &Archive) -> String {
    Key::new("indexed")
        .input("system", base.system_key())
        .inputs("toolchain", &base.build.packages)
        .input("runtime", base.required.runtime.key())
        .input("tools", base.required.build.key())
        .inputs("prefixes", base.install_prefixes())
        .input("lists", &archive.stamp)
        .finish()
}

/// Returns the packages of a base as the last build with the same package lists found them. Blocking.
pub(crate) fn read_known(layers: &LayerCache, base: &Base, archive: &Archive) -> Option<IndexedPackages> {
    layers.read_note(&known_key(base, archive))
}

/// Keeps the packages of a base for [`read_known`]. Blocking.
pub(crate) fn write_known(
    layers: &LayerCache,
    base: &Base,
    archive: &Archive,
    there: &IndexedPackages,
) -> Result<(), Error> {
    layers.write_note(&known_key(base, archive), there)
}

/// Returns the packages in the install spaces of trees, given lowest first: of ROS 2 by ament's index, of ROS 1 by
/// their package.xml.
pub(crate) async fn find_packages(base: &Base, trees: Vec<PathBuf>) -> Result<BTreeSet<String>, Error> {
    let prefixes = base.install_prefixes();
    if prefixes.is_empty() {
        return Ok(BTreeSet::new());
    }
    let ros = base.ros;
    blocking::spawn_reader(move || list_packages(ros, &trees, &prefixes)).await?
}

/// Returns the Python modules in the install spaces of trees, given lowest first.
pub(crate) async fn find_modules(base: &Base, trees: Vec<PathBuf>) -> Result<BTreeSet<String>, Error> {
    let prefixes = base.install_prefixes();
    Ok(blocking::spawn_reader(move || package::ament::modules(&trees, &prefixes)).await??)
}

/// Returns the packages in install spaces of trees, given lowest first. Blocking.
pub(crate) fn list_packages(ros: Version, trees: &[PathBuf], prefixes: &[String]) -> Result<BTreeSet<String>, Error> {
    Ok(match ros {
        Version::Ros1 => package::inventory::find_manifests(trees, prefixes)?,
        Version::Ros2 => package::ament::packages(trees, prefixes)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;
    use std::path::Path;

    fn base(ros: Version) -> Base {
        let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
        let mut base = crate::base::load(&images, crate::DEFAULT_BASE).expect("valid");
        base.definition.ros = ros;
        base.definition.ros_distribution = "jazzy".to_owned();
        let variables =
            [("AMENT_PREFIX_PATH", "/opt/wheels:relative:"), ("LD_LIBRARY_PATH", "/opt/wheels/lib:/opt/more")];
        base.definition.environment = variables.map(|(name, value)| (name.to_owned(), value.to_owned())).into();
        base.definition.build.environment =
            BTreeMap::from([("CMAKE_PREFIX_PATH".to_owned(), "/opt/tools:/opt/wheels".to_owned())]);
        base
    }

    #[test]
    fn spaces_are_those_that_the_base_names() {
        let two = base(Version::Ros2);
        assert_eq!(two.install_prefixes(), ["/opt/wheels", "/opt/tools", "/opt/ros/jazzy"]);
        assert_eq!(
            library_directories(&two),
            ["opt/wheels/lib", "opt/tools/lib", "opt/ros/jazzy/lib", "opt/wheels/lib", "opt/more"]
        );
        let mut one = base(Version::Ros1);
        one.definition.build.environment.clear();
        let prefix = |prefix: &str| [("CMAKE_PREFIX_PATH".to_owned(), prefix.to_owned())].into();
        one.definition.environment = prefix("/usr");
        assert!(one.install_prefixes().is_empty() && library_directories(&one).is_empty());
        assert!(one.has_distributions_ros());
        one.definition.environment = prefix("/home/robot/install:/opt/ros/noetic");
        assert_eq!(one.install_prefixes(), ["/home/robot/install", "/opt/ros/noetic"]);
        assert_eq!(library_directories(&one), ["home/robot/install/lib", "opt/ros/noetic/lib"]);
        assert!(!one.has_distributions_ros());
    }

    #[tokio::test]
    async fn packages_are_found_by_looking() {
        let tree = tempfile::tempdir().expect("a directory");
        for (prefix, name) in [("opt/wheels", "rclpy"), ("opt/ros/jazzy", "std_msgs"), ("opt/elsewhere", "hidden")] {
            let index = tree.path().join(prefix).join("share/ament_index/resource_index/packages");
            std::fs::create_dir_all(&index).expect("made");
            std::fs::write(index.join(name), "").expect("written");
        }
        let trees = vec![tree.path().to_owned()];
        let found = find_packages(&base(Version::Ros2), trees.clone()).await.expect("read");
        let names: Vec<&str> = found.iter().map(String::as_str).collect();
        assert_eq!(names, ["rclpy", "std_msgs"]);
        for (path, text) in [("roscpp/package.xml", "<package/>"), ("doc/readme", "")] {
            let path = tree.path().join("opt/wheels/share").join(path);
            std::fs::create_dir_all(path.parent().expect("below")).expect("made");
            std::fs::write(path, text).expect("written");
        }
        let found = find_packages(&base(Version::Ros1), trees).await.expect("read");
        assert_eq!(found.into_iter().collect::<Vec<_>>(), ["roscpp"]);
    }
}
