//! What a service is given beyond its container: devices, volumes, ways out. In: what its push asked for, and what the
//! configuration allows. Out: mounts, environment and names for the engine, or who refused what.
//!
//! Looked at anew at each start: what is not allowed any more is not given any more.

mod cdi;
mod relay;

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr};
use std::path::{Path, PathBuf};

use api::Grants;
use servant::spec::Mount;

use crate::config::Allow;

pub use relay::Relays;

/// Why something is not given.
#[derive(Debug, thiserror::Error)]
pub enum GrantError {
    /// The configuration does not allow it.
    #[error(
        "{kind} {name} is not allowed here; its operator may add it to {kind}s of [allow] in the configuration"
    )]
    NotAllowed {
        /// `device`, `volume` or `egress`.
        kind: &'static str,
        /// Which.
        name: String,
    },
    /// It cannot be understood.
    #[error("{name:?} is not {form}")]
    Malformed {
        /// Which.
        name: String,
        /// What it should be.
        form: &'static str,
    },
    /// A volume is not there.
    #[error("volume {path} cannot be used: {source}")]
    Volume {
        /// Its path on the machine.
        path: String,
        /// Why not.
        source: std::io::Error,
    },
    /// No CDI specification names the device.
    #[error("no CDI specification in {directories} names the device {name}; there are: {known}")]
    UnknownDevice {
        /// Asked for.
        name: String,
        /// Where was looked.
        directories: String,
        /// What there is.
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

/// What the engine is told.
#[derive(Debug, Default, PartialEq)]
pub struct Granted {
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
    /// The plan's environment, with what the devices add.
    pub fn environment_over(&self, plan: &BTreeMap<String, String>) -> BTreeMap<String, String> {
        let mut all = plan.clone();
        all.extend(self.environment.clone());
        all
    }
}

/// All that was asked for, if it is allowed and there.
pub fn resolve(grants: &Grants, allow: &Allow) -> Result<Granted, GrantError> {
    let mut granted = Granted::default();
    for volume in &grants.volumes {
        granted.mounts.push(volume_mount(volume, &allow.volumes)?);
    }
    for name in &grants.devices {
        if !allow.devices.iter().any(|known| device_covers(known, name)) {
            return Err(not_allowed("device", name));
        }
        cdi::add(name, &cdi::directories(), &mut granted)?;
    }
    for (name, address, _) in ways_out(grants, allow)? {
        if name.parse::<IpAddr>().is_err() {
            granted.hosts.push((IpAddr::V4(address), name));
        }
    }
    Ok(granted)
}

fn not_allowed(kind: &'static str, name: &str) -> GrantError {
    GrantError::NotAllowed {
        kind,
        name: name.to_owned(),
    }
}

fn volume_mount(volume: &api::Volume, allowed: &[PathBuf]) -> Result<Mount, GrantError> {
    let broken = |source| GrantError::Volume {
        path: volume.source.clone(),
        source,
    };
    // Where it really is: a link must not lead out of what is allowed.
    let source = Path::new(&volume.source).canonicalize().map_err(broken)?;
    let within = allowed
        .iter()
        .filter_map(|place| place.canonicalize().ok())
        .any(|place| source.starts_with(place));
    if !within {
        return Err(not_allowed("volume", &volume.source));
    }
    Ok(Mount {
        source,
        target: PathBuf::from(&volume.target),
        writable: false,
        device: false,
    })
}

/// `vendor.com/class=*` covers all of a class.
fn device_covers(known: &str, name: &str) -> bool {
    known == name
        || known
            .strip_suffix('*')
            .is_some_and(|class| class.ends_with('=') && name.starts_with(class))
}

/// Each host asked for, the loopback address that stands for it inside, and its port. One address for each host, so that
/// several can be reached on the same port.
fn ways_out(grants: &Grants, allow: &Allow) -> Result<Vec<(String, Ipv4Addr, u16)>, GrantError> {
    let mut hosts: Vec<&str> = Vec::new();
    let mut ways = Vec::new();
    for name in &grants.egress {
        let malformed = || GrantError::Malformed {
            name: name.clone(),
            form: "a HOST:PORT to connect to",
        };
        let (host, port) = name.rsplit_once(':').ok_or_else(malformed)?;
        let port: u16 = port.parse().map_err(|_| malformed())?;
        let plain = |c: char| c.is_ascii_alphanumeric() || c == '.' || c == '-';
        if host.is_empty() || port == 0 || !host.chars().all(plain) {
            return Err(malformed());
        }
        let any = format!("*:{port}");
        if !allow
            .egress
            .iter()
            .any(|known| known == name || *known == any)
        {
            return Err(not_allowed("egress", name));
        }
        let index = hosts
            .iter()
            .position(|known| *known == host)
            .unwrap_or_else(|| {
                hosts.push(host);
                hosts.len() - 1
            });
        // 127.0.1.1 and on: 127.0.0.1 is the servant's own.
        let number = u8::try_from(index + 1).map_err(|_| malformed())?;
        ways.push((host.to_owned(), Ipv4Addr::new(127, 0, 1, number), port));
    }
    Ok(ways)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn allow() -> Allow {
        Allow {
            devices: vec!["vendor.com/net=*".into(), "vendor.com/gpu=0".into()],
            egress: vec!["models.example.org:443".into(), "*:80".into()],
            ..Allow::default()
        }
    }

    fn out(egress: &[&str]) -> Result<Vec<(String, Ipv4Addr, u16)>, GrantError> {
        let grants = Grants {
            egress: egress.iter().map(|name| (*name).to_owned()).collect(),
            ..Grants::default()
        };
        ways_out(&grants, &allow())
    }

    #[test]
    fn each_host_has_an_address_inside() {
        let ways = out(&[
            "models.example.org:443",
            "a.example:80",
            "models.example.org:80",
        ])
        .expect("allowed");
        let addresses: Vec<String> = ways
            .iter()
            .map(|(_, address, port)| format!("{address}:{port}"))
            .collect();
        assert_eq!(addresses, ["127.0.1.1:443", "127.0.1.2:80", "127.0.1.1:80"]);
    }

    #[test]
    fn what_is_not_allowed_is_named_with_the_way_out() {
        for (asked, words) in [
            ("a.example:443", "egress a.example:443 is not allowed"),
            ("a.example", "HOST:PORT"),
            ("a.example:0", "HOST:PORT"),
            ("a b:80", "HOST:PORT"),
        ] {
            let refused = out(&[asked]).expect_err(asked).to_string();
            assert!(refused.contains(words), "{refused}");
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

    #[test]
    fn a_link_out_of_an_allowed_directory_is_refused() {
        let place = tempfile::tempdir().expect("a directory");
        let (models, secret) = (place.path().join("models"), place.path().join("secret"));
        std::fs::create_dir_all(&models).expect("made");
        std::fs::write(&secret, "").expect("made");
        std::os::unix::fs::symlink("../secret", models.join("sly")).expect("made");
        let mount = |source: PathBuf| {
            let volume = api::Volume {
                source: source.display().to_string(),
                target: "/models".into(),
            };
            volume_mount(&volume, std::slice::from_ref(&models))
        };
        assert!(!mount(models.clone()).expect("allowed").writable);
        let refused = mount(models.join("sly"))
            .expect_err("leads out")
            .to_string();
        assert!(refused.contains("[allow]"), "{refused}");
        assert!(mount(models.join("../secret")).is_err());
        assert!(matches!(
            mount(models.join("none")),
            Err(GrantError::Volume { .. })
        ));
    }
}
