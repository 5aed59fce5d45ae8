//! Which ROS an image is built for, and what follows from it for the processes in it: environment, command line, initial
//! parameters. What differs between versions of ROS has an arm here and a module in the version's folder.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::bus::{ParamValue, RosVersion};
pub use crate::identity::Identity;
use crate::ros1::process;

/// The base that an image is built upon, and its ROS.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Flavour {
    /// Name of the base definition: `bookworm-ros1`.
    pub base: String,
    /// Which ROS its packages speak.
    pub ros: Version,
    /// What `$ROS_DISTRO` stands for: `noetic`.
    pub distribution: String,
}

/// Which ROS images are built for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Version {
    /// Master, TCPROS, catkin.
    Ros1,
}

impl Version {
    /// What its nodes speak.
    pub fn bus(self) -> RosVersion {
        match self {
            Version::Ros1 => RosVersion::One,
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
            Version::Ros1 => process::environment(home),
        }
    }

    /// Where nodes run that are not told where, in this environment; empty where it does not say.
    pub fn home<'a>(&self, environment: &'a BTreeMap<String, String>) -> &'a str {
        let variable = match self.ros {
            Version::Ros1 => process::HOME,
        };
        environment.get(variable).map_or("", String::as_str)
    }

    /// What makes a program the node of this absolute name.
    pub fn identity(&self, node: &str) -> Identity {
        match self.ros {
            Version::Ros1 => process::identity(node),
        }
    }

    /// What puts a program that chooses its name itself into a namespace: a variable.
    pub fn namespace(&self, namespace: &str) -> (String, String) {
        match self.ros {
            Version::Ros1 => process::namespace(namespace),
        }
    }

    /// Parameters set before the first node starts: those of the deployer, and those that ROS itself sets.
    pub fn parameters(&self, given: &BTreeMap<String, ParamValue>) -> BTreeMap<String, ParamValue> {
        let mut parameters = match self.ros {
            Version::Ros1 => process::parameters(&self.distribution),
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
        let written = r#"{"base":"lab","ros":"ros1","distribution":"melodic"}"#;
        let flavour: Flavour = serde_json::from_str(written).expect("a flavour");
        assert_eq!(
            (&*flavour.base, flavour.ros.bus()),
            ("lab", RosVersion::One)
        );
        assert_eq!(serde_json::to_string(&flavour).expect("JSON"), written);
        let given = BTreeMap::from([("/rate".to_owned(), ParamValue::Int(10))]);
        let parameters = flavour.parameters(&given);
        assert_eq!(parameters["/rate"], ParamValue::Int(10));
        assert_eq!(
            parameters["/rosdistro"],
            ParamValue::String("melodic\n".to_owned())
        );
    }
}
