//! Environment of the processes of a root file system: what sourcing the setup scripts of its install spaces would
//! make.

use std::collections::BTreeMap;
use std::path::Path;

use ros::bus::RosVersion;
use ros::ros2::middleware;

use super::view::View;
use super::{FoundSystem, RosSpace};
use crate::Error;

/// Search path of every distribution.
const PATH: &str = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin";
/// Variables of an image that are about where it ran or how it was built.
const DROPPED_VARIABLES: [&str; 17] = [
    "AMENT_CURRENT_PREFIX",
    "COLCON_PREFIX_PATH",
    "CYCLONEDDS_URI",
    "DEBIAN_FRONTEND",
    "DISPLAY",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "HOME",
    "HOSTNAME",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_DISCOVERY_SERVER",
    "ROS_DOMAIN_ID",
    "ROS_HOSTNAME",
    "ROS_IP",
    "ROS_LOCALHOST_ONLY",
    "ROS_MASTER_URI",
    "USER",
];
/// Variables with lists of directories.
const LISTS: [&str; 6] =
    ["AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "LD_LIBRARY_PATH", "PATH", "PYTHONPATH", "ROS_PACKAGE_PATH"];

/// Returns the environment of every process of a system that was found in these layers: that of its install spaces, and
/// what the image sets beyond them (`given`). Blocking.
pub fn make_environment<L: AsRef<Path>>(
    layers: &[L],
    system: &FoundSystem,
    given: &BTreeMap<String, String>,
) -> Result<BTreeMap<String, String>, Error> {
    let view = View::open(layers)?;
    let mut lists: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for prefix in system.spaces.iter().flat_map(RosSpace::prefixes) {
        let mut add = |name, path: String| lists.entry(name).or_default().push(path);
        if system.ros == RosVersion::Two {
            add("AMENT_PREFIX_PATH", prefix.clone());
        } else {
            add("ROS_PACKAGE_PATH", format!("{prefix}/share"));
        }
        add("CMAKE_PREFIX_PATH", prefix.clone());
        add("PATH", format!("{prefix}/bin"));
        for path in library_directories(&view, &prefix)? {
            add("LD_LIBRARY_PATH", path);
        }
        for path in python_directories(&view, &prefix) {
            for libraries in wheel_directories(&view, &path)? {
                add("LD_LIBRARY_PATH", libraries);
            }
            add("PYTHONPATH", path);
        }
    }
    let mut environment: BTreeMap<String, String> = given
        .iter()
        .filter(|(name, value)| {
            is_variable(name) && !value.contains('\0') && !DROPPED_VARIABLES.contains(&name.as_str())
        })
        .map(|(name, value)| (name.clone(), value.clone()))
        .collect();
    for name in LISTS {
        let mut all = lists.remove(name).unwrap_or_default();
        let theirs = given.get(name).map_or(if name == "PATH" { PATH } else { "" }, String::as_str);
        for path in theirs.split(':').filter(|path| path.starts_with('/') && !path.contains('\0')) {
            if !all.iter().any(|known| known == path) {
                all.push(path.to_owned());
            }
        }
        if all.is_empty() {
            environment.remove(name);
        } else {
            environment.insert(name.to_owned(), all.join(":"));
        }
    }
    let mut set = |name: &str, value: &str| environment.insert(name.to_owned(), value.to_owned());
    set("ROS_VERSION", &system.ros.number().to_string());
    set("ROS_PYTHON_VERSION", "3");
    set("PYTHONDONTWRITEBYTECODE", "1");
    set("LANG", "C.UTF-8");
    // For catkin of Debian, which has no space of its own, ROS_DISTRO would mean a second ROS.
    if let Some(base) = system.spaces.last() {
        set("ROS_DISTRO", &system.ros_distribution);
        if system.ros == RosVersion::One {
            set("ROS_ROOT", &format!("{}/share/ros", base.path));
            set("ROS_ETC_DIR", &format!("{}/etc/ros", base.path));
        }
    }
    if system.ros == RosVersion::Two {
        // Python packages of ROS start Python once more, to set LD_LIBRARY_PATH, unless this says that it is set.
        set("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "1");
        match choose_middleware(system, given) {
            Some(name) => set(middleware::VARIABLE, name),
            None => environment.remove(middleware::VARIABLE),
        };
    }
    Ok(environment)
}

/// Returns the middleware of the nodes of a system of ROS 2: the one that the image sets (`given`), if the bus speaks
/// it and it is there, else the first of those that are there.
pub fn choose_middleware<'a>(system: &FoundSystem, given: &'a BTreeMap<String, String>) -> Option<&'a str> {
    let own = given.get(middleware::VARIABLE).map(String::as_str);
    let own = own.filter(|name| middleware::SUPPORTED.contains(name));
    let there = own.and_then(|name| system.first_package(&[name]));
    there.or_else(|| system.first_package(&middleware::SUPPORTED)).or(own)
}

/// Returns whether a text is the name of a variable that a shell can have, and not one that makes the loader load
/// something into every process.
fn is_variable(name: &str) -> bool {
    !name.is_empty()
        && name.len() < 256
        && !name.as_bytes()[0].is_ascii_digit()
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
        && !matches!(name, "LD_PRELOAD" | "LD_AUDIT" | "PYTHONSTARTUP" | "PYTHONHOME" | "BASH_ENV" | "ENV")
}

/// Returns the directories of a prefix with modules of Python 3.
pub(super) fn python_directories(view: &View, prefix: &str) -> Vec<String> {
    let mut found = Vec::new();
    for below in ["lib", "local/lib"] {
        let libraries = view.names(&format!("{prefix}/{below}")).unwrap_or_default();
        for version in libraries.iter().filter(|name| name.starts_with("python3")) {
            for modules in ["site-packages", "dist-packages"] {
                let path = format!("{prefix}/{below}/{version}/{modules}");
                if view.has_directory(&path).unwrap_or_default() {
                    found.push(path);
                }
            }
        }
    }
    found
}

/// Returns the directories beside Python packages of ROS with the libraries that they were linked with
/// (`ros_PACKAGE.libs`, as auditwheel names them).
fn wheel_directories(view: &View, modules: &str) -> Result<Vec<String>, Error> {
    let names = view.names(modules)?.into_iter();
    let libraries = names.filter(|name| name.starts_with("ros_") && name.ends_with(".libs") && !name.contains(':'));
    Ok(libraries.map(|name| format!("{modules}/{name}")).collect())
}

/// Returns the directories of a prefix with shared libraries: its own, those of an architecture, and those of vendored
/// packages (`opt/PACKAGE/lib`).
fn library_directories(view: &View, prefix: &str) -> Result<Vec<String>, Error> {
    let vendored = view.names(&format!("{prefix}/opt"))?.into_iter().map(|name| format!("{prefix}/opt/{name}/lib"));
    let places: Vec<String> = vendored.chain([format!("{prefix}/lib")]).collect();
    let mut found = Vec::new();
    for place in places {
        let triplets = view.names(&place)?.into_iter().filter(|name| name.ends_with("-linux-gnu"));
        let inner = triplets.map(|name| format!("{place}/{name}"));
        for path in inner.chain([place.clone()]) {
            if view.has_directory(&path)? {
                found.push(path);
            }
        }
    }
    Ok(found)
}
