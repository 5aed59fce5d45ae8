//! What was pushed, as far as a build asks.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::Path;

use foreign::Visit;
use package::condition::Variables;
use package::manifest::Kind;
use package::workspace::{self, Package, Pushed};
use ros::bus::RosVersion;
use rustix::fs::FileType;

use crate::base::Base;
use crate::error::Error;
use crate::keys::Needed;
use crate::launch::LaunchNode;

/// Looks at a pushed tree.
pub(crate) fn inspect(root: &Path, base: &Base) -> Result<Pushed, Error> {
    let version = base.ros.bus();
    let variables = Variables::ros(version.number(), &base.ros_distribution);
    let pushed = workspace::inspect(root, &variables)?;
    if let Pushed::Source(sources) = &pushed {
        for Package { manifest, .. } in &sources.packages {
            if !manifest.fits(version) {
                return Err(Error::BuildType {
                    package: manifest.name.clone(),
                    build_type: manifest.build_type.clone(),
                    base: base.name.clone(),
                    builds: builds(version),
                });
            }
        }
    }
    Ok(pushed)
}

fn builds(version: RosVersion) -> &'static str {
    match version {
        RosVersion::One => "catkin and cmake",
        RosVersion::Two => "ament_cmake, ament_python and cmake",
    }
}

/// What its packages need from elsewhere.
pub(crate) fn asked(packages: &[Package]) -> Needed {
    let mut asked = Needed::default();
    for external in workspace::external(packages) {
        let needs = |kinds: &[Kind]| kinds.iter().any(|kind| external.kinds.contains(kind));
        if needs(&[
            Kind::Buildtool,
            Kind::BuildtoolExport,
            Kind::Build,
            Kind::BuildExport,
        ]) {
            asked
                .build
                .insert(external.name.clone(), external.needed_by.clone());
        }
        if needs(&[Kind::Exec]) {
            asked
                .run
                .insert(external.name.clone(), external.needed_by.clone());
        }
    }
    asked
}

/// Names of packages.
pub(crate) fn names(packages: &[Package]) -> BTreeSet<String> {
    packages
        .iter()
        .map(|package| package.manifest.name.clone())
        .collect()
}

/// Most important first: the one that none of the others needs, the last in the order of building when there are several.
pub(crate) fn by_importance(packages: &[Package]) -> Vec<String> {
    let mut names: Vec<String> = packages
        .iter()
        .rev()
        .filter(|package| !package.manifest.metapackage)
        .chain(
            packages
                .iter()
                .filter(|package| package.manifest.metapackage),
        )
        .map(|package| package.manifest.name.clone())
        .collect();
    let needed = |name: &String| {
        packages.iter().any(|package| {
            package
                .manifest
                .dependencies
                .iter()
                .any(|need| need.name == *name)
        })
    };
    // Stable: within either kind the order stays.
    names.sort_by_key(needed);
    names
}

/// The package that a push is about, which gives its service the name and the stub: of `packages`, most important first, the first of which a program is
/// run; else the first.
pub(crate) fn subject(packages: &[String], nodes: &[LaunchNode]) -> String {
    let runs = |package: &&String| nodes.iter().any(|node| node.package == **package);
    let first = packages.iter().find(runs).or(packages.first());
    first.cloned().unwrap_or_default()
}

/// Versions of packages, by name.
pub(crate) fn versions(packages: &[Package]) -> BTreeMap<String, String> {
    let all = packages.iter().map(|package| &package.manifest);
    all.map(|of| (of.name.clone(), of.version.clone()))
        .collect()
}

/// What installed packages name as `<depend>`, and were only compiled with: nothing of it runs.
pub(crate) fn tools(asked: &Needed) -> BTreeSet<String> {
    let is_tool =
        |name: &&String| name.starts_with("ament_cmake") || *name == "rosidl_default_generators";
    asked.run.keys().filter(is_tool).cloned().collect()
}

/// Whether anything in a tree is Python that runs: not what only builds (`setup.py`, dynamic_reconfigure's `.cfg`), nor
/// the modules that catkin generates for messages.
pub(crate) fn has_python(root: &Path) -> bool {
    let generated = |path: &Path| {
        let parent = path.parent().and_then(Path::file_name).unwrap_or_default();
        let setup = path
            .file_name()
            .is_some_and(|name| name == "setup.py" || name == "_setup_util.py");
        setup
            || ["msg", "srv", "cfg", "test", "tests"]
                .iter()
                .any(|name| parent == *name)
    };
    let runs = |entry: &foreign::Entry<'_>| {
        let extension = entry.path.extension().unwrap_or_default();
        if extension == "py" {
            return entry.stat.st_size > 0;
        }
        let mut start = [0; 64];
        let read = entry
            .open()
            .map(|mut file| file.read(&mut start).unwrap_or(0))
            .unwrap_or(0);
        let first = start[..read]
            .split(|byte| *byte == b'\n')
            .next()
            .unwrap_or_default();
        extension != "cfg"
            && first.starts_with(b"#!")
            && first.windows(6).any(|word| word == b"python")
    };
    let mut found = false;
    // What cannot be read here is told by those who need it.
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

    fn workspace(packages: &[(&str, &str)]) -> (tempfile::TempDir, Pushed) {
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
        let pushed = inspect(root.path(), &base).expect("a workspace");
        (root, pushed)
    }

    #[test]
    fn the_package_that_nobody_needs_is_the_one_meant() {
        let (_root, pushed) = workspace(&[
            (
                "app",
                "<depend>aa_msgs</depend><exec_depend>python3-numpy</exec_depend>",
            ),
            ("aa_msgs", "<depend>std_msgs</depend>"),
        ]);
        assert_eq!(by_importance(pushed.packages()), ["app", "aa_msgs"]);
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
        assert_eq!(subject(&packages, &[node("driver"), node("app")]), "app");
        assert_eq!(subject(&packages, &[node("of_debian")]), "tools");
        assert_eq!(subject(&[], &[node("app")]), "");
    }

    #[test]
    fn what_installed_packages_were_compiled_with_is_a_tool() {
        let (_root, pushed) = workspace(&[(
            "app",
            "<depend>ament_cmake</depend><depend>rosidl_default_generators</depend><depend>rclcpp</depend>",
        )]);
        let tools = tools(&asked(pushed.packages()));
        let tools: Vec<&str> = tools.iter().map(String::as_str).collect();
        assert_eq!(tools, ["ament_cmake", "rosidl_default_generators"]);
    }

    #[test]
    fn needs_are_sorted_by_when_they_matter() {
        let (_root, pushed) = workspace(&[
            (
                "app",
                "<depend>app_msgs</depend><exec_depend>python3-numpy</exec_depend>",
            ),
            (
                "app_msgs",
                "<build_depend>message_generation</build_depend><depend>std_msgs</depend>",
            ),
        ]);
        let asked = asked(pushed.packages());
        assert_eq!(
            asked.build.keys().collect::<Vec<_>>(),
            ["message_generation", "std_msgs"]
        );
        assert_eq!(
            asked.run.keys().collect::<Vec<_>>(),
            ["python3-numpy", "std_msgs"]
        );
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
        let error = inspect(root.path(), &base).expect_err("ROS 2").to_string();
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
