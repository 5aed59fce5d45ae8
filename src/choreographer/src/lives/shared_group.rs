//! The groups of servants that robots share, and the servants of each.

use std::collections::HashMap;
use std::sync::Arc;

use api::Shared;
use parking_lot::Mutex;
use reach::group::ServantGroup;
use reach::group::dispatch::Member;
use store::RevisionRecord;
use tokio::sync::{Notify, watch};

use super::handle::Failure;
use super::lease::Lease;

/// All groups, by service and revision.
#[derive(Default)]
pub(crate) struct Groups {
    pub(super) all: Mutex<HashMap<(String, u64), Arc<SharedGroup>>>,
}

/// A group of servants, and the state its robots wait for.
pub(super) struct SharedGroup {
    pub(super) group: Arc<ServantGroup>,
    pub(super) revision: Arc<RevisionRecord>,
    pub(super) rules: Shared,
    pub(super) state: watch::Sender<GroupStage>,
    pub(super) seats: watch::Sender<usize>,
    pub(super) servants: Mutex<Vec<SharedServant>>,
    /// The state of a servant has changed.
    pub(super) look: Notify,
}

/// Stage of a group.
#[derive(Debug, Clone)]
pub(super) enum GroupStage {
    /// None of its servants has capacity.
    Queued,
    /// A servant has capacity.
    Admitted,
    /// A servant answers.
    Ready,
    /// No servant answers, or ever will.
    Over(Failure),
}

/// A servant of a group.
pub(super) struct SharedServant {
    pub(super) number: usize,
    pub(super) lease: Lease,
    pub(super) member: Option<Member>,
    pub(super) retiring: bool,
}
