//! `[memory]`: memory limits outside of servants' containers.

use anyhow::bail;
use api::Size;
use serde::Deserialize;

use super::Time;

/// Memory limits outside of servants' containers: in the daemon and in shims.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MemoryConfig {
    /// Memory for all clients and servants together in the daemon (default: a quarter of the machine's memory, at most
    /// 1G).
    pub daemon: Option<Size>,
    /// Memory for one client: its unfinished messages and the bodies of its requests.
    pub client: Size,
    /// Memory for one servant: unfinished messages of its nodes and links, and its messages converted to JSON or CBOR.
    pub servant: Size,
    /// Longest time from the first byte of a message, frame or body to its last.
    pub unfinished: Time,
    /// Memory of one servant's shim, which has a cgroup of its own.
    pub shim: Size,
    /// Cores of one servant's shim: at most its servant's, but never less than 0.1.
    pub shim_cpus: f64,
}

impl Default for MemoryConfig {
    fn default() -> Self {
        MemoryConfig {
            daemon: None,
            client: Size(256 << 20),
            servant: Size(256 << 20),
            unfinished: Time::seconds(300),
            shim: Size(256 << 20),
            shim_cpus: 0.5,
        }
    }
}

impl MemoryConfig {
    /// Smallest memory limit in bytes with which the daemon works.
    const MIN_LIMIT: u64 = 1 << 20;
    const LEAST_FOR_A_SHIM: u64 = 32 << 20;

    pub(super) fn check(&self) -> anyhow::Result<()> {
        let daemon = ("daemon", self.daemon.unwrap_or(self.client), Self::MIN_LIMIT);
        let least = Self::LEAST_FOR_A_SHIM;
        for (name, size, least) in [
            daemon,
            ("client", self.client, Self::MIN_LIMIT),
            ("servant", self.servant, Self::MIN_LIMIT),
            ("shim", self.shim, least),
        ] {
            if size.0 < least {
                bail!("{name} = {size} is too little; write at least {}", Size(least));
            }
        }
        if self.unfinished.0.is_zero() {
            bail!("unfinished = 0 would refuse every message that arrives in parts; write a time such as \"5m\"");
        }
        if !(self.shim_cpus.is_finite() && (0.1..=64.0).contains(&self.shim_cpus)) {
            bail!("shim_cpus = {} is not between 0.1 and 64", self.shim_cpus);
        }
        Ok(())
    }
}
