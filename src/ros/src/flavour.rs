//! Which ROS an image is built for, and what follows from it for the processes in it: environment, command line, initial
//! parameters. What differs between versions of ROS has an arm here and a module in the version's folder.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::bus::{ParamValue, RosVersion};
pub use crate::identity::{Called, Identity, Naming};
use crate::{ros1, ros2};

/// The base that an image is built upon, and its ROS.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Flavour {
    /// Name of the base definition: `bookworm-ros1`.
    pub base: String,
    /// Which ROS its packages speak.
    pub ros: Version,
    /// What `$ROS_DISTRO` stands for: `noetic`, `jazzy`.
    pub distribution: String,
}

/// Which ROS images are built for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Version {
    /// Master, TCPROS, catkin.
    Ros1,
    /// DDS, ament.
    Ros2,
}

impl Version {
    /// What its nodes speak.
    pub fn bus(self) -> RosVersion {
        match self {
            Version::Ros1 => RosVersion::One,
            Version::Ros2 => RosVersion::Two,
        }
    }
}

/// What every image was before flavours were recorded.
impl Default for Flavour {
    fn default() -> Self {
        Self {
            base: "bookworm-ros1".to_owned(),
            ros: Version::Ros1,
            distribution: "noetic".to_owned(),
        }
    }
}

impl Flavour {
    /// Environment of every process of a servant, over the image's own. `home`: where nodes run and keep what they write.
    pub fn environment(&self, home: &str) -> BTreeMap<String, String> {
        match self.ros {
            Version::Ros1 => ros1::process::environment(home),
            Version::Ros2 => ros2::process::environment(home),
        }
    }

    /// Where nodes run that are not told where, in this environment; empty where it does not say.
    pub fn home<'a>(&self, environment: &'a BTreeMap<String, String>) -> &'a str {
        let variable = match self.ros {
            Version::Ros1 => ros1::process::HOME,
            Version::Ros2 => ros2::process::HOME,
        };
        environment.get(variable).map_or("", String::as_str)
    }

    /// What makes a program the node of this absolute name.
    pub fn identity(&self, node: &str) -> Identity {
        match self.ros {
            Version::Ros1 => ros1::process::identity(node),
            Version::Ros2 => ros2::process::identity(node),
        }
    }

    /// What makes a program a robot's node of this absolute name. In ROS 2 it may be several nodes, and `says` how much of the name they are told:
    /// what is told is told to all.
    pub fn of_a_robot(&self, node: &str, says: Naming) -> Identity {
        match self.ros {
            Version::Ros1 => ros1::process::identity(node),
            Version::Ros2 => ros2::process::of_a_robot(node, says),
        }
    }

    /// What of its nodes' names a command line says to all of them, whatever their programs call them.
    pub fn says_to_all(&self, argv: &[String]) -> Naming {
        match self.ros {
            Version::Ros1 => Naming::default(),
            Version::Ros2 => ros2::arguments::says_to_all(argv),
        }
    }

    /// What calls a program's nodes by absolute names. In ROS 1 a program is one node, the first; in ROS 2 it may be several, and one that is
    /// called so already is told nothing.
    pub fn renamed(&self, nodes: &[Called]) -> Identity {
        match self.ros {
            Version::Ros1 => nodes
                .first()
                .map(|called| ros1::process::identity(&called.node))
                .unwrap_or_default(),
            Version::Ros2 => ros2::process::renamed(nodes),
        }
    }

    /// Puts an identity's arguments on a command line, so that they count: of several rules for a name the last one does in ROS 1, the first one in
    /// ROS 2.
    pub fn put(&self, arguments: Vec<String>, argv: &mut Vec<String>) {
        let at = match self.ros {
            Version::Ros1 => argv.len(),
            Version::Ros2 => ros2::process::first_rule(argv),
        };
        argv.splice(at..at, arguments);
    }

    /// What marks the nodes of a program, so that its own are known in the graph, whatever their names: a namespace in ROS 1, where programs have none
    /// of their own; an enclave in ROS 2, where one would hide theirs. At the end of a command line it counts. `mark`: an absolute name.
    pub fn marked(&self, mark: &str) -> Identity {
        match self.ros {
            Version::Ros1 => ros1::process::namespace(mark),
            Version::Ros2 => ros2::process::in_enclave(mark),
        }
    }

    /// Whether a program may give its nodes a namespace, which this command line does not say.
    pub fn may_choose_namespace(&self, argv: &[String]) -> bool {
        self.ros == Version::Ros2 && !ros2::arguments::gives_namespace(argv)
    }

    /// Arguments that give the node of this absolute name its parameters, where nodes hold their own (ROS 2); more of them may
    /// follow, and the last one of a name counts. `all`: absolute names.
    pub fn arguments(&self, node: &str, all: &BTreeMap<String, ParamValue>) -> Vec<String> {
        match self.ros {
            Version::Ros1 => Vec::new(),
            Version::Ros2 => ros2::process::parameters(node, all),
        }
    }

    /// Parameters set before the first node starts: those of the deployer, and those that ROS itself sets.
    pub fn parameters(&self, given: &BTreeMap<String, ParamValue>) -> BTreeMap<String, ParamValue> {
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
            (
                r#"{"base":"lab","ros":"ros1","distribution":"melodic"}"#,
                RosVersion::One,
            ),
            (
                r#"{"base":"lab","ros":"ros2","distribution":"jazzy"}"#,
                RosVersion::Two,
            ),
        ] {
            let flavour: Flavour = serde_json::from_str(written).expect("a flavour");
            assert_eq!((&*flavour.base, flavour.ros.bus()), ("lab", ros));
            assert_eq!(serde_json::to_string(&flavour).expect("JSON"), written);
        }
    }

    #[test]
    fn parameters_are_given_to_the_master_or_to_each_node() {
        let given = BTreeMap::from([("/see/rate".to_owned(), ParamValue::Int(10))]);
        let one = Flavour::default();
        let all = one.parameters(&given);
        assert_eq!(all["/see/rate"], ParamValue::Int(10));
        assert_eq!(all["/rosdistro"], ParamValue::String("noetic\n".to_owned()));
        assert!(one.arguments("/see", &all).is_empty());
        let two = Flavour {
            ros: Version::Ros2,
            ..Flavour::default()
        };
        let all = two.parameters(&given);
        assert_eq!(all, given);
        assert_eq!(
            two.arguments("/see", &all),
            ["--ros-args", "-p", "rate:=10", "--"]
        );
    }
}
