//! Containers made before anyone asks for them, so that a robot does not wait for their making.
//!
//! A spare is a whole servant but for its nodes: namespaces, limits, init, ROS Master and bridge are there. Nothing in it
//! belongs to a robot, and none of the service's code has run in it. The services used last have one each; a robot that
//! takes it has only the nodes to wait for, and the next one is made when that robot's servant is ready, so that the two
//! do not compete. A spare that is gone when it is needed costs nothing but time: the servant is made as if there were none.

use std::collections::HashMap;
use std::sync::Arc;

use catalogue::names;
use futures_util::future::join_all;
use parking_lot::Mutex;
use reach::Reach;
use servant::engine::{ContainerState, Servant};
use tokio::sync::Notify;

use super::{Inner, driver, reaching};
use crate::{Asked, Error};
use store::RevisionRecord;

/// A servant without nodes.
pub(crate) struct Spare {
    /// Its container.
    pub(crate) container: Arc<dyn Servant>,
    /// Its ROS and its bridge.
    pub(crate) reach: Arc<Reach>,
    revision: Arc<RevisionRecord>,
}

/// All of them.
#[derive(Default)]
pub(crate) struct Spares {
    kept: Mutex<Kept>,
    /// Something may be missing or too many.
    look: Notify,
    /// Held while spares are made or ended.
    turn: tokio::sync::Mutex<()>,
}

#[derive(Default)]
struct Kept {
    by_service: HashMap<String, Spare>,
    /// Services in the order in which robots asked for them, the last one last.
    asked_for: Vec<String>,
    closed: bool,
}

impl Spare {
    fn runs(&self) -> bool {
        matches!(
            *self.container.state().borrow(),
            ContainerState::Running { .. }
        )
    }

    fn is_of(&self, revision: &RevisionRecord) -> bool {
        self.revision.number == revision.number && self.revision.image == revision.image
    }

    /// Ends it; nothing is left.
    pub(crate) async fn end(self) {
        self.reach.bridge.close("the spare is not needed");
        if let Err(error) = self.container.stop().await {
            let id = self.container.id();
            tracing::warn!("spare {id} could not be cleaned up: {error}");
        }
    }
}

impl Spares {
    /// Gives the one of this revision, if there is one that lives, and remembers that the service was asked for.
    pub(crate) fn take(&self, revision: &RevisionRecord) -> Option<Spare> {
        let mut kept = self.kept.lock();
        kept.asked_for
            .retain(|service| *service != revision.service);
        kept.asked_for.push(revision.service.clone());
        let fits = kept
            .by_service
            .get(&revision.service)
            .is_some_and(|spare| spare.is_of(revision) && spare.runs());
        fits.then(|| kept.by_service.remove(&revision.service))
            .flatten()
    }

    /// Takes one back that its robot had no use for; gives it if it is not wanted here either.
    fn put_back(&self, spare: Spare) -> Option<Spare> {
        let mut kept = self.kept.lock();
        if kept.closed || kept.by_service.contains_key(&spare.revision.service) {
            return Some(spare);
        }
        kept.by_service
            .insert(spare.revision.service.clone(), spare);
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
            .map(|spare| spare.revision.image.clone())
            .collect()
    }

    /// Removes those that are not of one of these revisions, or do not live.
    fn remove_all_but(&self, wanted: &[Arc<RevisionRecord>]) -> Vec<Spare> {
        let mut kept = self.kept.lock();
        let (stay, leave) =
            std::mem::take(&mut kept.by_service)
                .into_iter()
                .partition(|(_, spare)| {
                    spare.runs() && wanted.iter().any(|revision| spare.is_of(revision))
                });
        kept.by_service = stay;
        leave.into_values().collect()
    }

    fn has(&self, service: &str) -> bool {
        self.kept.lock().by_service.contains_key(service)
    }

    /// The services of `published` that are to have one, those asked for last first.
    fn deserving(&self, published: Vec<String>, count: usize) -> Vec<String> {
        let kept = self.kept.lock();
        let asked = kept.asked_for.iter().rev().cloned();
        let mut order: Vec<String> = asked
            .filter(|service| published.contains(service))
            .collect();
        for service in published {
            if !order.contains(&service) {
                order.push(service);
            }
        }
        order.truncate(count);
        order
    }
}

/// Makes and ends spares as they are needed, for ever.
pub(crate) async fn keep(inner: Arc<Inner>) {
    loop {
        inner.spares.look.notified().await;
        if let Err(error) = tidy(&inner, true).await {
            tracing::warn!("no spare container could be made: {error}");
        }
    }
}

/// Ends those that are not wanted any more and makes, if so told, those that are missing.
pub(crate) async fn tidy(inner: &Arc<Inner>, make_missing: bool) -> Result<(), Error> {
    let _turn = inner.spares.turn.lock().await;
    let mut wanted = Vec::new();
    let published = inner.state.service_names()?;
    let deserving = inner.spares.deserving(published, inner.options.spares);
    for service in deserving {
        wanted.extend(inner.state.current(&service)?);
    }
    join_all(
        inner
            .spares
            .remove_all_but(&wanted)
            .into_iter()
            .map(Spare::end),
    )
    .await;
    for revision in wanted.into_iter().filter(|_| make_missing) {
        if inner.is_ending() || inner.spares.has(&revision.service) {
            continue;
        }
        let spare = make(inner, revision).await?;
        if let Some(unwanted) = inner.spares.put_back(spare) {
            unwanted.end().await;
        }
    }
    Ok(())
}

async fn make(inner: &Arc<Inner>, revision: Arc<RevisionRecord>) -> Result<Spare, Error> {
    let id = names::servant_id(&revision.service);
    let limits = Asked::new(revision.plan.limits, inner.options.limits).limits();
    let spec = driver::spec(inner, &id, &revision, &limits, Vec::new()).await?;
    let container = inner.engine.start(spec).await?;
    let limit = inner.options.start;
    let reached = tokio::time::timeout(limit, reaching::open(inner, &revision, &container)).await;
    match reached {
        Ok(Ok(reach)) => Ok(Spare {
            container,
            reach,
            revision,
        }),
        failed => {
            container.stop().await?;
            tracing::debug!("spare {id}: {:?}", failed.map(|reached| reached.err()));
            Err(Error::Internal("reaching a spare container's ROS Master"))
        }
    }
}

/// Takes a spare back that its robot left unused, or ends it.
pub(crate) async fn give_back(inner: &Inner, spare: Spare) {
    if let Some(unwanted) = inner.spares.put_back(spare) {
        unwanted.end().await;
    }
}

/// Ends all of them and makes no more.
pub(crate) async fn end_all(inner: &Inner) {
    let all = {
        let mut kept = inner.spares.kept.lock();
        kept.closed = true;
        std::mem::take(&mut kept.by_service)
    };
    join_all(all.into_values().map(Spare::end)).await;
    // One that is being made just now is ended by whoever makes it.
    let _turn = inner.spares.turn.lock().await;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_services_asked_for_last_have_spares() {
        let spares = Spares::default();
        let published = || ["a", "b", "c", "d"].map(str::to_owned).to_vec();
        assert_eq!(spares.deserving(published(), 2), ["a", "b"]);
        for service in ["c", "gone", "d", "c"] {
            let mut kept = spares.kept.lock();
            kept.asked_for.retain(|asked| asked != service);
            kept.asked_for.push(service.to_owned());
        }
        assert_eq!(spares.deserving(published(), 3), ["c", "d", "a"]);
        assert!(spares.deserving(published(), 0).is_empty());
    }
}
