//! `[memory]`: limits of memory outside of servants' containers.

use anyhow::bail;
use api::Size;
use serde::Deserialize;

use super::Time;

/// Limits of memory outside of servants' containers: in the daemon, and in shims.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Memory {
    /// All clients and servants together, in the daemon; by default a quarter of the machine's memory, at most 1G.
    pub daemon: Option<Size>,
    /// One client: its unfinished messages, and bodies of its requests.
    pub client: Size,
    /// One servant: unfinished messages of its nodes and links, and JSON or CBOR made of its messages.
    pub servant: Size,
    /// Time from the first byte of a message, frame or body to its last.
    pub unfinished: Time,
    /// Memory of one servant's shim, in a cgroup of its own.
    pub shim: Size,
    /// Cores of one servant's shim; limited to its servant's, but never to less than 0.1.
    pub shim_cpus: f64,
}

impl Default for Memory {
    fn default() -> Self {
        Memory {
            daemon: None,
            client: Size(256 << 20),
            servant: Size(256 << 20),
            unfinished: Time::seconds(300),
            shim: Size(256 << 20),
            shim_cpus: 0.5,
        }
    }
}

impl Memory {
    /// Bytes below which nothing works.
    const LEAST: u64 = 1 << 20;
    const LEAST_FOR_A_SHIM: u64 = 32 << 20;

    pub(super) fn check(&self) -> anyhow::Result<()> {
        let daemon = ("daemon", self.daemon.unwrap_or(self.client), Self::LEAST);
        let least = Self::LEAST_FOR_A_SHIM;
        for (name, size, least) in [
            daemon,
            ("client", self.client, Self::LEAST),
            ("servant", self.servant, Self::LEAST),
            ("shim", self.shim, least),
        ] {
            if size.0 < least {
                bail!("{name} = {size} is too little; at least {}", Size(least));
            }
        }
        if self.unfinished.0.is_zero() {
            bail!(
                "unfinished = 0 would refuse whatever does not come at once; write a time such as \"5m\""
            );
        }
        if !(self.shim_cpus.is_finite() && (0.1..=64.0).contains(&self.shim_cpus)) {
            bail!("shim_cpus = {} is not between 0.1 and 64", self.shim_cpus);
        }
        Ok(())
    }
}
