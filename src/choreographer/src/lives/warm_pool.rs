//! Containers made before anyone asks for them, so that a robot does not wait for their making.
//!
//! A warm container is a whole servant but for its nodes: namespaces, limits, init, ROS Master and bridge are there. Nothing in it
//! belongs to a robot, and none of the service's code has run in it. In so many of them as the operator wants the nodes run,
//! too ([`heat`]): a robot that takes them as they are finds them ready. How many there are is decided from the robots that
//! came ([`crate::decide::forecast`]). Others are made when a robot's servant is ready, so that the two do not compete. A warm
//! container that is gone when it is needed costs nothing but time: the servant is made as if there were none.

mod keeping;

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use futures_util::FutureExt;
use parking_lot::Mutex;
use reach::Reach;
use servant::engine::{ContainerState, Servant};
use tokio::sync::Notify;
use tokio::time::Instant;

use super::Inner;
use super::group::is_of_no_robot;
use super::waiting::Permit;
use crate::decide;
use crate::decide::Amount;
use crate::decide::forecast::Arrivals;
use crate::decide::placement::{Placement, place};
use crate::decide::warm_pool::{Warm as Facts, choose};
use store::RevisionRecord;

pub(crate) use keeping::{end_all, give_back, keep, tidy};

/// Whose a container of the pool is in the database, from the start of its nodes until a robot takes it. No robot can give
/// itself this name.
pub(crate) const NOBODY: &str = "~warm";
/// By which it is remembered that a service's containers cannot be made, as a robot's servants that fail.
const UNMADE: &str = "~warm-container";
/// From a container's taking to the next one's readiness, before it was measured.
const LEAD: Duration = Duration::from_secs(1);
/// Weight of the last lead time in their mean.
const LAST: f64 = 0.3;
/// Containers that were taken and not yet replaced, of one service, whose times are remembered.
const TAKEN: usize = 64;

/// A servant that has no robot.
pub(crate) struct Warm {
    /// Its container.
    pub(crate) container: Arc<dyn Servant>,
    /// Its ROS and its bridge.
    pub(crate) reach: Arc<dyn Reach>,
    /// The limits that it was made with.
    pub(crate) limits: api::Limits,
    /// The revision's nodes were started in it.
    pub(crate) nodes: bool,
    /// What is promised to its nodes, until a robot takes the promise over.
    pub(crate) permit: Option<Permit>,
    revision: Arc<RevisionRecord>,
}

/// The containers of all services that were made ahead.
#[derive(Default)]
pub(crate) struct WarmPool {
    kept: Mutex<Kept>,
    /// Something may be missing or too many.
    look: Notify,
    /// Held while warm containers are made or ended.
    turn: tokio::sync::Mutex<()>,
}

#[derive(Default)]
struct Kept {
    /// In the order in which they were made.
    pool: Vec<Warm>,
    /// Promises of those that are being ended.
    ending: HashMap<String, Amount>,
    /// Services in the order in which robots asked for them, the last one last.
    asked_for: Vec<String>,
    arrivals: HashMap<String, Arrivals>,
    leads: HashMap<String, Lead>,
    closed: bool,
}

/// How long it takes until there is a container in the place of one that was taken.
struct Lead {
    mean: Duration,
    /// When those were taken that are still to be replaced.
    taken: VecDeque<Instant>,
}

impl Default for Lead {
    fn default() -> Lead {
        Lead {
            mean: LEAD,
            taken: VecDeque::new(),
        }
    }
}

impl Lead {
    fn taken(&mut self, now: Instant) {
        self.taken.push_back(now);
        if self.taken.len() > TAKEN {
            self.taken.pop_front();
        }
    }

    fn replaced(&mut self, now: Instant) {
        if let Some(taken) = self.taken.pop_front() {
            self.mean = self.mean.mul_f64(1.0 - LAST) + (now - taken).mul_f64(LAST);
        }
    }

    /// No container is missing: what was taken before is not to be replaced.
    fn complete(&mut self) {
        self.taken.clear();
    }
}

impl Warm {
    /// It has not ended, nor has one of its nodes that the engine does not start again.
    fn runs(&self) -> bool {
        let mut own = self.revision.plan.nodes.iter();
        let ended = |name: &str| self.container.wait_node(name).now_or_never().is_some();
        *self.container.state().borrow() == ContainerState::Running
            && !(self.nodes && own.any(|node| !node.respawn && ended(&node.name)))
    }

    /// As decisions see it.
    fn facts(&self) -> Facts<'_> {
        Facts {
            id: self.container.id(),
            service: &self.revision.service,
            revision: self.revision.number,
            image: &self.revision.image,
            runs: self.runs(),
            nodes: self.nodes,
        }
    }

    fn promised(&self, inner: &Inner) -> Option<Amount> {
        self.permit.as_ref()?;
        Some(inner.promised(&self.revision.plan.limits))
    }

    /// Ends it; nothing is left.
    pub(crate) async fn end(self, inner: &Inner) {
        self.reach.close("the warm container is not needed");
        let id = self.container.id();
        if let Err(error) = self.container.stop().await {
            tracing::warn!("warm container {id} could not be cleaned up: {error}");
        }
        if self.nodes {
            inner.state.remove_servant(id);
        }
        drop(self.permit);
        inner.warm_pool.kept.lock().ending.remove(id);
    }
}

impl WarmPool {
    /// Decides which servant a robot is given that asks for this revision and `has` that servant so far. Where a new one is
    /// to be made of a warm container, gives that; and remembers that the service was asked for, and that a robot has arrived
    /// if `robot` names one. `default_names`: it takes the revision's nodes as they are.
    pub(crate) fn place<'a>(
        &self,
        has: Option<&decide::Servant<'a>>,
        revision: &RevisionRecord,
        (robot, default_names): (&str, bool),
    ) -> (Placement<'a>, Option<Warm>) {
        let mut kept = self.kept.lock();
        let service = &revision.service;
        let wanted = (&**service, revision.number, &*revision.image);
        let warm = choose(kept.pool.iter().map(Warm::facts), wanted, default_names);
        let placement = place(has, warm.as_ref(), revision.number, &revision.image);
        let Placement::Start { warm: used, .. } = placement else {
            return (placement, None);
        };
        let id = warm.filter(|_| used).map(|warm| warm.id.to_owned());
        let now = Instant::now();
        kept.asked_for.retain(|asked| asked != service);
        kept.asked_for.push(service.clone());
        if !is_of_no_robot(robot) {
            let arrivals = kept.arrivals.entry(service.clone());
            arrivals
                .or_insert_with(|| Arrivals::new(now.into_std()))
                .arrived(now.into_std());
        }
        let taken = id.and_then(|id| kept.take(&id));
        if taken.is_some() {
            kept.leads.entry(service.clone()).or_default().taken(now);
        }
        (placement, taken)
    }

    /// Puts one in that was made, or back that its robot had no use for; gives it if it is not wanted.
    fn put(&self, warm: Warm) -> Option<Warm> {
        let mut kept = self.kept.lock();
        // A robot has taken over what its nodes were promised.
        if kept.closed || (warm.nodes && warm.permit.is_none()) {
            return Some(warm);
        }
        kept.pool.push(warm);
        None
    }

    /// Has a look taken, soon, at what is missing.
    pub(crate) fn look(&self) {
        self.look.notify_one();
    }

    /// How many there are, and in how many of them the nodes run.
    pub(crate) fn count(&self) -> (usize, usize) {
        let kept = self.kept.lock();
        let nodes = kept.pool.iter().filter(|warm| warm.nodes).count();
        (kept.pool.len(), nodes)
    }

    /// Images that they were made from.
    pub(crate) fn images(&self) -> Vec<String> {
        let kept = self.kept.lock();
        let images = kept.pool.iter().map(|warm| warm.revision.image.clone());
        images.collect()
    }

    /// Those whose nodes run, as servants that nobody needs: they end before any that a robot has left.
    pub(crate) fn promised(&self, inner: &Inner) -> Vec<(String, Amount, bool)> {
        let kept = self.kept.lock();
        let pooled = kept.pool.iter();
        let pooled = pooled.filter_map(|warm| {
            Some((warm.container.id().to_owned(), warm.promised(inner)?, false))
        });
        let ending = kept.ending.iter();
        let ending = ending.map(|(id, amount)| (id.clone(), *amount, true));
        pooled.chain(ending).collect()
    }

    /// Ends one for a robot that waits for its capacity; whether it is one of the pool's.
    pub(crate) fn end_for_room(&self, inner: &Arc<Inner>, id: &str) -> bool {
        let mut kept = self.kept.lock();
        let Some(warm) = kept.take(id) else {
            return false;
        };
        let promised = warm.promised(inner).unwrap_or_default();
        kept.ending.insert(id.to_owned(), promised);
        let inner = Arc::clone(inner);
        tokio::spawn(async move { warm.end(&inner).await });
        true
    }

    /// Whether time alone changes what is wanted.
    fn is_restless(&self, inner: &Inner) -> bool {
        let kept = self.kept.lock();
        let now = Instant::now().into_std();
        // Nodes die, and the pauses of those that died come to an end.
        inner.options.warm_nodes > 0
            || kept
                .arrivals
                .values()
                .any(|service| service.expected(now) > 0.0)
    }
}

impl Kept {
    fn take(&mut self, id: &str) -> Option<Warm> {
        let index = self.pool.iter().position(|warm| warm.container.id() == id);
        index.map(|index| self.pool.remove(index))
    }
}

impl Inner {
    /// Takes a warm container back, if there is one, that its robot cannot have; comes back at once.
    pub(crate) fn give_back(self: &Arc<Self>, warm: Option<Warm>) {
        if let Some(unwanted) = warm.and_then(|warm| self.warm_pool.put(warm)) {
            let inner = Arc::clone(self);
            tokio::spawn(async move { unwanted.end(&inner).await });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_to_be_replaced_makes_no_lead_longer() {
        let (began, second) = (Instant::now(), Duration::from_secs(1));
        let mut lead = Lead::default();
        for _ in 0..5 {
            lead.taken(began);
        }
        lead.replaced(began + second);
        assert_eq!(lead.mean, second);
        // One of five is enough for those who come now.
        lead.complete();
        let later = began + Duration::from_secs(3600);
        lead.replaced(later);
        assert_eq!(lead.mean, second, "nobody waits for it");
        lead.taken(later);
        lead.replaced(later + second);
        assert_eq!(lead.mean, second);
    }
}
