//! The ROS that is set up where a stub is installed or started: `ROS_VERSION` and `ROS_DISTRO`, which the setup files
//! of upstream's packages set (package ros_environment, in both versions of ROS). Debian's own packages of ROS 1 have
//! no setup file and set neither.

use ros::bus::RosVersion;

use crate::network::Variable;

/// Variable with the version of the ROS whose setup file was sourced last.
pub const VERSION: &str = "ROS_VERSION";
/// Variable with the name of its distribution.
const DISTRIBUTION: &str = "ROS_DISTRO";

/// Distributions of ROS 1 that robots still run (REP 3, <https://ros.org/reps/rep-0003.html>; `one` is ROS-O).
const ROS1_DISTRIBUTIONS: [&str; 7] = ["indigo", "jade", "kinetic", "lunar", "melodic", "noetic", "one"];
/// Distributions of ROS 2 (REP 2000, <https://ros.org/reps/rep-2000.html>).
const OF_TWO: [&str; 12] = [
    "ardent", "bouncy", "crystal", "dashing", "eloquent", "foxy", "galactic", "humble", "iron", "jazzy", "kilted",
    "rolling",
];

/// Reason why the robot's nodes and a stub would not see each other.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "ROS {} ({by}) is set up here, but this stub is for robots of ROS {}: this robot's nodes would not see it",
    .found.number(), .wanted.number()
)]
pub struct OtherRosError {
    /// The robot's ROS, as the archive states it.
    pub wanted: RosVersion,
    /// The ROS that is set up.
    pub found: RosVersion,
    /// Variable and value that say so, such as `ROS_DISTRO is noetic`.
    pub by: String,
}

/// The ROS that an environment says is set up.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RosSetup {
    /// ROS version of the setup file.
    pub version: RosVersion,
    /// Name of its distribution; empty if it is not set.
    pub distribution: String,
    /// Set if `ROS_DISTRO` names a distribution of the other version: setup files of both were sourced.
    pub is_mixed: bool,
    by: String,
}

impl RosSetup {
    /// Reads what this environment says; `None` if no setup file was sourced. With setup files of both versions, that
    /// of the last one counts.
    pub fn read(variable: Variable<'_>) -> Option<RosSetup> {
        let given = |name: &str| variable(name).filter(|value| !value.is_empty());
        let (number, distribution) = (given(VERSION), given(DISTRIBUTION));
        let named = distribution.as_deref().and_then(version_of_distribution);
        let distribution = distribution.unwrap_or_default();
        // Container images often name only the distribution, sometimes in the other variable.
        let numbered = number.as_deref().and_then(|number| match number {
            "1" => Some(RosVersion::One),
            "2" => Some(RosVersion::Two),
            other => version_of_distribution(other),
        });
        let (version, by) = match (numbered, named) {
            (Some(version), _) => (version, format!("{VERSION} is {}", number.unwrap_or_default())),
            (None, Some(version)) => (version, format!("{DISTRIBUTION} is {distribution}")),
            (None, None) => return None,
        };
        Some(RosSetup { version, is_mixed: named.is_some_and(|named| named != version), distribution, by })
    }

    /// Checks that this is the robot's ROS that a stub is for.
    ///
    /// # Errors
    /// It is the other one.
    pub fn check(&self, wanted: RosVersion) -> Result<(), OtherRosError> {
        if self.version == wanted {
            return Ok(());
        }
        Err(OtherRosError { wanted, found: self.version, by: self.by.clone() })
    }
}

/// Returns what to do if a stub of `service` is for robots of the version `wanted`, and this one is of the other.
pub fn advice(wanted: RosVersion, service: &str) -> String {
    let (wanted, other) = (wanted.number(), wanted.other().number());
    format!(
        "install the archive for robots of ROS {other} (cloudroidctl stub {service} --ros {other}), or source the \
         setup file of ROS {wanted}, if this robot's nodes use that"
    )
}

fn version_of_distribution(name: &str) -> Option<RosVersion> {
    if ROS1_DISTRIBUTIONS.contains(&name) {
        return Some(RosVersion::One);
    }
    OF_TWO.contains(&name).then_some(RosVersion::Two)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(number: &str, distribution: &str) -> Option<RosSetup> {
        RosSetup::read(&|name| match name {
            VERSION => Some(number.to_owned()),
            DISTRIBUTION => Some(distribution.to_owned()),
            _ => None,
        })
    }

    #[test]
    fn the_setup_file_that_was_sourced_last_decides() {
        use RosVersion::{One, Two};
        for (number, distribution, version, is_mixed) in [
            ("1", "noetic", One, false),
            ("2", "jazzy", Two, false),
            ("2", "", Two, false),
            ("2", "our_own", Two, false),
            ("2", "noetic", Two, true),
            ("1", "jazzy", One, true),
            // Images of containers.
            ("", "melodic", One, false),
            ("", "humble", Two, false),
            ("noetic", "", One, false),
        ] {
            let setup = read(number, distribution).expect("a ROS");
            assert_eq!((setup.version, setup.is_mixed), (version, is_mixed), "{number} {distribution}");
            assert_eq!(setup.check(version), Ok(()));
        }
        for (number, distribution) in [("", ""), ("3", ""), ("", "our_own"), ("1.0", "x")] {
            assert_eq!(read(number, distribution), None, "{number} {distribution}");
        }
        assert_eq!(RosSetup::read(&|_| None), None);
    }

    #[test]
    fn the_other_ros_is_named_with_the_variable_that_says_so() {
        for (number, distribution, wanted, said) in [
            ("1", "noetic", RosVersion::Two, "ROS 1 (ROS_VERSION is 1) is set up here, but this stub is for robots of"),
            ("", "jazzy", RosVersion::One, "ROS 2 (ROS_DISTRO is jazzy) is set up here"),
        ] {
            let error = read(number, distribution).expect("a ROS").check(wanted).expect_err("refused").to_string();
            assert!(error.contains(said), "{error}");
        }
    }
}
