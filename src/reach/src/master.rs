//! Where the ROS Master of a servant of ROS 1 is, and how it is configured; nodes of ROS 2 have none.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use ros::bus::ParamValue;
use ros::flavour::{Flavour, Version};
use ros::ros1::process;
use serde::{Deserialize, Serialize};

/// Where a servant's ROS Master listens, as seen from inside.
pub const ADDRESS: SocketAddr = process::MASTER;

/// What the daemon hands to the servant's shim through its spec.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub struct MasterConfig {
    /// Whether there is a Master.
    #[serde(default = "yes")]
    pub master: bool,
    /// Parameters set before the first node starts.
    #[serde(default)]
    pub parameters: BTreeMap<String, ParamValue>,
}

/// Before it was said, every servant had one.
fn yes() -> bool {
    true
}

impl Default for MasterConfig {
    fn default() -> Self {
        Self {
            master: yes(),
            parameters: BTreeMap::new(),
        }
    }
}

/// [`servant::spec::Spec::resident`]: a Master with these parameters, and those that this ROS sets itself, or none where nodes
/// find each other without and are told their parameters when they are started.
pub fn resident_config(
    flavour: &Flavour,
    parameters: &BTreeMap<String, ParamValue>,
) -> serde_json::Value {
    match flavour.ros {
        Version::Ros1 => serde_json::json!({ "parameters": flavour.parameters(parameters) }),
        Version::Ros2 => serde_json::json!({ "master": false }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_master_reads_what_the_daemon_wrote() {
        let parameters = BTreeMap::from([("/rate".to_owned(), ParamValue::Int(10))]);
        let flavour = Flavour::default();
        let written = resident_config(&flavour, &parameters);
        let read = MasterConfig::deserialize(&written).expect("what was written");
        assert_eq!(read.parameters, flavour.parameters(&parameters));
        assert!(read.master && MasterConfig::default().master);
    }

    #[test]
    fn a_servant_of_ros_2_has_none() {
        let flavour = Flavour {
            ros: Version::Ros2,
            ..Flavour::default()
        };
        let parameters = BTreeMap::from([("/see/rate".to_owned(), ParamValue::Int(10))]);
        let written = resident_config(&flavour, &parameters);
        let read = MasterConfig::deserialize(&written).expect("what was written");
        assert_eq!((read.master, read.parameters.len()), (false, 0));
    }
}
