//! A bundle for the peers: a servant's configuration, with the network namespace and the limits in it that our engine
//! makes itself, and the image's root.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result};
use serde_json::{Value, json};
use servant::container::ContainerSpec;
use servant::local::DEFAULT_UID_BASE;
use servant::rootfs::Staged;
use servant::uids;

use crate::cgroups::Cgroups;
use crate::root::Root;

/// What the container runs, and stays.
pub(crate) const PROGRAM: [&str; 2] = ["/bin/sleep", "60"];
/// Microseconds; the kernel's default.
const PERIOD: f64 = 100_000.0;

/// A bundle, ready to be made a container of. Everything is gone when it is dropped.
pub(crate) struct Bundle {
    _root: Root,
    _cgroups: Cgroups,
}

impl Bundle {
    /// In `place`, which is made.
    pub(crate) fn make(
        place: &Path,
        spec: &ContainerSpec,
        seccomp: fn(&mut Value),
    ) -> Result<Self> {
        fs::create_dir_all(place)?;
        let (root, cgroups) = (Root::mount(place, spec)?, Cgroups::place()?);
        let staged = Staged {
            root: root.path().to_owned(),
            volumes: Vec::new(),
            user_namespace: fs::File::open("/proc/self/ns/user")?.into(),
        };
        // Two containers may have the same ids; no servant runs meanwhile.
        let mut config = configuration(spec, &staged, (DEFAULT_UID_BASE, uids::RANGE))?;
        let limits = &spec.limits;
        config["linux"]["cgroupsPath"] = cgroups.of(&spec.id).into();
        config["linux"]["resources"] = json!({
            "memory": { "limit": limits.memory },
            "cpu": { "quota": limits.cpus.map(|cpus| (cpus * PERIOD) as i64), "period": PERIOD as u64 },
            "pids": { "limit": limits.pids },
        });
        seccomp(&mut config["linux"]["seccomp"]);
        fs::write(place.join("config.json"), serde_json::to_vec(&config)?)?;
        Ok(Self {
            _root: root,
            _cgroups: cgroups,
        })
    }
}

/// A servant's configuration, with a network namespace.
pub(crate) fn configuration(
    spec: &ContainerSpec,
    staged: &Staged,
    uid_range: (u32, u32),
) -> Result<Value> {
    let mut config = serde_json::to_value(servant::bundle::config(
        spec,
        staged,
        &servant::quotas::Quotas::default(),
    )?)?;
    config["process"]["args"] = json!(PROGRAM);
    config["process"]["env"] = json!(["PATH=/usr/bin:/bin", "HOME=/"]);
    let namespaces = config["linux"]["namespaces"]
        .as_array_mut()
        .context("namespaces")?;
    namespaces.push(json!({ "type": "network" }));
    // Ours is made before the container, with limits of what the kernel counts by user; peers make it by its maps.
    namespaces.retain(|namespace| namespace["type"] != "user");
    namespaces.push(json!({ "type": "user" }));
    let (first, count) = uid_range;
    let map = json!([{ "containerID": 0, "hostID": first, "size": count }]);
    config["linux"]["uidMappings"] = map.clone();
    config["linux"]["gidMappings"] = map;
    if let Some(linux) = config["linux"].as_object_mut() {
        linux.remove("sysctl");
    }
    Ok(config)
}
