//! Where every servant's ROS Master is, and how it is configured.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use ros::bus::ParamValue;
use ros::flavour::Flavour;
use ros::ros1::process;
use serde::{Deserialize, Serialize};

/// Where every servant's ROS Master listens, as seen from inside.
pub const ADDRESS: SocketAddr = process::MASTER;

/// What the daemon hands to the Master through the servant's spec.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MasterConfig {
    /// Parameters set before the first node starts.
    #[serde(default)]
    pub parameters: BTreeMap<String, ParamValue>,
}

/// [`servant::spec::Spec::resident`] for a Master with these parameters, and those that this ROS sets itself.
pub fn resident_config(
    flavour: &Flavour,
    parameters: &BTreeMap<String, ParamValue>,
) -> serde_json::Value {
    serde_json::json!({ "parameters": flavour.parameters(parameters) })
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
    }
}
