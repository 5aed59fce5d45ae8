//! The warm containers, and the times after which taken ones are replaced.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use reach::Reach;
use servant::engine::ServantHandle;
use store::RevisionRecord;
use tokio::sync::Notify;
use tokio::time::Instant;
use tracing::Span;

use crate::decide::Amount;
use crate::decide::forecast::Arrivals;
use crate::lives::waiting::Permit;

/// Default time from taking a container until the next one is ready.
pub(super) const LEAD: Duration = Duration::from_secs(1);

/// A servant without a robot.
pub(crate) struct WarmServant {
    /// The container.
    pub(crate) container: Arc<dyn ServantHandle>,
    /// Access to its ROS and its bridge.
    pub(crate) reach: Arc<dyn Reach>,
    /// The limits that it was made with.
    pub(crate) limits: api::Limits,
    /// The revision's nodes were started in it.
    pub(crate) nodes: bool,
    /// The promise for its nodes, until a robot takes it over.
    pub(crate) permit: Option<Permit>,
    /// Span of the log of what was begun in it ahead; a robot's name is added when it is taken.
    pub(crate) span: Span,
    pub(super) revision: Arc<RevisionRecord>,
}

/// The warm containers of all services.
#[derive(Default)]
pub(crate) struct WarmPool {
    pub(super) kept: Mutex<WarmPoolState>,
    /// Signals that containers may be missing or superfluous.
    pub(super) look: Notify,
    /// Held while warm containers are made or ended.
    pub(super) turn: tokio::sync::Mutex<()>,
}

/// The containers, and when robots came.
#[derive(Default)]
pub(super) struct WarmPoolState {
    /// Containers in the order in which they were made.
    pub(super) pool: Vec<WarmServant>,
    /// Promises of containers that are being ended.
    pub(super) ending: HashMap<String, Amount>,
    /// Services in the order of their last request, latest last.
    pub(super) asked_for: Vec<String>,
    pub(super) arrivals: HashMap<String, Arrivals>,
    pub(super) leads: HashMap<String, LeadTime>,
    pub(super) closed: bool,
}

/// Time until a taken container is replaced.
pub(super) struct LeadTime {
    pub(super) mean: Duration,
    /// Times at which containers were taken that are not replaced yet.
    pub(super) taken: VecDeque<Instant>,
}

impl Default for LeadTime {
    fn default() -> LeadTime {
        LeadTime { mean: LEAD, taken: VecDeque::new() }
    }
}
