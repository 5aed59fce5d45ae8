//! Where every servant's ROS Master is, and how it is configured.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use ros::bus::ParamValue;
use serde::{Deserialize, Serialize};

/// Where every servant's ROS Master listens, as seen from inside.
pub const ADDRESS: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 11311);

/// What the daemon hands to the Master through the servant's spec.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MasterConfig {
    /// Parameters set before the first node starts.
    #[serde(default)]
    pub parameters: BTreeMap<String, ParamValue>,
}

/// [`servant::spec::Spec::resident`] for a Master with these parameters.
pub fn resident_config(parameters: &BTreeMap<String, ParamValue>) -> serde_json::Value {
    serde_json::json!({ "parameters": parameters })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_master_reads_what_the_daemon_wrote() {
        let parameters = BTreeMap::from([("/rate".to_owned(), ParamValue::Int(10))]);
        let written = resident_config(&parameters);
        let read = MasterConfig::deserialize(&written).expect("what was written");
        assert_eq!(read, MasterConfig { parameters });
    }
}
