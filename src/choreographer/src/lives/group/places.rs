//! A robot's place in a group: what it has instead of a servant of its own, from asked for to why it ended.

use std::sync::{Arc, Weak};
use std::time::Duration;

use api::{Phase, Shared};
use reach::group::seat;
use store::RevisionRecord;

use super::{Shares, Stage};
use crate::decide::group::given_up;
use crate::lives::handle::{Failure, Handle};
use crate::lives::lifetime::unneeded;
use crate::lives::{Inner, Servants, reaching};

/// A robot's place; given up when it is dropped.
pub(super) struct Place(Arc<Shares>);

impl Place {
    pub(super) fn new(shares: Arc<Shares>) -> Place {
        shares.seats.send_modify(|seats| *seats += 1);
        Place(shares)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.0.seats.send_modify(|seats| *seats -= 1);
    }
}

impl Handle {
    /// Whether it is a robot's place in a group, rather than a container.
    pub fn is_place(&self) -> bool {
        is_place(&self.revision, &self.robot)
    }
}

/// Whether what this one is given of a revision is a place in a group.
pub(crate) fn is_place(revision: &RevisionRecord, robot: &str) -> bool {
    revision.plan.shared.is_some() && !is_of_no_robot(robot)
}

/// Whether a servant of this robot's name serves none: it is a group's, or is measured. No robot can be named so.
pub(crate) fn is_of_no_robot(robot: &str) -> bool {
    robot.starts_with('~')
}

/// The life of a robot's place in a group; from asked for to why it ended.
pub(in crate::lives) async fn sit(
    inner: &Arc<Inner>,
    handle: &Arc<Handle>,
    rules: Shared,
) -> Result<String, Failure> {
    let place = inner.groups.enter(inner, handle, rules);
    tokio::select! {
        biased;
        reason = handle.end_asked() => Ok(reason),
        failure = seated(inner, handle, &place.0) => Err(failure),
        reason = unneeded(inner, handle, true) => Ok(reason),
    }
}

/// Gives the robot its place as soon as a servant answers; comes back when none does any more.
async fn seated(inner: &Inner, handle: &Arc<Handle>, shares: &Shares) -> Failure {
    let mut state = shares.state.subscribe();
    let mut reached = async |ready: bool| {
        let there = |stage: &Stage| match stage {
            Stage::Queued => false,
            Stage::Admitted => !ready,
            Stage::Ready | Stage::Over(_) => true,
        };
        match state.wait_for(there).await.as_deref() {
            Ok(Stage::Over(failure)) => Err(failure.clone()),
            Ok(_) => Ok(()),
            Err(_) => Err(Failure::broken("lost the group that it shares")),
        }
    };
    if let Err(failure) = reached(false).await {
        return failure;
    }
    handle.set_phase(Phase::Admitted);
    if let Err(failure) = reached(true).await {
        return failure;
    }
    let known = match inner.catalogue.known(&handle.revision).await {
        Ok(known) => known,
        Err(error) => return Failure::broken(format!("cannot be used: {error}")),
    };
    let (options, observer) = reaching::habits(inner, &handle.revision, &handle.id);
    let recorded = reaching::recorded(&handle.revision, known);
    let reach = seat(&shares.group, &handle.id, recorded, options, observer);
    let tenant: Weak<Handle> = Arc::downgrade(handle);
    reach.bind(tenant);
    handle.set_reach(reach);
    handle.set_phase(Phase::Ready);
    let took = store::now().saturating_sub(handle.created);
    let message = format!(
        "robot {} shares the servants of {} after {took} ms",
        handle.robot,
        handle.service()
    );
    inner
        .journal
        .info("servant-ready", &message, &handle.about());
    let over = state
        .wait_for(|stage| matches!(stage, Stage::Over(_)))
        .await;
    match over.as_deref() {
        Ok(Stage::Over(failure)) => failure.clone(),
        _ => Failure::broken("lost the group that it shares"),
    }
}

/// The places of robots in the group.
fn places<'a>(servants: &'a Servants, shares: &'a Shares) -> impl Iterator<Item = &'a Arc<Handle>> {
    servants.all.values().filter(|handle| {
        handle.is_place()
            && handle.revision.number == shares.revision.number
            && handle.service() == shares.revision.service
    })
}

/// Ends places that robots have left, where those are too many.
pub(super) fn give_up_places(inner: &Inner, shares: &Shares) {
    let servants = inner.servants.lock();
    let left = places(&servants, shares);
    let left = left.filter(|handle| !handle.is_ending() && handle.connections() == 0);
    let left = left.filter_map(|handle| Some((handle.idle_until()?, &*handle.id)));
    for id in given_up(left.collect()) {
        servants.all[id].end("robots have left more places than are kept");
    }
}

/// The shortest response time that a robot of the group wishes for.
pub(super) fn desired(inner: &Inner, shares: &Shares) -> Option<Duration> {
    let servants = inner.servants.lock();
    let terms = places(&servants, shares).map(|handle| handle.terms());
    let times = terms.flat_map(|terms| terms.stated.into_values());
    times
        .filter_map(|stated| Some(stated.sla.rrt?.duration()))
        .min()
}
