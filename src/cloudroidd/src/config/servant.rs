//! `[servant]`: the life of a servant.

use anyhow::bail;
use api::Size;
use serde::Deserialize;
use servant::quotas::Quotas;

use super::{Time, begins};

/// The life of a servant.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Servant {
    /// Cores promised to a servant whose push asked for none.
    pub reserve_cpus: f64,
    /// Memory promised to a servant whose push asked for none.
    pub reserve_memory: Size,
    /// How long a servant may take from its request to ready.
    pub start: Time,
    /// How long a robot's servant is kept after its last connection.
    pub grace: Time,
    /// The same for connections that named no robot.
    pub anonymous_grace: Time,
    /// Most services, those used last, that have containers made before a robot asks; how many each has is decided from the
    /// robots that come.
    #[serde(alias = "spares")]
    pub warm_pool: usize,
    /// Memory that all of those may take.
    pub warm_memory: Size,
    /// Most of them in which the nodes run, too.
    pub warm_nodes: usize,
    /// What is done about nodes that are given inputs and answer none.
    pub hung: Hung,
    /// They hang that answer nothing for so many times the T_max that their robot stated.
    pub hung_after: f64,
    /// Bytes of each file system that a servant writes; half of its memory by default.
    pub scratch: Option<Size>,
    /// Files, directories and links in each of them.
    pub inodes: u64,
    /// Bytes a second of its log, on the average.
    pub log_rate: Size,
}

/// What is done about nodes that hang.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Hung {
    /// Hung nodes are left alone, and no event says so.
    Ignore,
    /// An event says so.
    Report,
    /// An event says so, and the nodes are started again.
    Restart,
}

impl Default for Servant {
    fn default() -> Self {
        Servant {
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

impl Servant {
    pub(super) fn check(&self) -> anyhow::Result<()> {
        if !(self.hung_after >= 1.0 && self.hung_after <= 1e6) {
            bail!(
                "[servant] hung_after = {} in the configuration is no number of times; write one from 1 to 1000000, such as 10",
                self.hung_after
            );
        }
        // To the kernel, none is no limit.
        if self.scratch.is_some_and(|scratch| scratch.0 < 1 << 20)
            || self.inodes < 256
            || self.log_rate.0 < 1 << 10
        {
            bail!(
                "[servant] of the configuration: programs need a scratch of at least 1M, 256 inodes, and a log_rate of at least 1K"
            );
        }
        begins("[servant] start", self.start, "30s")
    }
}
