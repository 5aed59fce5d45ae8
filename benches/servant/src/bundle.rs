//! OCI bundles for the peers: a servant's configuration with what our engine sets up itself, and the image's root.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result};
use serde_json::{Value, json};
use servant::container::ContainerSpec;
use servant::local::DEFAULT_UID_BASE;
use servant::rootfs::StagedRoot;
use servant::uids;

use crate::cgroups::BenchCgroup;
use crate::root::ImageRoot;

/// Program that the container runs; it does not exit by itself.
pub(crate) const PROGRAM: [&str; 2] = ["/bin/sleep", "60"];
/// CPU period in microseconds; the kernel's default.
const PERIOD: f64 = 100_000.0;

/// A bundle from which a container can be created. Everything is removed on drop.
pub(crate) struct Bundle {
    _root: ImageRoot,
    _cgroups: BenchCgroup,
}

impl Bundle {
    /// Creates a bundle in `place`, which is created.
    pub(crate) fn make(place: &Path, spec: &ContainerSpec, seccomp: fn(&mut Value)) -> Result<Self> {
        fs::create_dir_all(place)?;
        let (root, cgroups) = (ImageRoot::mount(place, spec)?, BenchCgroup::reserve()?);
        let staged = StagedRoot {
            root: root.path().to_owned(),
            volumes: Vec::new(),
            user_namespace: fs::File::open("/proc/self/ns/user")?.into(),
        };
        // The ids may be used twice, because no servant runs meanwhile.
        let mut config = configuration(spec, &staged, (DEFAULT_UID_BASE, uids::RANGE))?;
        let limits = &spec.limits;
        config["linux"]["cgroupsPath"] = cgroups.container_path(&spec.id).into();
        config["linux"]["resources"] = json!({
            "memory": { "limit": limits.memory },
            "cpu": { "quota": limits.cpus.map(|cpus| (cpus * PERIOD) as i64), "period": PERIOD as u64 },
            "pids": { "limit": limits.pids },
        });
        seccomp(&mut config["linux"]["seccomp"]);
        fs::write(place.join("config.json"), serde_json::to_vec(&config)?)?;
        Ok(Self { _root: root, _cgroups: cgroups })
    }
}

/// Returns the configuration of a servant, with a network namespace.
pub(crate) fn configuration(spec: &ContainerSpec, staged: &StagedRoot, uid_range: (u32, u32)) -> Result<Value> {
    let mut config = serde_json::to_value(servant::bundle::config(spec, staged, &servant::quotas::Quotas::default())?)?;
    config["process"]["args"] = json!(PROGRAM);
    config["process"]["env"] = json!(["PATH=/usr/bin:/bin", "HOME=/"]);
    let namespaces = config["linux"]["namespaces"].as_array_mut().context("namespaces")?;
    namespaces.push(json!({ "type": "network" }));
    // We create the user namespace before the container, limited by what the kernel counts per user; peers create it
    // from its mappings.
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
