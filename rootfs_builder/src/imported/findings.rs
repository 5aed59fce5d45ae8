//! The table of what was found in an image, in words for the person who imports it.

use std::collections::BTreeMap;

use package::system::{self, FoundSystem, RosSpace};
use ros::flavour::Version;
use ros::ros2::middleware;

use super::definition::{find_missing_tools, installs_python, version};
use crate::base::Finding;

/// Returns the table. `given`: environment that the image sets; `debs`: number of packages of dpkg.
pub(super) fn list_findings(system: &FoundSystem, given: &BTreeMap<String, String>, debs: usize) -> Vec<Finding> {
    let release = format!("{} ({} {})", system.title, system.distribution, system.suite);
    let mut all = vec![Finding::new("system", release, "")];
    all.extend(describe_ros(system));
    if version(system) == Version::Ros2 {
        all.push(describe_middleware(system, given));
    }
    for (path, why) in &system.unusable {
        all.push(Finding::new("left out", path.as_str(), *why));
    }
    all.push(match debs {
        0 => Finding::new("packages", "missing: dpkg", "nothing can be added: packages need what is in the image"),
        debs => Finding::new(
            "packages",
            format!("{debs} of dpkg"),
            format!("others are installed from the archive of {} ([archives] in the configuration)", system.suite),
        ),
    });
    all.push(Finding::new("Python", system.python.as_str(), ""));
    all.push(describe_tools(system, debs > 0));
    all.push(describe_launch(system));
    all
}

fn describe_ros(system: &FoundSystem) -> Vec<Finding> {
    let named = format!("ROS {} {}", system.ros.number(), system.ros_distribution);
    if system.spaces.is_empty() {
        return vec![Finding::new("ROS", format!("{named}, Debian's own below /usr"), "")];
    }
    let mut all = Vec::new();
    for space in system.spaces.iter().rev() {
        let RosSpace { path, packages, .. } = space;
        let subject = if all.is_empty() { "ROS" } else { "overlay" };
        let named = if all.is_empty() { format!("{named} in ") } else { String::new() };
        all.push(Finding::new(subject, format!("{named}{path}, {} packages", packages.len()), ""));
    }
    all
}

fn describe_middleware(system: &FoundSystem, given: &BTreeMap<String, String>) -> Finding {
    let Some(name) = system::choose_middleware(system, given) else {
        let missing = format!("missing: {}", middleware::SUPPORTED.join(" or "));
        return Finding::new("middleware", missing, "nodes cannot be reached by robots: add one to the image");
    };
    let consequence = match middleware::check_environment(given) {
        Ok(()) => String::new(),
        Err(error) => format!("instead of the one that the image sets: {error}"),
    };
    Finding::new("middleware", name, consequence)
}

fn describe_tools(system: &FoundSystem, has_dpkg: bool) -> Finding {
    let missing = find_missing_tools(system);
    if missing.is_empty() {
        return Finding::new("compiling", "all that sources need", "");
    }
    let without = if installs_python(system) {
        "packages in Python and install spaces can be pushed"
    } else {
        "only install spaces can be pushed"
    };
    let consequence = if has_dpkg {
        format!("the first push of sources installs it from the archive of {}; without that, {without}", system.suite)
    } else {
        without.to_owned()
    };
    Finding::new("compiling", format!("missing: {}", missing.join(", ")), consequence)
}

fn describe_launch(system: &FoundSystem) -> Finding {
    let (name, is_there) = match version(system) {
        Version::Ros1 => {
            let is_installed = system.first_package(&["roslaunch"]).is_some() || system.has_any(&["roslaunch"]);
            ("roslaunch", is_installed && system.has_any(&["rospkg"]))
        }
        Version::Ros2 => ("launch_ros", system.has_any(&["launch_ros"])),
    };
    if is_there {
        return Finding::new("launch files", name, "");
    }
    let consequence = "launch files cannot be read: push with --node, or add it to the image";
    Finding::new("launch files", format!("missing: {name}"), consequence)
}
