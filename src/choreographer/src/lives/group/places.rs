//! A robot's place in a group, which it has instead of a servant of its own, from its request to its end.

use std::sync::{Arc, Weak};
use std::time::Duration;

use api::{Phase, Shared};
use reach::group::open_seat;
use store::RevisionRecord;

use crate::decide::group::expired_places;
use crate::lives::handle::{Failure, Handle};
use crate::lives::lifetime::wait_unneeded;
use crate::lives::shared_group::{GroupStage, SharedGroup};
use crate::lives::{ChoreographerInner, Servants, reaching};

/// A robot's place; given up on drop.
pub(super) struct GroupPlace(Arc<SharedGroup>);

impl GroupPlace {
    pub(super) fn new(shares: Arc<SharedGroup>) -> GroupPlace {
        shares.seats.send_modify(|seats| *seats += 1);
        GroupPlace(shares)
    }
}

impl Drop for GroupPlace {
    fn drop(&mut self) {
        self.0.seats.send_modify(|seats| *seats -= 1);
    }
}

impl Handle {
    /// Returns true if it is a robot's place in a group, rather than a container.
    pub fn is_place(&self) -> bool {
        is_place(&self.revision, &self.robot)
    }
}

/// Returns true if this robot gets a place in a group of the revision.
pub(crate) fn is_place(revision: &RevisionRecord, robot: &str) -> bool {
    revision.plan.shared.is_some() && !is_internal_robot(robot)
}

/// Returns true if a servant with this robot name serves no robot: it belongs to a group, or is measured. No robot can
/// have such a name.
pub(crate) fn is_internal_robot(robot: &str) -> bool {
    robot.starts_with('~')
}

/// Runs the life of a robot's place in a group; returns the reason of its end.
pub(in crate::lives) async fn run_place(
    inner: &Arc<ChoreographerInner>,
    handle: &Arc<Handle>,
    rules: Shared,
) -> Result<String, Failure> {
    let place = inner.groups.join(inner, handle, rules);
    tokio::select! {
        biased;
        reason = handle.wait_end_requested() => Ok(reason),
        failure = serve_place(inner, handle, &place.0) => Err(failure),
        reason = wait_unneeded(inner, handle, true) => Ok(reason),
    }
}

/// Gives the robot its place as soon as a servant answers; returns when none does any more.
async fn serve_place(inner: &ChoreographerInner, handle: &Arc<Handle>, shares: &SharedGroup) -> Failure {
    let mut state = shares.state.subscribe();
    let mut reached = async |ready: bool| {
        let there = |stage: &GroupStage| match stage {
            GroupStage::Queued => false,
            GroupStage::Admitted => !ready,
            GroupStage::Ready | GroupStage::Over(_) => true,
        };
        match state.wait_for(there).await.as_deref() {
            Ok(GroupStage::Over(failure)) => Err(failure.clone()),
            Ok(_) => Ok(()),
            Err(_) => Err(Failure::from_reason("lost its shared servants")),
        }
    };
    if let Err(failure) = reached(false).await {
        return failure;
    }
    handle.set_phase(Phase::Admitted);
    if let Err(failure) = reached(true).await {
        return failure;
    }
    let known = match inner.catalogue.revision_contents(&handle.revision).await {
        Ok(known) => known,
        Err(error) => return Failure::from_reason(format!("cannot be used: {error}")),
    };
    let (options, observer) = reaching::reach_options(inner, &handle.revision, &handle.id);
    let recorded = reaching::recorded_revision(&handle.revision, known);
    let reach = open_seat(&shares.group, &handle.id, recorded, options, observer);
    let tenant: Weak<Handle> = Arc::downgrade(handle);
    reach.bind_tenant(tenant);
    handle.set_reach(reach);
    handle.set_phase(Phase::Ready);
    let took = store::now().saturating_sub(handle.created);
    let message = format!("robot {} shares the servants of {} after {took} ms", handle.robot, handle.service());
    inner.journal.info("servant-ready", &message, &handle.event_context());
    let over = state.wait_for(|stage| matches!(stage, GroupStage::Over(_))).await;
    match over.as_deref() {
        Ok(GroupStage::Over(failure)) => failure.clone(),
        _ => Failure::from_reason("lost its shared servants"),
    }
}

/// Returns the places of robots in the group.
fn places<'a>(servants: &'a Servants, shares: &'a SharedGroup) -> impl Iterator<Item = &'a Arc<Handle>> {
    servants.all.values().filter(|handle| {
        handle.is_place()
            && handle.revision.number == shares.revision.number
            && handle.service() == shares.revision.service
    })
}

/// Ends places that robots have left, if there are too many.
pub(super) fn end_excess_places(inner: &ChoreographerInner, shares: &SharedGroup) {
    let servants = inner.servants.lock();
    let left = places(&servants, shares);
    let left = left.filter(|handle| !handle.is_ending() && handle.connections() == 0);
    let left = left.filter_map(|handle| Some((handle.idle_until()?, &*handle.id)));
    for id in expired_places(left.collect()) {
        servants.all[id].end("too many robots have left");
    }
}

/// Returns the shortest response time desired by a robot of the group.
pub(super) fn shortest_desired_time(inner: &ChoreographerInner, shares: &SharedGroup) -> Option<Duration> {
    let servants = inner.servants.lock();
    let terms = places(&servants, shares).map(|handle| handle.terms());
    let times = terms.flat_map(|terms| terms.stated.into_values());
    times.filter_map(|stated| Some(stated.sla.rrt?.duration())).min()
}
