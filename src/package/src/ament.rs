//! The ament resource index of ROS 2 install spaces (`share/ament_index/resource_index/KIND/PACKAGE`): packages, and
//! what they have registered.

use std::collections::BTreeSet;
use std::path::Path;

use crate::merged::{self, LayerDirectory, MergedDirectory};
use crate::{Error, names};

const INDEX: &str = "share/ament_index/resource_index";
/// Maximum size of a resource in bytes.
const MAX_BYTES: u64 = 64 << 10;
/// Maximum number of component classes of a package.
const MAX_COMPONENTS: usize = 1000;

/// Returns the names of the packages in the indexes of install spaces (absolute paths in the layers). `layers` are
/// extracted trees, lowest first. Blocking.
pub fn packages<L: AsRef<Path>, P: AsRef<str>>(layers: &[L], prefixes: &[P]) -> Result<BTreeSet<String>, Error> {
    let stack = merged::open_layers(layers)?;
    let mut found = BTreeSet::new();
    for prefix in prefixes {
        found.extend(packages_in(&stack, prefix.as_ref())?);
    }
    Ok(found)
}

/// Returns the names of the Python modules in install spaces (absolute paths in the layers), which lie in
/// `lib/pythonX.Y/site-packages`. `layers` are extracted trees, lowest first. Blocking.
pub fn modules<L: AsRef<Path>, P: AsRef<str>>(layers: &[L], prefixes: &[P]) -> Result<BTreeSet<String>, Error> {
    let stack = merged::open_layers(layers)?;
    let mut found = BTreeSet::new();
    for prefix in prefixes {
        let library = MergedDirectory::open_path(&stack, &format!("{}/lib", prefix.as_ref()))?;
        for version in library.names()?.into_keys().filter(|name| name.starts_with(b"python3")) {
            let modules = library.open_child(&version)?.open_child(b"site-packages")?;
            let names = modules.names()?.into_keys();
            let names = names.filter_map(|name| String::from_utf8(name).ok());
            found.extend(names.filter(|name| names::is_type(name)));
        }
    }
    Ok(found)
}

pub(crate) fn packages_in(stack: &[LayerDirectory], prefix: &str) -> Result<BTreeSet<String>, Error> {
    let index = MergedDirectory::open_path(stack, &format!("{prefix}/{INDEX}/packages"))?;
    let names = index.names()?.into_keys();
    let names = names.filter_map(|name| String::from_utf8(name).ok());
    Ok(names.filter(|name| names::is_package(name)).collect())
}

/// Returns the component classes registered by a package (`rclcpp_components`), each with its library, relative to the
/// install space.
pub(crate) fn components(
    stack: &[LayerDirectory],
    prefix: &str,
    package: &str,
) -> Result<Vec<(String, String)>, Error> {
    let index = MergedDirectory::open_path(stack, &format!("{prefix}/{INDEX}/rclcpp_components"))?;
    let names = index.names()?;
    let Some(level) = names.get(package.as_bytes()) else {
        return Ok(Vec::new());
    };
    let Some(file) = level.file(package.as_bytes(), MAX_BYTES)? else {
        return Ok(Vec::new());
    };
    let text = String::from_utf8_lossy(&file.bytes);
    let lines = text.lines().filter_map(|line| line.split_once(';'));
    let good = lines.filter(|(class, library)| names::is_class(class) && names::is_library(library));
    let owned = good.map(|(class, library)| (class.to_owned(), library.to_owned()));
    Ok(owned.take(MAX_COMPONENTS).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modules_are_directories_of_site_packages() {
        let root = tempfile::tempdir().expect("a directory");
        for path in ["python3.11/site-packages/tf2_ros/a", "python3.11/site-packages/tf2_ros-1.0.dist-info/a", "x/y/z"]
        {
            std::fs::create_dir_all(root.path().join("opt/ros/jazzy/lib").join(path)).expect("made");
        }
        let found = modules(&[root.path()], &["/opt/ros/jazzy", "/opt/none"]).expect("read");
        assert_eq!(found, BTreeSet::from(["tf2_ros".to_owned()]));
    }

    #[test]
    fn packages_of_all_spaces_and_layers_are_found() {
        let root = tempfile::tempdir().expect("a directory");
        let write = |path: &str| {
            let path = root.path().join(path);
            std::fs::create_dir_all(path.parent().expect("below")).expect("made");
            std::fs::write(path, "").expect("written");
        };
        for (prefix, name) in [
            ("low/opt/ros/jazzy", "rclpy"),
            ("high/opt/ros/jazzy", "std_msgs"),
            ("high/opt/mine", "p"),
            ("high/opt/mine", "no name"),
            ("high/opt/hidden", "q"),
        ] {
            write(&format!("{prefix}/{INDEX}/packages/{name}"));
        }
        let layers = ["low", "high"].map(|layer| root.path().join(layer));
        let found = packages(&layers, &["/opt/ros/jazzy", "/opt/mine", "/opt/none"]);
        let found = found.expect("read");
        let names: Vec<&str> = found.iter().map(String::as_str).collect();
        assert_eq!(names, ["p", "rclpy", "std_msgs"]);
    }
}
