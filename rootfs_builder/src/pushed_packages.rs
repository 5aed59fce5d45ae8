//! Properties of the pushed packages that are relevant to a build.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::Path;

use foreign::Visit;
use package::condition::Variables;
use package::manifest::{Kind, Manifest};
use package::selection::{self, PackageQuery};
use package::workspace::{self, Package, PushedDirectory};
use ros::bus::RosVersion;
use rustix::fs::FileType;

use crate::base::Base;
use crate::error::Error;
use crate::keys::RequiredKeys;
use crate::launch::LaunchNode;

/// A pushed tree, and what of it is not built.
#[derive(Debug)]
pub(crate) struct InspectedTree {
    pub(crate) pushed: PushedDirectory,
    /// Names of packages that are not built.
    pub(crate) left_out: Vec<String>,
}

/// Inspects a pushed tree, and selects the packages to build. Blocking.
pub(crate) fn inspect_pushed(root: &Path, base: &Base, query: &PackageQuery<'_>) -> Result<InspectedTree, Error> {
    let version = base.ros.ros_version();
    let variables = Variables::for_distribution(version.number(), &base.ros_distribution);
    let mut pushed = workspace::inspect(root, &variables)?;
    let mut left_out = Vec::new();
    if let PushedDirectory::Source(sources) = &mut pushed {
        left_out = selection::select_packages(sources, query, version)?;
        for Package { manifest, .. } in &sources.packages {
            if !manifest.supports_ros(version) {
                return Err(Error::BuildType {
                    package: manifest.name.clone(),
                    build_type: manifest.build_type.clone(),
                    base: base.name.clone(),
                    builds: supported_build_types(version),
                });
            }
        }
    }
    Ok(InspectedTree { pushed, left_out })
}

fn supported_build_types(version: RosVersion) -> &'static str {
    match version {
        RosVersion::One => "catkin and cmake",
        RosVersion::Two => "ament_cmake, ament_python and cmake",
    }
}

/// Returns the external dependencies of the packages.
pub(crate) fn required_keys(packages: &[Package]) -> RequiredKeys {
    let manifests = packages.iter().map(|package| (&package.manifest.name, &package.manifest));
    let manifests: BTreeMap<&String, &Manifest> = manifests.collect();
    let mut asked = RequiredKeys::default();
    for external in workspace::external_dependencies(packages) {
        let needs = |kinds: &[Kind]| kinds.iter().any(|kind| external.kinds.contains(kind));
        if needs(&[Kind::Buildtool, Kind::BuildtoolExport, Kind::Build, Kind::BuildExport]) {
            asked.build.insert(external.name.clone(), external.needed_by.clone());
        }
        if needs(&[Kind::Exec]) {
            asked.run.insert(external.name.clone(), external.needed_by.clone());
        }
        let mut needing = external.needed_by.iter().filter_map(|name| manifests.get(name));
        if needing.all(|manifest| manifest.needs_as_module(&external.name)) {
            asked.modules.insert(external.name);
        }
    }
    asked
}

/// Returns the names of packages.
pub(crate) fn names(packages: &[Package]) -> BTreeSet<String> {
    packages.iter().map(|package| package.manifest.name.clone()).collect()
}

/// Sorts the names of packages by importance: first those that no other one needs; of several, the last in build order.
pub(crate) fn sort_by_importance(packages: &[Package]) -> Vec<String> {
    let mut names: Vec<String> = packages
        .iter()
        .rev()
        .filter(|package| !package.manifest.metapackage)
        .chain(packages.iter().filter(|package| package.manifest.metapackage))
        .map(|package| package.manifest.name.clone())
        .collect();
    let needed = |name: &String| {
        packages.iter().any(|package| package.manifest.dependencies.iter().any(|need| need.name == *name))
    };
    // A stable sort keeps the order among equals.
    names.sort_by_key(needed);
    names
}

/// Returns the main package of a push, which determines the names of the service and the stub: of `packages`, most
/// important first, the first one of which a program is run, or else the first.
pub(crate) fn main_package(packages: &[String], nodes: &[LaunchNode]) -> String {
    let runs = |package: &&String| nodes.iter().any(|node| node.package == **package);
    let first = packages.iter().find(runs).or(packages.first());
    first.cloned().unwrap_or_default()
}

/// Returns the versions of packages, by name.
pub(crate) fn versions(packages: &[Package]) -> BTreeMap<String, String> {
    let all = packages.iter().map(|package| &package.manifest);
    all.map(|of| (of.name.clone(), of.version.clone())).collect()
}

/// Returns build tools that installed packages declare as `<depend>`, which are not needed at run time.
pub(crate) fn build_tools(asked: &RequiredKeys) -> BTreeSet<String> {
    let is_tool = |name: &&String| name.starts_with("ament_cmake") || *name == "rosidl_default_generators";
    asked.run.keys().filter(is_tool).cloned().collect()
}

/// Returns whether a tree contains Python files that are used at run time, other than build files (`setup.py`,
/// dynamic_reconfigure's `.cfg`) and the modules that catkin generates for messages.
pub(crate) fn has_python(root: &Path) -> bool {
    let generated = |path: &Path| {
        let parent = path.parent().and_then(Path::file_name).unwrap_or_default();
        let setup = path.file_name().is_some_and(|name| name == "setup.py" || name == "_setup_util.py");
        setup || ["msg", "srv", "cfg", "test", "tests"].iter().any(|name| parent == *name)
    };
    let runs = |entry: &foreign::WalkEntry<'_>| {
        let extension = entry.path.extension().unwrap_or_default();
        if extension == "py" {
            return entry.stat.st_size > 0;
        }
        let mut start = [0; 64];
        let read = entry.open().map(|mut file| file.read(&mut start).unwrap_or(0)).unwrap_or(0);
        let first = start[..read].split(|byte| *byte == b'\n').next().unwrap_or_default();
        extension != "cfg" && first.starts_with(b"#!") && first.windows(6).any(|word| word == b"python")
    };
    let mut found = false;
    // Unreadable files are reported by those who need them.
    let _ = foreign::walk(root, |entry| {
        let regular = entry.kind() == FileType::RegularFile;
        found |= regular && !found && !generated(entry.path) && runs(entry);
        Ok::<_, foreign::Error>(if found { Visit::Skip } else { Visit::Into })
    });
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn workspace(packages: &[(&str, &str)]) -> (tempfile::TempDir, PushedDirectory) {
        let root = tempfile::tempdir().expect("a directory");
        for (name, rest) in packages {
            let directory = root.path().join("src").join(name);
            std::fs::create_dir_all(&directory).expect("made");
            let text = format!(
                "<package format=\"2\"><name>{name}</name><version>1.2.3</version><description>d</description>\
                 <maintainer email=\"a@b.invalid\">m</maintainer><license>l</license>{rest}</package>"
            );
            std::fs::write(directory.join("package.xml"), text).expect("written");
        }
        let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
        let base = crate::base::load(&images, crate::DEFAULT_BASE).expect("valid");
        let pushed = inspect_pushed(root.path(), &base, &PackageQuery::default()).expect("a workspace").pushed;
        (root, pushed)
    }

    #[test]
    fn the_package_that_nobody_needs_is_the_one_meant() {
        let (_root, pushed) = workspace(&[
            ("app", "<depend>aa_msgs</depend><exec_depend>python3-numpy</exec_depend>"),
            ("aa_msgs", "<depend>std_msgs</depend>"),
        ]);
        assert_eq!(sort_by_importance(pushed.packages()), ["app", "aa_msgs"]);
        let versions = versions(pushed.packages());
        assert_eq!(versions["app"], "1.2.3");
    }

    #[test]
    fn a_push_is_about_the_package_whose_program_runs() {
        let packages = ["tools", "app", "driver"].map(str::to_owned);
        let node = |package: &str| LaunchNode {
            name: "/it".to_owned(),
            package: package.to_owned(),
            executable: "it".to_owned(),
            argv: Vec::new(),
            remaps: BTreeMap::new(),
            environment: BTreeMap::new(),
            directory: None,
            respawn: false,
            respawn_delay: 0.0,
            required: false,
            named: true,
        };
        assert_eq!(main_package(&packages, &[node("driver"), node("app")]), "app");
        assert_eq!(main_package(&packages, &[node("of_debian")]), "tools");
        assert_eq!(main_package(&[], &[node("app")]), "");
    }

    #[test]
    fn what_installed_packages_were_compiled_with_is_a_tool() {
        let (_root, pushed) = workspace(&[(
            "app",
            "<depend>ament_cmake</depend><depend>rosidl_default_generators</depend><depend>rclcpp</depend>",
        )]);
        let tools = build_tools(&required_keys(pushed.packages()));
        let tools: Vec<&str> = tools.iter().map(String::as_str).collect();
        assert_eq!(tools, ["ament_cmake", "rosidl_default_generators"]);
    }

    #[test]
    fn needs_are_sorted_by_when_they_matter() {
        let (_root, pushed) = workspace(&[
            ("app", "<depend>app_msgs</depend><exec_depend>python3-numpy</exec_depend>"),
            ("app_msgs", "<build_depend>message_generation</build_depend><depend>std_msgs</depend>"),
        ]);
        let asked = required_keys(pushed.packages());
        assert_eq!(asked.build.keys().collect::<Vec<_>>(), ["message_generation", "std_msgs"]);
        assert_eq!(asked.run.keys().collect::<Vec<_>>(), ["python3-numpy", "std_msgs"]);
        assert!(asked.run["std_msgs"].contains("app_msgs"));
    }

    #[test]
    fn what_this_base_cannot_build_is_refused() {
        let root = tempfile::tempdir().expect("a directory");
        std::fs::write(
            root.path().join("package.xml"),
            "<package format=\"3\"><name>p</name><version>1.0.0</version><description>d</description>\
             <maintainer email=\"a@b.invalid\">m</maintainer><license>l</license>\
             <export><build_type>ament_cmake</build_type></export></package>",
        )
        .expect("written");
        let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
        let base = crate::base::load(&images, crate::DEFAULT_BASE).expect("valid");
        let error = inspect_pushed(root.path(), &base, &PackageQuery::default()).expect_err("ROS 2").to_string();
        assert!(error.contains("build type ament_cmake"), "{error}");
    }

    #[test]
    fn python_that_runs_is_told_from_python_that_builds() {
        let root = tempfile::tempdir().expect("a directory");
        let write = |path: &str, text: &str| {
            let path = root.path().join(path);
            std::fs::create_dir_all(path.parent().expect("below")).expect("made");
            std::fs::write(path, text).expect("written");
        };
        write("setup.py", "from distutils import setup");
        write("cfg/X.cfg", "#!/usr/bin/env python\n");
        write("lib/python3/dist-packages/x/__init__.py", "");
        write("lib/python3/dist-packages/x/msg/_Y.py", "class Y: pass");
        write("src/x.cpp", "int main() {}");
        assert!(!has_python(root.path()));
        write("scripts/node", "#!/usr/bin/env python3\n");
        assert!(has_python(root.path()));
    }
}
