//! Address and configuration of the ROS Master of a ROS 1 servant; ROS 2 has none.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use ros::bus::ParamValue;
use ros::flavour::{Flavour, Version};
use ros::ros1::process;
use serde::{Deserialize, Serialize};

/// Address of a servant's ROS Master as seen from inside.
pub const ADDRESS: SocketAddr = process::MASTER;

/// Configuration that the daemon passes to the servant's shim in its spec.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub struct MasterConfig {
    /// Run a Master (default: true).
    #[serde(default = "yes")]
    pub master: bool,
    /// Parameters set before the first node starts.
    #[serde(default)]
    pub parameters: BTreeMap<String, ParamValue>,
}

/// Default of the field: before it existed, every servant had a Master.
fn yes() -> bool {
    true
}

impl Default for MasterConfig {
    fn default() -> Self {
        Self { master: yes(), parameters: BTreeMap::new() }
    }
}

/// Returns the value for [`servant::spec::Spec::resident`]: a Master with these parameters and those that this ROS
/// version sets itself, or none if nodes discover each other and get their parameters when they are started.
pub fn resident_config(flavour: &Flavour, parameters: &BTreeMap<String, ParamValue>) -> serde_json::Value {
    match flavour.ros {
        Version::Ros1 => {
            serde_json::json!({ "parameters": flavour.initial_parameters(parameters) })
        }
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
        assert_eq!(read.parameters, flavour.initial_parameters(&parameters));
        assert!(read.master && MasterConfig::default().master);
    }

    #[test]
    fn a_servant_of_ros_2_has_none() {
        let flavour = Flavour { ros: Version::Ros2, ..Flavour::default() };
        let parameters = BTreeMap::from([("/see/rate".to_owned(), ParamValue::Int(10))]);
        let written = resident_config(&flavour, &parameters);
        let read = MasterConfig::deserialize(&written).expect("what was written");
        assert_eq!((read.master, read.parameters.len()), (false, 0));
    }
}
