//! The ROS that an image is built for, and its consequences for the processes in the image: environment, command line,
//! initial parameters. What differs between ROS versions has an arm here and a module in the version's folder.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

pub use crate::bus::{Naming, NodeIdentity, NodeRename};
use crate::bus::{ParamValue, RosVersion};
use crate::{ros1, ros2};

/// The base that an image is built upon, and its ROS.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Flavour {
    /// Name of the base definition: `bookworm-ros1`.
    pub base: String,
    /// ROS version of its packages.
    pub ros: Version,
    /// Value of `$ROS_DISTRO`: `noetic`, `jazzy`.
    pub distribution: String,
}

/// The ROS version that an image is built for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Version {
    /// Master, TCPROS, catkin.
    Ros1,
    /// DDS, ament.
    Ros2,
}

impl Version {
    /// Returns the ROS version that the nodes speak.
    pub fn ros_version(self) -> RosVersion {
        match self {
            Version::Ros1 => RosVersion::One,
            Version::Ros2 => RosVersion::Two,
        }
    }
}

/// The flavour of images built before flavours were recorded.
impl Default for Flavour {
    fn default() -> Self {
        Self { base: "bookworm-ros1".to_owned(), ros: Version::Ros1, distribution: "noetic".to_owned() }
    }
}

impl Flavour {
    /// Returns the environment of every process of a servant, which overrides the image's own. `home`: working
    /// directory of the nodes, where they also write their files.
    pub fn environment(&self, home: &str) -> BTreeMap<String, String> {
        match self.ros {
            Version::Ros1 => ros1::process::environment(home),
            Version::Ros2 => ros2::process::environment(home),
        }
    }

    /// Returns the default working directory of nodes in this environment; empty if it is not set.
    pub fn home<'a>(&self, environment: &'a BTreeMap<String, String>) -> &'a str {
        let variable = match self.ros {
            Version::Ros1 => ros1::process::HOME,
            Version::Ros2 => ros2::process::HOME,
        };
        environment.get(variable).map_or("", String::as_str)
    }

    /// Returns the arguments and environment that make a program the node of this absolute name.
    pub fn identity(&self, node: &str) -> NodeIdentity {
        match self.ros {
            Version::Ros1 => ros1::process::identity(node),
            Version::Ros2 => ros2::process::identity(node),
        }
    }

    /// Returns the arguments and environment that make a program a robot's node of this absolute name. In ROS 2 the
    /// program may run several nodes; `says` selects the parts of the name to set, which then apply to all of them.
    pub fn robot_identity(&self, node: &str, says: Naming) -> NodeIdentity {
        match self.ros {
            Version::Ros1 => ros1::process::identity(node),
            Version::Ros2 => ros2::process::robot_identity(node, says),
        }
    }

    /// Returns the parts of the node name that a command line sets for all nodes of the program.
    pub fn global_naming(&self, argv: &[String]) -> Naming {
        match self.ros {
            Version::Ros1 => Naming::default(),
            Version::Ros2 => ros2::arguments::global_naming(argv),
        }
    }

    /// Returns the arguments and environment that give a program's nodes their absolute names. In ROS 1 a program is
    /// one node, the first; in ROS 2 it may be several, and nodes that already have the right name get no argument.
    pub fn rename_identity(&self, nodes: &[NodeRename]) -> NodeIdentity {
        match self.ros {
            Version::Ros1 => nodes.first().map(|called| ros1::process::identity(&called.node)).unwrap_or_default(),
            Version::Ros2 => ros2::process::rename_identity(nodes),
        }
    }

    /// Inserts an identity's arguments into a command line so that they take effect: of several rules for a name the
    /// last one applies in ROS 1, the first one in ROS 2.
    pub fn insert_arguments(&self, arguments: Vec<String>, argv: &mut Vec<String>) {
        let at = match self.ros {
            Version::Ros1 => argv.len(),
            Version::Ros2 => ros2::process::first_rule_position(argv),
        };
        argv.splice(at..at, arguments);
    }

    /// Returns what marks the nodes of a program so that they are found in the graph under any name: a namespace in ROS
    /// 1, where programs set none of their own; an enclave in ROS 2, where a namespace would hide theirs. It takes
    /// effect at the end of a command line. `mark`: an absolute name.
    pub fn marker_identity(&self, mark: &str) -> NodeIdentity {
        match self.ros {
            Version::Ros1 => ros1::process::namespace(mark),
            Version::Ros2 => ros2::process::enclave_identity(mark),
        }
    }

    /// Returns true if the program may choose the namespace of its nodes because the command line does not set it.
    pub fn can_choose_namespace(&self, argv: &[String]) -> bool {
        self.ros == Version::Ros2 && !ros2::arguments::sets_namespace(argv)
    }

    /// Returns the arguments that set the parameters of the node of this absolute name, where parameters belong to
    /// nodes (ROS 2). Later arguments may override them: the last one for a name applies. `all`: absolute names.
    pub fn parameter_arguments(&self, node: &str, all: &BTreeMap<String, ParamValue>) -> Vec<String> {
        match self.ros {
            Version::Ros1 => Vec::new(),
            Version::Ros2 => ros2::process::parameter_arguments(node, all),
        }
    }

    /// Returns the parameters set before the first node starts: the deployer's and those that ROS itself sets.
    pub fn initial_parameters(&self, given: &BTreeMap<String, ParamValue>) -> BTreeMap<String, ParamValue> {
        let mut parameters = match self.ros {
            Version::Ros1 => ros1::process::parameters(&self.distribution),
            Version::Ros2 => BTreeMap::new(),
        };
        parameters.extend(given.clone());
        parameters
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flavour_is_read_as_it_was_written() {
        for (written, ros) in [
            (r#"{"base":"lab","ros":"ros1","distribution":"melodic"}"#, RosVersion::One),
            (r#"{"base":"lab","ros":"ros2","distribution":"jazzy"}"#, RosVersion::Two),
        ] {
            let flavour: Flavour = serde_json::from_str(written).expect("a flavour");
            assert_eq!((&*flavour.base, flavour.ros.ros_version()), ("lab", ros));
            assert_eq!(serde_json::to_string(&flavour).expect("JSON"), written);
        }
    }

    #[test]
    fn parameters_are_given_to_the_master_or_to_each_node() {
        let given = BTreeMap::from([("/see/rate".to_owned(), ParamValue::Int(10))]);
        let one = Flavour::default();
        let all = one.initial_parameters(&given);
        assert_eq!(all["/see/rate"], ParamValue::Int(10));
        assert_eq!(all["/rosdistro"], ParamValue::String("noetic\n".to_owned()));
        assert!(one.parameter_arguments("/see", &all).is_empty());
        let two = Flavour { ros: Version::Ros2, ..Flavour::default() };
        let all = two.initial_parameters(&given);
        assert_eq!(all, given);
        assert_eq!(two.parameter_arguments("/see", &all), ["--ros-args", "-p", "rate:=10", "--"]);
    }
}
