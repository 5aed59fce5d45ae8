//! Content of `package.xml` files and plugin lists that is relevant to a build.

use std::collections::BTreeSet;
use std::path::Path;

use package::condition::Variables;
use package::manifest::{Kind, Manifest};

use crate::base::Base;

/// Returns the rosdep keys and ROS packages that the package needs at run time.
pub(crate) fn run_dependencies(text: &str, path: &Path, base: &Base) -> Result<BTreeSet<String>, package::Error> {
    let manifest = Manifest::parse(
        text,
        path,
        &Variables::for_distribution(base.ros.ros_version().number(), &base.ros_distribution),
    )?;
    Ok(manifest.needs(&[Kind::Exec]).into_iter().map(str::to_owned).collect())
}

/// A library of a plugin list.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct PluginLibrary {
    /// File name: `libx.so`.
    pub(crate) name: String,
    /// True if the list states a directory (`lib/libx`), so that pluginlib looks nowhere else.
    pub(crate) in_directory: bool,
}

/// Returns the libraries of a plugin list (pluginlib: a single `library`, or several in `class_libraries`); empty for
/// other files.
pub(crate) fn plugin_libraries(text: &str) -> BTreeSet<PluginLibrary> {
    let Ok(document) = package::xml::parse(text) else {
        return BTreeSet::new();
    };
    let root = document.root_element();
    let is_library = |node: &roxmltree::Node<'_, '_>| node.has_tag_name("library");
    let libraries: Vec<_> = match root.tag_name().name() {
        "library" => vec![root],
        "class_libraries" => root.children().filter(is_library).collect(),
        _ => Vec::new(),
    };
    let paths = libraries.iter().filter_map(|library| library.attribute("path"));
    let cut = paths.map(|path| (path.rsplit('/').next().unwrap_or(path), path.contains('/')));
    cut.filter(|(name, _)| !name.is_empty())
        .map(|(name, in_directory)| PluginLibrary { name: file_name(name), in_directory })
        .collect()
}

fn file_name(name: &str) -> String {
    if name.ends_with(".so") { name.to_owned() } else { format!("{name}.so") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn libraries_of_either_form_are_found() {
        let library = |name: &str, in_directory| PluginLibrary { name: name.to_owned(), in_directory };
        let one = "<library path=\"lib/libimage_proc\"><class/></library>";
        assert_eq!(plugin_libraries(one), [library("libimage_proc.so", true)].into());
        let many = "<class_libraries><library path=\"liba\"/><library path=\"lib/libb.so\"/></class_libraries>";
        assert_eq!(plugin_libraries(many), [library("liba.so", false), library("libb.so", true)].into());
        for other in ["<launch><library path=\"x\"/></launch>", "not xml", ""] {
            assert!(plugin_libraries(other).is_empty(), "{other}");
        }
    }
}
