//! Resources of this host that a service is granted beyond its container: devices, volumes, egress. In: names, as
//! written in its push, and what the configuration allows. Out: mounts, environment and host names, or the reason of a
//! refusal.
//!
//! Evaluated anew at each start: what is no longer allowed is no longer granted.

mod cdi;
mod volume;

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::path::PathBuf;

use api::Grants;
use serde::Deserialize;

use super::resources::Resources;
use crate::container::Mount;
pub use crate::grant_error::{CdiError, GrantError};

/// Resources of this host that a service may be granted; nothing by default.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Allow {
    /// CDI devices: `vendor.com/class=name`, or `vendor.com/class=*`.
    pub devices: Vec<String>,
    /// Directories and files; everything below an allowed directory is allowed, too.
    pub volumes: Vec<PathBuf>,
    /// `HOST:PORT`, `*:PORT` (any on the internet), `ADDRESS:PORT` or `ADDRESS/PREFIX:PORT`.
    pub egress: Vec<String>,
}

/// The granted resources in terms of this host.
#[derive(Debug, Default, PartialEq)]
pub(super) struct ResolvedGrants {
    /// Volumes and device nodes.
    pub mounts: Vec<Mount>,
    /// Host names that are reached through a loopback address in the container.
    pub hosts: Vec<(IpAddr, String)>,
    /// Variables that devices add to every process.
    environment: BTreeMap<String, String>,
    /// Descriptions of what is granted but not provided.
    pub unfulfilled: Vec<String>,
}

impl ResolvedGrants {
    /// Returns the spec's environment extended by the variables of the devices.
    pub(super) fn merge_environment(&self, plan: &BTreeMap<String, String>) -> BTreeMap<String, String> {
        let mut all = plan.clone();
        all.extend(self.environment.clone());
        all
    }
}

/// Resolves all grants, if they are allowed and exist.
pub(super) fn resolve(grants: &Grants, allow: &Allow, resources: &dyn Resources) -> Result<ResolvedGrants, GrantError> {
    let hosts = resources.hosts(&grants.egress);
    let mut granted = ResolvedGrants { hosts: hosts.map_err(GrantError::Egress)?, ..ResolvedGrants::default() };
    for volume in &grants.volumes {
        granted.mounts.push(volume::open(volume, &allow.volumes)?);
    }
    for name in &grants.devices {
        if !allow.devices.iter().any(|known| device_matches(known, name)) {
            return Err(not_allowed("device", name));
        }
        cdi::add_device(name, &cdi::directories(), &mut granted)?;
    }
    Ok(granted)
}

fn not_allowed(kind: &'static str, name: &str) -> GrantError {
    GrantError::NotAllowed { kind, name: name.to_owned() }
}

/// Returns whether `known` is the device or its class: `vendor.com/class=*` matches a whole class.
fn device_matches(known: &str, name: &str) -> bool {
    known == name || known.strip_suffix('*').is_some_and(|class| class.ends_with('=') && name.starts_with(class))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn allow() -> Allow {
        Allow { devices: vec!["vendor.com/net=*".into(), "vendor.com/gpu=0".into()], ..Allow::default() }
    }

    #[test]
    fn a_class_of_devices_may_be_allowed() {
        let covered = |name: &str| allow().devices.iter().any(|known| device_matches(known, name));
        assert!(covered("vendor.com/net=7") && covered("vendor.com/gpu=0"));
        assert!(!covered("vendor.com/gpu=1") && !covered("vendor.com/network=7"));
    }
}
