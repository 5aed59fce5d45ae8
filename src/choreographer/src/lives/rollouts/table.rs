//! The rollouts of all services.

use std::collections::{BTreeMap, BTreeSet};

use parking_lot::Mutex;
use tokio::sync::Notify;

use crate::decide::rollout::{PromotionBlocker, Rollout};

/// The last rollout of each service.
#[derive(Default)]
pub(crate) struct Rollouts {
    /// Held only briefly: each request is counted here.
    pub(super) kept: Mutex<RolloutTable>,
    /// Held from reading the table until it is written, so that the last write is the newest.
    pub(super) writing: Mutex<()>,
    /// Held while a rollout starts, takes a step or executes an order.
    pub(super) turn: tokio::sync::Mutex<()>,
    /// Signals that a rollout has started.
    pub(super) begun: Notify,
}

/// The rollouts, and what of them is not written yet.
#[derive(Default)]
pub(super) struct RolloutTable {
    pub(super) by_service: BTreeMap<String, Rollout>,
    /// Services with unwritten counts or robots.
    pub(super) changed: BTreeSet<String>,
    /// Blockers of canaries whose promotion time has come, by service.
    pub(super) waits: BTreeMap<String, PromotionBlocker>,
}
