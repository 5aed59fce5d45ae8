//! `[capacity]`: what of this machine may be promised to servants.

use anyhow::bail;
use api::Size;
use serde::Deserialize;

use super::Time;
use crate::machine;

/// What of this machine may be promised to servants.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Capacity {
    /// Cores to promise; all of the machine's by default.
    pub cpus: Option<f64>,
    /// How often each core may be promised, on the average. Memory is promised once.
    pub overcommit: f64,
    /// Whether cores are moved between servants while they work.
    pub controller: Controller,
    /// Memory to promise; nine tenths of the machine's by default.
    pub memory: Option<Size>,
    /// Robots that may wait for capacity.
    pub queue: usize,
    /// How long each may wait.
    pub deadline: Time,
}

/// Whether the controller works.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Controller {
    /// Those near what their robots accept at most get what others do not need.
    On,
    /// Limits stay as they were asked for.
    Off,
}

impl Default for Capacity {
    fn default() -> Self {
        Capacity {
            cpus: None,
            overcommit: 1.0,
            controller: Controller::On,
            memory: None,
            queue: 64,
            deadline: Time::seconds(10),
        }
    }
}

impl Capacity {
    /// Beyond this nobody has what was promised.
    const MOST_OVERCOMMIT: f64 = 100.0;

    pub(super) fn check(&self) -> anyhow::Result<()> {
        let most = Self::MOST_OVERCOMMIT;
        if !(1.0..=most).contains(&self.overcommit) {
            bail!(
                "overcommit = {} is not between 1 and {most}; 1 promises each core once, 1.5 promises half of them twice",
                self.overcommit
            );
        }
        Ok(())
    }

    /// Cores that there are for servants.
    pub fn cores(&self) -> f64 {
        self.cpus.unwrap_or_else(machine::cores)
    }
}
