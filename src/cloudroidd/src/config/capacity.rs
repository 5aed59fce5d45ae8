//! `[capacity]`: resources of this machine that may be promised to servants.

use anyhow::bail;
use api::Size;
use serde::Deserialize;

use super::Time;
use crate::machine;

/// Resources of this machine that may be promised to servants.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CapacityConfig {
    /// Cores to promise (default: all of the machine's).
    pub cpus: Option<f64>,
    /// Factor by which the cores may be promised more than once, on average. Memory is never overcommitted.
    pub overcommit: f64,
    /// Moving of cores between servants while they work.
    pub controller: Controller,
    /// Memory to promise (default: nine tenths of the machine's).
    pub memory: Option<Size>,
    /// Largest number of robots that wait for capacity.
    pub queue: usize,
    /// Longest time that a robot waits for capacity.
    pub deadline: Time,
}

/// Setting of the controller, which moves cores between servants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Controller {
    /// Servants that are close to the limit their robots accept get cores that others do not need.
    On,
    /// Limits stay as they were requested.
    Off,
}

impl Default for CapacityConfig {
    fn default() -> Self {
        CapacityConfig {
            cpus: None,
            overcommit: 1.0,
            controller: Controller::On,
            memory: None,
            queue: 64,
            deadline: Time::seconds(10),
        }
    }
}

impl CapacityConfig {
    /// Largest overcommit; beyond it no promise can be kept.
    const MOST_OVERCOMMIT: f64 = 100.0;

    pub(super) fn check(&self) -> anyhow::Result<()> {
        let most = Self::MOST_OVERCOMMIT;
        if !(1.0..=most).contains(&self.overcommit) {
            bail!(
                "overcommit = {} is not between 1 and {most}; 1 reserves each core once, 1.5 reserves half of them \
                    twice",
                self.overcommit
            );
        }
        Ok(())
    }

    /// Returns the number of cores that may be promised to servants.
    pub fn cores(&self) -> f64 {
        self.cpus.unwrap_or_else(machine::cores)
    }
}
