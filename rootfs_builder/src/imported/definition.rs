//! Definition of a base that was made from an image.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use package::system::FoundSystem;
use ros::flavour::Version;

use crate::base::{self, Build, DEFAULT_BASE, Definition, ImportedImage, Runtime};
use crate::error::Error;

/// Base whose settings for ROS 2 are used: packages to ignore, arguments of CMake.
const TEMPLATE_TWO: &str = "bookworm-jazzy-wheels";
/// Installation prefix of compiled packages, as in all definitions.
const PREFIX: &str = "/opt/cloudroid/install";

/// A tool for compiling: its name, the programs, Python modules and ROS packages of which one is enough, and Debian's
/// package.
struct Tool {
    name: &'static str,
    any: &'static [&'static str],
    deb: &'static str,
}

const COMPILER: Tool = Tool { name: "g++", any: &["g++", "c++", "clang++"], deb: "g++" };
const CMAKE: Tool = Tool { name: "cmake", any: &["cmake"], deb: "cmake" };
const MAKE: Tool = Tool { name: "make", any: &["make", "ninja"], deb: "make" };
const SETUPTOOLS: Tool = Tool { name: "setuptools", any: &["setuptools"], deb: "python3-setuptools" };
const CATKIN_PKG: Tool = Tool { name: "catkin_pkg", any: &["catkin_pkg"], deb: "python3-catkin-pkg" };
const EMPY: Tool = Tool { name: "empy", any: &["em"], deb: "python3-empy" };
const COLCON: Tool = Tool { name: "colcon", any: &["colcon"], deb: "colcon" };
/// Extensions of Debian's colcon, which is packaged in parts; ROS's archive has them as one package.
const COLCON_PARTS: [&str; 8] = [
    "python3-colcon-bash",
    "python3-colcon-cmake",
    "python3-colcon-library-path",
    "python3-colcon-metadata",
    "python3-colcon-output",
    "python3-colcon-package-information",
    "python3-colcon-python-setup-py",
    "python3-colcon-ros",
];
const COLCON_OF_ROS: &str = "python3-colcon-common-extensions";

/// Returns the tools that sources are compiled with.
fn needed_tools(system: &FoundSystem) -> &'static [Tool] {
    const TOOLS_OF_ROS1: [Tool; 6] = [COMPILER, CMAKE, MAKE, SETUPTOOLS, CATKIN_PKG, EMPY];
    const TWO: [Tool; 6] = [COMPILER, CMAKE, MAKE, SETUPTOOLS, CATKIN_PKG, COLCON];
    match version(system) {
        Version::Ros1 => &TOOLS_OF_ROS1,
        Version::Ros2 => &TWO,
    }
}

/// ROS packages without which nothing is compiled.
fn needed_packages(system: &FoundSystem) -> &'static [&'static str] {
    match version(system) {
        // Debian's catkin has no package.xml in an install space; it comes with the toolchain.
        Version::Ros1 if system.spaces.is_empty() => &[],
        Version::Ros1 => &["catkin"],
        Version::Ros2 => &["ament_cmake", "rosidl_default_generators"],
    }
}

pub(super) fn version(system: &FoundSystem) -> Version {
    match system.ros.number() {
        1 => Version::Ros1,
        _ => Version::Ros2,
    }
}

fn list_missing_tools(system: &FoundSystem) -> impl Iterator<Item = &'static Tool> {
    needed_tools(system).iter().filter(|tool| !system.has_any(tool.any))
}

fn list_missing_packages(system: &FoundSystem) -> impl Iterator<Item = &'static str> {
    needed_packages(system).iter().copied().filter(|name| system.first_package(&[*name]).is_none())
}

/// Returns the names of what sources are compiled with and the system lacks.
pub(super) fn find_missing_tools(system: &FoundSystem) -> Vec<String> {
    let tools = list_missing_tools(system).map(|tool| tool.name);
    let lacks_headers = system.spaces.is_empty() && !system.has_any(&["ros.h"]);
    let own = lacks_headers.then_some("Debian's development packages of ROS");
    tools.chain(list_missing_packages(system)).chain(own).map(str::to_owned).collect()
}

/// Returns whether packages of ROS 2 in Python can be installed without any other tool.
pub(super) fn installs_python(system: &FoundSystem) -> bool {
    version(system) == Version::Ros2 && system.has_any(SETUPTOOLS.any)
}

/// Returns the Debian packages with what is missing; empty where dpkg is missing, too.
fn tool_packages(system: &FoundSystem) -> Vec<String> {
    if system.debian.is_none() {
        return Vec::new();
    }
    let mut debs: Vec<String> = list_missing_tools(system).map(|tool| tool.deb.to_owned()).collect();
    if debs.iter().any(|deb| deb == COLCON.deb) {
        if system.distribution == "debian" {
            debs.extend(COLCON_PARTS.map(str::to_owned));
        } else {
            debs.retain(|deb| deb != COLCON.deb);
            debs.push(COLCON_OF_ROS.to_owned());
        }
    }
    let of_ros = |name: &str| format!("ros-{}-{}", system.ros_distribution, name.replace('_', "-"));
    debs.extend(list_missing_packages(system).map(of_ros));
    debs
}

/// Returns the definition of a base that was made from an image. `directory`: that of the definitions, from which
/// settings are taken that all bases share.
pub(super) fn make_definition(
    directory: &Path,
    system: &FoundSystem,
    environment: BTreeMap<String, String>,
    image: ImportedImage,
) -> Result<Definition, Error> {
    let (ros, own) = (version(system), base::load(directory, DEFAULT_BASE)?.definition);
    let template = match ros {
        Version::Ros1 => own.clone(),
        Version::Ros2 => base::load(directory, TEMPLATE_TWO)?.definition,
    };
    // Debian's own ROS is what the template is made for.
    let is_debians = ros == Version::Ros1 && system.spaces.is_empty();
    let (build, environment) = if is_debians {
        let mut all = template.environment.clone();
        all.extend(environment);
        (template.build, all)
    } else {
        let cmake: &[&str] = match ros {
            Version::Ros1 => &["-DCATKIN_ENABLE_TESTING=OFF", "-DPYTHON_EXECUTABLE=/usr/bin/python3"],
            Version::Ros2 => &["-DBUILD_TESTING=OFF", "-DPython3_EXECUTABLE=/usr/bin/python3"],
        };
        let cmake = ["-DCMAKE_BUILD_TYPE=Release", "-Wno-dev"].iter().chain(cmake);
        let build = Build {
            packages: tool_packages(system),
            prefix: PathBuf::from(PREFIX),
            cmake: cmake.map(|argument| (*argument).to_owned()).collect(),
            environment: BTreeMap::new(),
            files: BTreeMap::new(),
        };
        (build, environment)
    };
    Ok(Definition {
        summary: format!(
            "{} with ROS {} {}, from {}",
            system.title,
            system.ros.number(),
            system.ros_distribution,
            image.source
        ),
        distribution: system.distribution.clone(),
        suite: system.suite.clone(),
        ros,
        ros_distribution: system.ros_distribution.clone(),
        keys_of: Some(DEFAULT_BASE.to_owned()),
        runtime: Runtime { packages: Vec::new() },
        environment,
        strip: own.strip,
        wheels: None,
        build,
        ros_packages: template.ros_packages,
        keys: match ros {
            Version::Ros1 => BTreeMap::new(),
            // The rest comes by `keys_of`.
            Version::Ros2 => template.keys.into_iter().filter(|(key, debs)| own.keys.get(key) != Some(debs)).collect(),
        },
        image: Some(image),
    })
}
