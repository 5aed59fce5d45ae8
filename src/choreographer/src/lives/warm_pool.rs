//! Containers made in advance, so that a robot does not wait for them.
//!
//! A warm container is a complete servant except for its nodes: namespaces, limits, init, ROS Master and bridge exist.
//! Nothing in it belongs to a robot, and none of the service's code has run in it. In as many of them as configured the
//! nodes run, too ([`start_nodes`](keeping)): a robot that takes them unchanged finds them ready. The number follows
//! from the arrivals of robots ([`crate::decide::forecast`]). Further ones are made when a robot's servant is ready, so
//! that the two do not compete. If a warm container is gone when it is needed, the servant is made without it; only
//! time is lost.

mod keeping;
mod pool;

use std::sync::Arc;

use futures_util::FutureExt;
use servant::engine::ContainerState;
use tokio::time::Instant;

use super::ChoreographerInner;
use super::group::is_internal_robot;
use crate::decide;
use crate::decide::Amount;
use crate::decide::forecast::Arrivals;
use crate::decide::placement::{Placement, place};
use crate::decide::warm_pool::{WarmContainer as Facts, choose_container};
use store::RevisionRecord;

pub(crate) use keeping::{end_all, give_back, run, tidy};
use pool::{LeadTime, WarmPoolState};
pub(crate) use pool::{WarmPool, WarmServant};

/// Robot name of the pool's containers in the database, from the start of their nodes until a robot takes them. No
/// robot can give itself this name.
pub(crate) const NOBODY: &str = "~warm";
/// Robot name in the back-off for services whose containers cannot be made.
const UNMADE: &str = "~warm-container";
/// Weight of the last lead time in their mean.
const LAST: f64 = 0.3;
/// Maximum number of taken containers of one service whose times are remembered until they are replaced.
const MAX_TAKEN_TIMES: usize = 64;

impl LeadTime {
    fn record_taken(&mut self, now: Instant) {
        self.taken.push_back(now);
        if self.taken.len() > MAX_TAKEN_TIMES {
            self.taken.pop_front();
        }
    }

    fn record_replaced(&mut self, now: Instant) {
        if let Some(taken) = self.taken.pop_front() {
            self.mean = self.mean.mul_f64(1.0 - LAST) + (now - taken).mul_f64(LAST);
        }
    }

    /// No container is missing: earlier ones are not to be replaced.
    fn clear(&mut self) {
        self.taken.clear();
    }
}

impl WarmServant {
    /// Returns true if neither it nor one of its nodes has ended, except for nodes that the engine restarts.
    fn runs(&self) -> bool {
        let mut own = self.revision.plan.nodes.iter();
        let ended = |name: &str| self.container.wait_node(name).now_or_never().is_some();
        *self.container.state().borrow() == ContainerState::Running
            && !(self.nodes && own.any(|node| !node.respawn && ended(&node.name)))
    }

    /// Returns it as input for decisions.
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

    fn promised_amount(&self, inner: &ChoreographerInner) -> Option<Amount> {
        self.permit.as_ref()?;
        Some(inner.promised_amount(&self.revision.plan.limits))
    }

    /// Ends it completely.
    pub(crate) async fn end(self, inner: &ChoreographerInner) {
        self.reach.close("the warm container is not needed");
        let id = self.container.id();
        if let Err(error) = self.container.stop().await {
            tracing::warn!("cannot clean up warm container {id}: {error}");
        }
        if self.nodes {
            inner.state.remove_servant(id);
        }
        drop(self.permit);
        inner.warm_pool.kept.lock().ending.remove(id);
    }
}

impl WarmPool {
    /// Decides which servant a robot gets that requests this revision and `has` that servant so far. Also returns the
    /// warm container from which a new one is to be made, if any. Records that the service was requested, and the
    /// arrival of a robot if `robot` names one. `default_names`: the robot takes the revision's nodes unchanged.
    pub(crate) fn place<'a>(
        &self,
        has: Option<&decide::ServantFacts<'a>>,
        revision: &RevisionRecord,
        (robot, default_names): (&str, bool),
    ) -> (Placement<'a>, Option<WarmServant>) {
        let mut kept = self.kept.lock();
        let service = &revision.service;
        let wanted = (&**service, revision.number, &*revision.image);
        let warm = choose_container(kept.pool.iter().map(WarmServant::facts), wanted, default_names);
        let placement = place(has, warm.as_ref(), revision.number, &revision.image);
        let Placement::Start { warm: used, .. } = placement else {
            return (placement, None);
        };
        let id = warm.filter(|_| used).map(|warm| warm.id.to_owned());
        let now = Instant::now();
        kept.asked_for.retain(|asked| asked != service);
        kept.asked_for.push(service.clone());
        if !is_internal_robot(robot) {
            let arrivals = kept.arrivals.entry(service.clone());
            arrivals.or_insert_with(|| Arrivals::new(now.into_std())).record_arrival(now.into_std());
        }
        let taken = id.and_then(|id| kept.take(&id));
        if taken.is_some() {
            kept.leads.entry(service.clone()).or_default().record_taken(now);
        }
        (placement, taken)
    }

    /// Adds a new container, or one that its robot did not use; returns it if it is not wanted.
    fn put(&self, warm: WarmServant) -> Option<WarmServant> {
        let mut kept = self.kept.lock();
        // A robot has taken over the promise of its nodes.
        if kept.closed || (warm.nodes && warm.permit.is_none()) {
            return Some(warm);
        }
        kept.pool.push(warm);
        None
    }

    /// Triggers a check of the pool.
    pub(crate) fn wake(&self) {
        self.look.notify_one();
    }

    /// Returns the number of containers, and of those with running nodes.
    pub(crate) fn count(&self) -> (usize, usize) {
        let kept = self.kept.lock();
        let nodes = kept.pool.iter().filter(|warm| warm.nodes).count();
        (kept.pool.len(), nodes)
    }

    /// Returns the images of the containers.
    pub(crate) fn images(&self) -> Vec<String> {
        let kept = self.kept.lock();
        let images = kept.pool.iter().map(|warm| warm.revision.image.clone());
        images.collect()
    }

    /// Returns the containers with running nodes, which count as unused servants: they end before any that a robot has
    /// left.
    pub(crate) fn promised_servants(&self, inner: &ChoreographerInner) -> Vec<(String, Amount, bool)> {
        let kept = self.kept.lock();
        let pooled = kept.pool.iter();
        let pooled =
            pooled.filter_map(|warm| Some((warm.container.id().to_owned(), warm.promised_amount(inner)?, false)));
        let ending = kept.ending.iter();
        let ending = ending.map(|(id, amount)| (id.clone(), *amount, true));
        pooled.chain(ending).collect()
    }

    /// Ends a container for a robot that waits for its capacity; returns false if it is not in the pool.
    pub(crate) fn end_for_room(&self, inner: &Arc<ChoreographerInner>, id: &str) -> bool {
        let mut kept = self.kept.lock();
        let Some(warm) = kept.take(id) else {
            return false;
        };
        let promised = warm.promised_amount(inner).unwrap_or_default();
        kept.ending.insert(id.to_owned(), promised);
        let inner = Arc::clone(inner);
        tokio::spawn(async move { warm.end(&inner).await });
        true
    }

    /// Returns true if the wanted containers may change with time alone.
    fn needs_timer(&self, inner: &ChoreographerInner) -> bool {
        let kept = self.kept.lock();
        let now = Instant::now().into_std();
        // Nodes exit, and the pauses after failures end.
        inner.options.warm_nodes > 0 || kept.arrivals.values().any(|service| service.expected_rate(now) > 0.0)
    }
}

impl WarmPoolState {
    fn take(&mut self, id: &str) -> Option<WarmServant> {
        let index = self.pool.iter().position(|warm| warm.container.id() == id);
        index.map(|index| self.pool.remove(index))
    }
}

impl ChoreographerInner {
    /// Takes a warm container back, if there is one, that its robot cannot have; returns at once.
    pub(crate) fn give_back(self: &Arc<Self>, warm: Option<WarmServant>) {
        if let Some(unwanted) = warm.and_then(|warm| self.warm_pool.put(warm)) {
            let inner = Arc::clone(self);
            tokio::spawn(async move { unwanted.end(&inner).await });
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn what_is_not_to_be_replaced_makes_no_lead_longer() {
        let (began, second) = (Instant::now(), Duration::from_secs(1));
        let mut lead = LeadTime::default();
        for _ in 0..5 {
            lead.record_taken(began);
        }
        lead.record_replaced(began + second);
        assert_eq!(lead.mean, second);
        // One of five is enough for the present arrivals.
        lead.clear();
        let later = began + Duration::from_secs(3600);
        lead.record_replaced(later);
        assert_eq!(lead.mean, second, "nobody waits for it");
        lead.record_taken(later);
        lead.record_replaced(later + second);
        assert_eq!(lead.mean, second);
    }
}
