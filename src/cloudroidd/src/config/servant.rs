//! `[servant]`: lifetime and resources of servants.

use anyhow::bail;
use api::Size;
use serde::Deserialize;
use servant::quotas::Quotas;

use super::{Time, check_nonzero};

/// Lifetime and resources of servants.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ServantConfig {
    /// Cores promised to a servant whose push requests none.
    pub reserve_cpus: f64,
    /// Memory promised to a servant whose push requests none.
    pub reserve_memory: Size,
    /// Longest time from a servant's request until it is ready.
    pub start: Time,
    /// Time that a robot's servant is kept after its last connection.
    pub grace: Time,
    /// Time that a servant is kept for connections that named no robot.
    pub anonymous_grace: Time,
    /// Largest number of services, the most recently used ones, that have containers prepared before a robot asks; the
    /// number for each service follows from the arrivals of robots.
    #[serde(alias = "spares")]
    pub warm_pool: usize,
    /// Memory for all prepared containers.
    pub warm_memory: Size,
    /// Largest number of prepared containers in which the nodes run, too.
    pub warm_nodes: usize,
    /// Reaction to nodes that get inputs and answer none.
    pub hung: Hung,
    /// Factor of the robot's stated T_max: nodes that answer nothing for that long count as hung.
    pub hung_after: f64,
    /// Size of each file system that a servant writes to, in bytes (default: half of its memory).
    pub scratch: Option<Size>,
    /// Largest number of files, directories and links in each of these file systems.
    pub inodes: u64,
    /// Rate of a servant's log in bytes per second, on average.
    pub log_rate: Size,
}

/// Reaction to hung nodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Hung {
    /// Hung nodes are ignored, without an event.
    Ignore,
    /// An event is written.
    Report,
    /// An event is written and the nodes are restarted.
    Restart,
}

impl Default for ServantConfig {
    fn default() -> Self {
        ServantConfig {
            reserve_cpus: 0.01,
            reserve_memory: Size(64 << 20),
            start: Time::seconds(30),
            grace: Time::seconds(60),
            anonymous_grace: Time::seconds(0),
            warm_pool: 8,
            warm_memory: Size(1 << 30),
            warm_nodes: 0,
            hung: Hung::Report,
            hung_after: 10.0,
            scratch: None,
            inodes: Quotas::default().inodes,
            log_rate: Size(Quotas::default().log_rate),
        }
    }
}

impl ServantConfig {
    pub(super) fn check(&self) -> anyhow::Result<()> {
        if !(self.hung_after >= 1.0 && self.hung_after <= 1e6) {
            bail!(
                "[servant] hung_after = {} in the configuration is out of range; write 1 to 1000000, such as 10",
                self.hung_after
            );
        }
        // The kernel takes 0 for "no limit".
        if self.scratch.is_some_and(|scratch| scratch.0 < 1 << 20) || self.inodes < 256 || self.log_rate.0 < 1 << 10 {
            bail!(
                "[servant] of the configuration: scratch must be at least 1M, inodes at least 256, and log_rate at \
                    least 1K"
            );
        }
        check_nonzero("[servant] start", self.start, "30s")
    }
}
