//! What a service is given of this host beyond its container: devices, volumes, ways out. In: names, as its push wrote them,
//! and what the configuration allows. Out: mounts, environment and names of hosts, or who refused what.
//!
//! Looked at anew at each start: what is not allowed any more is not given any more.

mod cdi;
mod volume;

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::path::PathBuf;

use api::Grants;
use serde::Deserialize;

use super::Resources;
use crate::container::Mount;

/// What of this machine a service may be given; nothing by default.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Allow {
    /// CDI devices: `vendor.com/class=name`, or `vendor.com/class=*`.
    pub devices: Vec<String>,
    /// Directories and files; what is below a directory is allowed, too.
    pub volumes: Vec<PathBuf>,
    /// `HOST:PORT`, `*:PORT` (any on the internet), `ADDRESS:PORT` or `ADDRESS/PREFIX:PORT`.
    pub egress: Vec<String>,
}

/// Why something is not given.
#[derive(Debug, thiserror::Error)]
pub enum GrantError {
    /// The configuration does not allow it.
    #[error(
        "{kind} {name} is not allowed here; its operator may add it to {kind}s of [allow] in the configuration"
    )]
    NotAllowed {
        /// `device` or `volume`.
        kind: &'static str,
        /// Its name.
        name: String,
    },
    /// A way out.
    #[error(transparent)]
    Egress(Box<dyn std::error::Error + Send + Sync>),
    /// A volume is not there.
    #[error("volume {path} cannot be used: {source}")]
    Volume {
        /// Its path on the machine.
        path: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// No CDI specification names the device.
    #[error("no CDI specification in {directories} names the device {name}; there are: {known}")]
    UnknownDevice {
        /// Asked for.
        name: String,
        /// Where was looked.
        directories: String,
        /// Names that are known, for people.
        known: String,
    },
    /// A CDI specification cannot be used.
    #[error("the CDI specification {path}: {reason}")]
    Specification {
        /// Its file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

/// What names mean on this host.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Granted {
    /// Volumes and device nodes.
    pub mounts: Vec<Mount>,
    /// Names of hosts that are reached through a loopback address inside.
    pub hosts: Vec<(IpAddr, String)>,
    /// What devices want every process to know.
    environment: BTreeMap<String, String>,
    /// What of it is not done, in words.
    pub unfulfilled: Vec<String>,
}

impl Granted {
    /// The spec's environment, with what the devices add.
    pub(super) fn environment_over(
        &self,
        plan: &BTreeMap<String, String>,
    ) -> BTreeMap<String, String> {
        let mut all = plan.clone();
        all.extend(self.environment.clone());
        all
    }
}

/// All that was asked for, if it is allowed and there.
pub(super) fn resolve(
    grants: &Grants,
    allow: &Allow,
    resources: &dyn Resources,
) -> Result<Granted, GrantError> {
    let hosts = resources.hosts(&grants.egress);
    let mut granted = Granted {
        hosts: hosts.map_err(GrantError::Egress)?,
        ..Granted::default()
    };
    for volume in &grants.volumes {
        granted.mounts.push(volume::open(volume, &allow.volumes)?);
    }
    for name in &grants.devices {
        if !allow.devices.iter().any(|known| device_covers(known, name)) {
            return Err(not_allowed("device", name));
        }
        cdi::add(name, &cdi::directories(), &mut granted)?;
    }
    Ok(granted)
}

fn not_allowed(kind: &'static str, name: &str) -> GrantError {
    GrantError::NotAllowed {
        kind,
        name: name.to_owned(),
    }
}

/// `vendor.com/class=*` covers all of a class.
fn device_covers(known: &str, name: &str) -> bool {
    known == name
        || known
            .strip_suffix('*')
            .is_some_and(|class| class.ends_with('=') && name.starts_with(class))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn allow() -> Allow {
        Allow {
            devices: vec!["vendor.com/net=*".into(), "vendor.com/gpu=0".into()],
            ..Allow::default()
        }
    }

    #[test]
    fn a_class_of_devices_may_be_allowed() {
        let covered = |name: &str| {
            allow()
                .devices
                .iter()
                .any(|known| device_covers(known, name))
        };
        assert!(covered("vendor.com/net=7") && covered("vendor.com/gpu=0"));
        assert!(!covered("vendor.com/gpu=1") && !covered("vendor.com/network=7"));
    }
}
