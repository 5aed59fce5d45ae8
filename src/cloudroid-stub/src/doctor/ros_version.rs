//! Checks that the robot's ROS is the one that the stub is for. A stub of the other one would run, and nobody would see
//! it.

use std::path::{Path, PathBuf};

use ros::bus::RosVersion;

use super::check::Check;
use crate::network::Variable;
use crate::setup::{self, RosSetup, VERSION};

const NAME: &str = "ros";

/// Directory of the install spaces of upstream's packages.
pub(super) const UPSTREAM_SPACES: &str = "/opt/ros";

/// Checks the environment of `variable` for a stub of `service`, for robots of the version `wanted`. `installed`: the
/// directory of the install spaces, [`UPSTREAM_SPACES`].
pub(super) fn check(wanted: RosVersion, service: &str, variable: Variable<'_>, installed: &Path) -> Check {
    let Some(found) = RosSetup::read(variable) else {
        return check_unset(wanted, service, variable, installed);
    };
    if let Err(error) = found.check(wanted) {
        return Check::bad(NAME, error.to_string(), setup::advice(wanted, service));
    }
    let (number, distribution) = (wanted.number(), &found.distribution);
    if found.is_mixed {
        return Check::warning(
            NAME,
            format!("ROS {number} was set up after {distribution}, which is of the other ROS: its paths are still set"),
            format!("source the setup files of ROS {number} alone, in a new shell"),
        );
    }
    Check::good(
        NAME,
        format!("ROS {number} is set up ({})", if distribution.is_empty() { VERSION } else { distribution }),
    )
}

/// Checks an environment in which no setup file was sourced, such as that of sudo: what is installed decides.
fn check_unset(wanted: RosVersion, service: &str, variable: Variable<'_>, installed: &Path) -> Check {
    let number = wanted.number();
    // Tools that are found without a setup file belong to packages that need none.
    if let Some(tool) = find_tool(wanted, variable) {
        return Check::good(NAME, format!("{VERSION} is not set; {} is of ROS {number}", tool.display()));
    }
    let own = install_spaces(wanted, installed);
    let other = wanted.other();
    let found = find_tool(other, variable).or_else(|| install_spaces(other, installed).pop());
    if let (true, Some(found)) = (own.is_empty(), found) {
        return Check::bad(
            NAME,
            format!(
                "{VERSION} is not set, and this robot has ROS {} ({}), but this stub is for robots of ROS {number}",
                other.number(),
                found.display()
            ),
            setup::advice(wanted, service),
        );
    }
    let space = own.last().cloned().unwrap_or_else(|| installed.join("DISTRIBUTION"));
    Check::warning(
        NAME,
        format!("{VERSION} is not set: no setup file of ROS {number} was sourced in this shell"),
        format!(". {}/setup.sh, or the setup file of your workspace, before the stub's", space.display()),
    )
}

/// Returns a tool of this version on PATH.
fn find_tool(version: RosVersion, variable: Variable<'_>) -> Option<PathBuf> {
    let tools: &[&str] = match version {
        RosVersion::One => &["roslaunch", "rosrun", "rospack"],
        RosVersion::Two => &["ros2"],
    };
    let path = variable("PATH").unwrap_or_default();
    let mut found = std::env::split_paths(&path).flat_map(|place| tools.iter().map(move |tool| place.join(tool)));
    found.find(|tool| tool.is_file())
}

/// Returns the install spaces of upstream's packages of this version, sorted by name.
fn install_spaces(version: RosVersion, installed: &Path) -> Vec<PathBuf> {
    let marker = match version {
        RosVersion::One => ".catkin",
        RosVersion::Two => "share/ament_index",
    };
    let entries = std::fs::read_dir(installed).into_iter().flatten().flatten();
    let mut spaces: Vec<_> = entries.map(|entry| entry.path()).filter(|space| space.join(marker).exists()).collect();
    spaces.sort();
    spaces
}

#[cfg(test)]
mod tests {
    use super::super::check::CheckVerdict::{self, Bad, Good, Warning};
    use super::*;

    /// A robot's computer, with these files.
    struct Computer(tempfile::TempDir);

    impl Computer {
        fn with_files(files: &[&str]) -> Computer {
            let place = tempfile::tempdir().expect("a directory");
            for file in files {
                let path = place.path().join(file);
                std::fs::create_dir_all(path.parent().expect("below")).expect("made");
                std::fs::write(path, "").expect("written");
            }
            Computer(place)
        }

        fn examine(&self, wanted: RosVersion, variables: &[(&str, &str)]) -> Check {
            let path = self.0.path().join("usr/bin").display().to_string();
            let variable = |name: &str| {
                let given = variables.iter().find(|(variable, _)| *variable == name);
                given.map(|(_, value)| (*value).to_owned()).or_else(|| (name == "PATH").then(|| path.clone()))
            };
            check(wanted, "people", &variable, &self.0.path().join("opt/ros"))
        }
    }

    fn assert_check(check: &Check, verdict: CheckVerdict, found: &str, fix: &str) {
        let said = check.fix.clone().unwrap_or_default();
        assert!(check.verdict == verdict && check.found.contains(found) && said.contains(fix), "{check:?}");
    }

    const NOETIC: &str = "opt/ros/noetic/.catkin";
    const JAZZY: &str = "opt/ros/jazzy/share/ament_index/resource_index/packages/rcl";
    const FOXY: &str = "opt/ros/foxy/share/ament_index/resource_index/packages/rcl";

    #[test]
    fn the_ros_that_is_sourced_decides_where_both_are_installed() {
        let robot = Computer::with_files(&[NOETIC, JAZZY, "usr/bin/rosrun"]);
        let one = [("ROS_VERSION", "1"), ("ROS_DISTRO", "noetic")];
        let two = [("ROS_VERSION", "2"), ("ROS_DISTRO", "jazzy")];
        assert_check(&robot.examine(RosVersion::One, &one), Good, "ROS 1 is set up (noetic)", "");
        assert_check(&robot.examine(RosVersion::Two, &two), Good, "ROS 2 is set up (jazzy)", "");
        let bad = robot.examine(RosVersion::Two, &one);
        assert_check(&bad, Bad, "ROS 1 (ROS_VERSION is 1) is set up here", "cloudroidctl stub people --ros 1");
        let bad = robot.examine(RosVersion::One, &two);
        assert_check(&bad, Bad, "this stub is for robots of ROS 1", "cloudroidctl stub people --ros 2");
        let mixed = robot.examine(RosVersion::Two, &[("ROS_VERSION", "2"), ("ROS_DISTRO", "noetic")]);
        assert_check(&mixed, Warning, "after noetic", "in a new shell");
    }

    #[test]
    fn where_nothing_is_sourced_the_setup_file_is_named() {
        let both = Computer::with_files(&[NOETIC, FOXY, JAZZY]);
        let warned = both.examine(RosVersion::Two, &[]);
        assert_check(&warned, Warning, "ROS_VERSION is not set", "opt/ros/jazzy/setup.sh");
        assert_check(&both.examine(RosVersion::One, &[]), Warning, "of ROS 1 was sourced", "opt/ros/noetic/setup.sh");
        let empty = Computer::with_files(&[]);
        assert_check(&empty.examine(RosVersion::Two, &[]), Warning, "is not set", "/DISTRIBUTION/setup.sh");
        // A value that means nothing is none.
        assert_check(&empty.examine(RosVersion::Two, &[("ROS_VERSION", "x")]), Warning, "is not set", "setup.sh");
    }

    #[test]
    fn a_robot_that_has_only_the_other_ros_is_refused() {
        let jazzy = Computer::with_files(&[JAZZY]);
        assert_check(&jazzy.examine(RosVersion::One, &[]), Bad, "this robot has ROS 2", "--ros 2");
        let debian = Computer::with_files(&["usr/bin/rosrun"]);
        assert_check(&debian.examine(RosVersion::Two, &[]), Bad, "usr/bin/rosrun", "--ros 1");
    }

    #[test]
    fn debians_own_ros_needs_no_setup_file() {
        let debian = Computer::with_files(&["usr/bin/roslaunch"]);
        assert_check(&debian.examine(RosVersion::One, &[]), Good, "usr/bin/roslaunch is of ROS 1", "");
        // Beside it ROS 2 may be installed.
        let both = Computer::with_files(&["usr/bin/roslaunch", JAZZY]);
        assert_check(&both.examine(RosVersion::Two, &[]), Warning, "is not set", "opt/ros/jazzy/setup.sh");
    }
}
