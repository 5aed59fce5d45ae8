//! Containers made before anyone asks for them, so that a robot does not wait for their making.
//!
//! A warm container is a whole servant but for its nodes: namespaces, limits, init, ROS Master and bridge are there. Nothing in it
//! belongs to a robot, and none of the service's code has run in it. In so many of them as the operator wants the nodes run,
//! too ([`heat`]): a robot that takes them as they are finds them ready. How many there are is decided from the robots that
//! came ([`crate::decide::forecast`]). Others are made when a robot's servant is ready, so that the two do not compete. A warm
//! container that is gone when it is needed costs nothing but time: the servant is made as if there were none.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use catalogue::names;
use futures_util::FutureExt;
use futures_util::future::join_all;
use parking_lot::Mutex;
use reach::Reach;
use servant::engine::{ContainerState, Servant};
use tokio::sync::Notify;
use tokio::time::Instant;

use super::group::is_of_no_robot;
use super::waiting::Permit;
use super::{Inner, reaching, starting};
use crate::Error;
use crate::decide;
use crate::decide::Amount;
use crate::decide::forecast::{Arrivals, INTERVAL};
use crate::decide::placement::{Placement, place};
use crate::decide::warm_pool::{
    Budget, Demand, Missing, Wanted, Warm as Facts, choose, deserving, missing, sizes, stale,
};

use store::{NewEvent, RevisionRecord, ServantRecord};

/// Whose a container of the pool is in the database, from the start of its nodes until a robot takes it. No robot can give
/// itself this name.
pub(crate) const NOBODY: &str = "~warm";
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

/// All of them.
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

/// Makes and ends warm containers as they are needed, for ever.
pub(crate) async fn keep(inner: Arc<Inner>) {
    loop {
        tokio::select! {
            () = inner.warm_pool.look.notified() => {}
            () = tokio::time::sleep(INTERVAL), if inner.warm_pool.is_restless(&inner) => {}
        }
        if let Err(error) = tidy(&inner, true).await {
            tracing::warn!("no warm container could be made: {error}");
        }
    }
}

/// What the services are to have: of the revisions that robots are given, the most deserving first.
fn wanted(inner: &Inner) -> Result<Vec<(Arc<RevisionRecord>, Demand)>, Error> {
    let mut wanted = Vec::new();
    let published = inner.state.service_names()?;
    let now = Instant::now().into_std();
    let asked_for = inner.warm_pool.kept.lock().asked_for.clone();
    for service in deserving(&published, &asked_for, inner.options.warm_pool) {
        let Some(revision) = inner.state.current(&service)? else {
            continue;
        };
        let kept = inner.warm_pool.kept.lock();
        let arrivals = kept.arrivals.get(&service);
        let lead = kept.leads.get(&service);
        let demand = Demand {
            rate: arrivals.map_or(0.0, |arrivals| arrivals.expected(now)),
            lead: lead.map_or(LEAD, |lead| lead.mean),
            nodes: runs_ahead(inner, &revision)
                .then(|| inner.promised(&revision.plan.limits).memory),
        };
        wanted.push((revision, demand));
    }
    for (service, number) in inner.rollouts.candidates() {
        let of = |wanted: &(Arc<RevisionRecord>, Demand)| wanted.0.service == service;
        let demand = wanted.iter().find(|it| of(it)).map(|it| it.1);
        if let (Some(demand), Some(revision)) = (demand, inner.state.revision(&service, number)?) {
            // Few robots get it: one is enough.
            wanted.push((
                revision,
                Demand {
                    rate: 0.0,
                    ..demand
                },
            ));
        }
    }
    Ok(wanted)
}

/// Whether the revision's nodes may run without a robot: not with what they would hold from another servant, nor while they
/// fail.
fn runs_ahead(inner: &Inner, revision: &RevisionRecord) -> bool {
    let grants = &revision.plan.grants;
    let holds = !grants.devices.is_empty() || !grants.volumes.is_empty();
    let failing = inner.back_offs.refusal(&revision.service, NOBODY, revision);
    let shared = revision.plan.shared.is_some();
    !revision.plan.nodes.is_empty() && !holds && !shared && failing.is_none()
}

/// Ends those that are not wanted any more and makes, if so told, those that are missing.
pub(crate) async fn tidy(inner: &Arc<Inner>, make_missing: bool) -> Result<(), Error> {
    let pool = &inner.warm_pool;
    let _turn = pool.turn.lock().await;
    let revisions = wanted(inner)?;
    let demands: Vec<Demand> = revisions.iter().map(|(_, demand)| *demand).collect();
    let budget = Budget {
        memory: inner.options.warm_memory,
        nodes: inner.options.warm_nodes,
    };
    let sizes = sizes(&demands, budget);
    let wanted: Vec<Wanted<'_>> = revisions
        .iter()
        .zip(sizes)
        .map(|((revision, _), size)| Wanted {
            service: &revision.service,
            revision: revision.number,
            image: &revision.image,
            size,
        })
        .collect();
    let removed: Vec<Warm> = {
        let mut kept = pool.kept.lock();
        let facts: Vec<Facts<'_>> = kept.pool.iter().map(Warm::facts).collect();
        let ends = stale(&facts, &wanted);
        let ends: Vec<String> = ends.iter().map(|end| end.id.to_owned()).collect();
        // A service that is to have none any more.
        kept.leads
            .retain(|service, _| wanted.iter().any(|it| it.service == service));
        let removed: Vec<Warm> = ends.iter().filter_map(|id| kept.take(id)).collect();
        for warm in &removed {
            let promised = warm.promised(inner).unwrap_or_default();
            let id = warm.container.id().to_owned();
            kept.ending.insert(id, promised);
        }
        removed
    };
    for warm in &removed {
        report_dead(inner, warm).await;
    }
    join_all(removed.into_iter().map(|warm| warm.end(inner))).await;
    if !make_missing {
        return Ok(());
    }
    for ((revision, _), wanted) in revisions.iter().zip(&wanted) {
        loop {
            let lacks = {
                let mut kept = pool.kept.lock();
                let facts: Vec<Facts<'_>> = kept.pool.iter().map(Warm::facts).collect();
                let lacks = match missing(&facts, wanted) {
                    Missing::Nothing => None,
                    Missing::Containers(_) => Some(None),
                    Missing::Nodes(id) => Some(Some(id.to_owned())),
                };
                if let (None | Some(Some(_)), Some(lead)) =
                    (&lacks, kept.leads.get_mut(wanted.service))
                {
                    lead.complete();
                }
                lacks
            };
            let Some(nodes_of) = lacks.filter(|_| !inner.is_ending()) else {
                break;
            };
            let warm = match nodes_of {
                None => make(inner, Arc::clone(revision)).await?,
                // Capacity is not there, or somebody took it meanwhile.
                Some(id) => match heat(inner, &id).await {
                    Some(warm) => warm,
                    None => break,
                },
            };
            let fresh = !warm.nodes;
            if let Some(unwanted) = pool.put(warm) {
                unwanted.end(inner).await;
                break;
            }
            if !fresh {
                // Whoever began to wait while the nodes were started did not find what is promised to them.
                inner.make_room();
            }
            if fresh && let Some(lead) = pool.kept.lock().leads.get_mut(&revision.service) {
                lead.replaced(Instant::now());
            }
        }
    }
    Ok(())
}

/// Of one whose nodes have failed before a robot had them: that is told, and counts as a servant's failure.
async fn report_dead(inner: &Inner, warm: &Warm) {
    if !warm.nodes || warm.runs() {
        return;
    }
    let service = &warm.revision.service;
    let mut how = "it ended".to_owned();
    for node in &warm.revision.plan.nodes {
        if let Some(Ok(exit)) = warm.container.wait_node(&node.name).now_or_never() {
            let limits = warm.limits;
            how = format!("{} {}", node.name, reach::how_it_ended(&exit, &limits));
        }
    }
    let about = NewEvent {
        service: Some(service),
        ..NewEvent::default()
    };
    let message = format!("a servant of {service} that was kept ready for a robot failed: {how}");
    inner.journal.warning("warm-failed", &message, &about);
    let back_offs = &inner.back_offs;
    back_offs.failed(
        service,
        NOBODY,
        &warm.revision,
        None,
        &format!("lost {how}"),
    );
}

async fn make(inner: &Arc<Inner>, revision: Arc<RevisionRecord>) -> Result<Warm, Error> {
    let id = names::servant_id(&revision.service);
    let limits = inner.of_push(&revision).limits();
    let spec = starting::spec(inner, &id, &revision, &limits, Vec::new())?;
    let container = inner.engine.start(spec).await?;
    let limit = inner.options.start;
    let reached = tokio::time::timeout(limit, reaching::open(inner, &revision, &container)).await;
    match reached {
        Ok(Ok(reach)) => Ok(Warm {
            container,
            reach,
            limits,
            nodes: false,
            permit: None,
            revision,
        }),
        failed => {
            container.stop().await?;
            tracing::debug!(
                "warm container {id}: {:?}",
                failed.map(|reached| reached.err())
            );
            Err(Error::Internal("reaching a warm container's ROS Master"))
        }
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

/// Starts the nodes in one of the pool, which is in nobody's reach meanwhile. What they may use is promised from here on, where
/// it is free and nobody waits for it.
async fn heat(inner: &Arc<Inner>, id: &str) -> Option<Warm> {
    let mut warm = inner.warm_pool.kept.lock().take(id)?;
    let revision = Arc::clone(&warm.revision);
    let wanted = inner.promised(&revision.plan.limits);
    let Some(permit) = inner.admission.admit_now(wanted) else {
        if let Some(unwanted) = inner.warm_pool.put(warm) {
            unwanted.end(inner).await;
        }
        return None;
    };
    let record = ServantRecord {
        id: id.to_owned(),
        service: revision.service.clone(),
        revision: revision.number,
        robot: NOBODY.to_owned(),
        anonymous: true,
        created: store::now(),
        limits: api::Limits::default(),
        terms: None,
    };
    warm.permit = Some(permit);
    // A daemon that is killed now finds out by this that nobody misses it.
    let recorded = inner.state.add_servant(&record);
    warm.nodes = true;
    let nodes = revision.plan.nodes.iter().cloned();
    let started = join_all(nodes.map(|node| warm.container.start_node(node))).await;
    if recorded.is_err() || started.iter().any(Result::is_err) {
        let (service, reason) = (&revision.service, "could not be started");
        inner
            .back_offs
            .failed(service, NOBODY, &revision, None, reason);
        warm.end(inner).await;
        return None;
    }
    Some(warm)
}

/// Takes a warm container back that its robot left unused, or ends it.
pub(crate) async fn give_back(inner: &Inner, warm: Warm) {
    if let Some(unwanted) = inner.warm_pool.put(warm) {
        unwanted.end(inner).await;
    }
}

/// Ends all of them and makes no more.
pub(crate) async fn end_all(inner: &Inner) {
    let all = {
        let mut kept = inner.warm_pool.kept.lock();
        kept.closed = true;
        std::mem::take(&mut kept.pool)
    };
    join_all(all.into_iter().map(|warm| warm.end(inner))).await;
    // One that is being made just now is ended by whoever makes it.
    let _turn = inner.warm_pool.turn.lock().await;
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
