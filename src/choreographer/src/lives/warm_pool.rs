//! Containers made before anyone asks for them, so that a robot does not wait for their making.
//!
//! A warm container is a whole servant but for its nodes: namespaces, limits, init, ROS Master and bridge are there. Nothing in it
//! belongs to a robot, and none of the service's code has run in it. The services used last have one each; a robot that
//! takes it has only the nodes to wait for, and the next one is made when that robot's servant is ready, so that the two
//! do not compete. A warm container that is gone when it is needed costs nothing but time: the servant is made as if there were none.

use std::collections::HashMap;
use std::sync::Arc;

use catalogue::names;
use futures_util::future::join_all;
use parking_lot::Mutex;
use reach::Reach;
use servant::engine::{ContainerState, Servant};
use tokio::sync::Notify;

use super::{Inner, reaching, starting};
use crate::Error;
use crate::decide;
use crate::decide::placement::{Placement, place};
use crate::decide::warm_pool::{Wanted, Warm as Facts, deserving, stale};

use store::RevisionRecord;

/// A servant without nodes.
pub(crate) struct Warm {
    /// Its container.
    pub(crate) container: Arc<dyn Servant>,
    /// Its ROS and its bridge.
    pub(crate) reach: Arc<dyn Reach>,
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
    by_service: HashMap<String, Warm>,
    /// Services in the order in which robots asked for them, the last one last.
    asked_for: Vec<String>,
    closed: bool,
}

impl Warm {
    fn runs(&self) -> bool {
        *self.container.state().borrow() == ContainerState::Running
    }

    /// As decisions see it.
    fn facts(&self) -> Facts<'_> {
        Facts {
            id: self.container.id(),
            service: &self.revision.service,
            revision: self.revision.number,
            image: &self.revision.image,
            runs: self.runs(),
        }
    }

    /// Ends it; nothing is left.
    pub(crate) async fn end(self) {
        self.reach.close("the warm container is not needed");
        if let Err(error) = self.container.stop().await {
            let id = self.container.id();
            tracing::warn!("warm container {id} could not be cleaned up: {error}");
        }
    }
}

impl WarmPool {
    /// Decides which servant a robot is given that asks for this revision and `has` that servant so far. Where a new one is
    /// to be made of a warm container, gives that; and remembers that the service was asked for.
    pub(crate) fn place<'a>(
        &self,
        has: Option<&decide::Servant<'a>>,
        revision: &RevisionRecord,
    ) -> (Placement<'a>, Option<Warm>) {
        let mut kept = self.kept.lock();
        let service = &revision.service;
        let warm = kept.by_service.get(service).map(Warm::facts);
        let placement = place(has, warm.as_ref(), revision.number, &revision.image);
        let Placement::Start { warm, .. } = placement else {
            return (placement, None);
        };
        kept.asked_for.retain(|asked| asked != service);
        kept.asked_for.push(service.clone());
        let taken = warm.then(|| kept.by_service.remove(service));
        (placement, taken.flatten())
    }

    /// Takes one back that its robot had no use for; gives it if it is not wanted here either.
    fn put_back(&self, warm: Warm) -> Option<Warm> {
        let mut kept = self.kept.lock();
        if kept.closed || kept.by_service.contains_key(&warm.revision.service) {
            return Some(warm);
        }
        kept.by_service.insert(warm.revision.service.clone(), warm);
        None
    }

    /// Has a look taken, soon, at what is missing.
    pub(crate) fn look(&self) {
        self.look.notify_one();
    }

    /// How many there are.
    pub(crate) fn count(&self) -> usize {
        self.kept.lock().by_service.len()
    }

    /// Images that they were made from.
    pub(crate) fn images(&self) -> Vec<String> {
        let kept = self.kept.lock();
        kept.by_service
            .values()
            .map(|warm| warm.revision.image.clone())
            .collect()
    }

    /// Removes those that are not of one of these revisions, or do not run.
    fn remove_stale(&self, wanted: &[Arc<RevisionRecord>]) -> Vec<Warm> {
        let wanted: Vec<Wanted<'_>> = wanted
            .iter()
            .map(|revision| Wanted {
                service: &revision.service,
                revision: revision.number,
                image: &revision.image,
            })
            .collect();
        let kept = &mut *self.kept.lock();
        let ends = stale(kept.by_service.values().map(Warm::facts), &wanted);
        let ends: Vec<String> = ends.iter().map(|end| end.id.to_owned()).collect();
        let pool = std::mem::take(&mut kept.by_service).into_iter();
        let (removed, stay): (HashMap<_, Warm>, _) =
            pool.partition(|(_, warm)| ends.iter().any(|id| id == warm.container.id()));
        kept.by_service = stay;
        removed.into_values().collect()
    }

    fn has(&self, service: &str) -> bool {
        self.kept.lock().by_service.contains_key(service)
    }
}

/// Makes and ends warm containers as they are needed, for ever.
pub(crate) async fn keep(inner: Arc<Inner>) {
    loop {
        inner.warm_pool.look.notified().await;
        if let Err(error) = tidy(&inner, true).await {
            tracing::warn!("no warm container could be made: {error}");
        }
    }
}

/// Ends those that are not wanted any more and makes, if so told, those that are missing.
pub(crate) async fn tidy(inner: &Arc<Inner>, make_missing: bool) -> Result<(), Error> {
    let _turn = inner.warm_pool.turn.lock().await;
    let mut wanted = Vec::new();
    let published = inner.state.service_names()?;
    let asked_for = inner.warm_pool.kept.lock().asked_for.clone();
    for service in deserving(&published, &asked_for, inner.options.warm_pool) {
        wanted.extend(inner.state.current(&service)?);
    }
    join_all(
        inner
            .warm_pool
            .remove_stale(&wanted)
            .into_iter()
            .map(Warm::end),
    )
    .await;
    for revision in wanted.into_iter().filter(|_| make_missing) {
        if inner.is_ending() || inner.warm_pool.has(&revision.service) {
            continue;
        }
        let warm = make(inner, revision).await?;
        if let Some(unwanted) = inner.warm_pool.put_back(warm) {
            unwanted.end().await;
        }
    }
    Ok(())
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
        if let Some(unwanted) = warm.and_then(|warm| self.warm_pool.put_back(warm)) {
            tokio::spawn(unwanted.end());
        }
    }
}

/// Takes a warm container back that its robot left unused, or ends it.
pub(crate) async fn give_back(inner: &Inner, warm: Warm) {
    if let Some(unwanted) = inner.warm_pool.put_back(warm) {
        unwanted.end().await;
    }
}

/// Ends all of them and makes no more.
pub(crate) async fn end_all(inner: &Inner) {
    let all = {
        let mut kept = inner.warm_pool.kept.lock();
        kept.closed = true;
        std::mem::take(&mut kept.by_service)
    };
    join_all(all.into_values().map(Warm::end)).await;
    // One that is being made just now is ended by whoever makes it.
    let _turn = inner.warm_pool.turn.lock().await;
}
