//! Services that robots share. Each robot has a servant in name only: a place in the group ([`places`]), which ends
//! like a servant when its robot stays away. The group's servants are ordinary ones whose robot is the group; its task
//! ([`run_group`]) starts and ends them as [`group`](crate::decide::group) decides, and lives as long as there is a
//! place.
//!
//! ```text
//!  robot ─▶ Handle (place) ─▶ seat ─┐                        ┌─▶ Lease ─▶ Handle `~group-1-1` ─▶ container
//!  robot ─▶ Handle (place) ─▶ seat ─┴▶ reach::group::Group ◀─┴─▶ Lease ─▶ Handle `~group-1-2` ─▶ container
//! ```

mod members;
mod places;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use api::{GroupServant, Shared};
use parking_lot::Mutex;
use reach::group::ServantGroup;
use reach::group::dispatch::Rules;
use store::RevisionRecord;
use tokio::sync::{Notify, watch};
use tokio::time::Instant;

use super::ChoreographerInner;
use crate::Choreographer;
use crate::decide::group::{GroupAction, GroupFacts, LoadSince, decide_group};
use crate::lives::handle::{Failure, Handle};

use super::shared_group::{GroupStage, Groups, SharedGroup, SharedServant};
use places::GroupPlace;

pub(super) use places::run_place;
pub(crate) use places::{is_internal_robot, is_place};

/// Interval between evaluations of a group's load.
const LOOKS: Duration = Duration::from_millis(250);
/// Reason for ending the servants of a group without robots.
const END_WITHOUT_ROBOTS: &str = "no robot uses the service";

impl Groups {
    fn join(&self, inner: &Arc<ChoreographerInner>, handle: &Handle, rules: Shared) -> GroupPlace {
        let revision = &handle.revision;
        let mut all = self.all.lock();
        let key = (revision.service.clone(), revision.number);
        let known = all.get(&key).cloned();
        let over = |shares: &Arc<SharedGroup>| matches!(*shares.state.borrow(), GroupStage::Over(_));
        let shares = match known.filter(|known| !over(known)) {
            Some(known) => known,
            None => {
                let shares = Arc::new(SharedGroup::new(revision, rules));
                all.insert(key, Arc::clone(&shares));
                tokio::spawn(run_group(Arc::clone(inner), Arc::clone(&shares)));
                shares
            }
        };
        GroupPlace::new(shares)
    }

    /// Removes a group that is unused or over; returns true if so.
    fn remove_if_unused(&self, shares: &Arc<SharedGroup>) -> bool {
        let mut all = self.all.lock();
        let over = matches!(*shares.state.borrow(), GroupStage::Over(_));
        if !over && *shares.seats.borrow() > 0 {
            return false;
        }
        // Under the lock: a robot that comes now creates a new group, which must not take these servants over and lose
        // them.
        for one in shares.servants.lock().iter() {
            one.lease.handle().end(END_WITHOUT_ROBOTS);
        }
        let key = (shares.revision.service.clone(), shares.revision.number);
        if all.get(&key).is_some_and(|known| Arc::ptr_eq(known, shares)) {
            all.remove(&key);
        }
        true
    }
}

impl SharedGroup {
    fn new(revision: &Arc<RevisionRecord>, shared: Shared) -> SharedGroup {
        let rules =
            Rules { window: shared.calls as usize, replicas: shared.replicas as usize, idempotent: shared.idempotent };
        let flavour = &revision.flavour;
        SharedGroup {
            group: ServantGroup::new(flavour.ros.ros_version(), &flavour.distribution, &revision.interface, rules),
            revision: Arc::clone(revision),
            rules: shared,
            state: watch::Sender::new(GroupStage::Queued),
            seats: watch::Sender::new(0),
            servants: Mutex::default(),
            look: Notify::new(),
        }
    }

    fn describe(&self) -> api::Group {
        let servants = self.servants.lock();
        let servants = servants.iter().map(|one| GroupServant {
            id: one.lease.handle().id.clone(),
            ready: one.member.is_some(),
            retiring: one.retiring,
            under_way: one.member.map_or(0, |member| self.group.member_load(member)),
        });
        let counts = self.group.counts();
        api::Group {
            revision: self.revision.number,
            robots: *self.seats.borrow(),
            servants: servants.collect(),
            waiting: self.group.load().waiting,
            answered: counts.answered.load(Ordering::Relaxed),
            failed: counts.failed.load(Ordering::Relaxed),
            asked_again: counts.asked_again.load(Ordering::Relaxed),
            wasted: counts.wasted.load(Ordering::Relaxed),
            mean_ms: counts.mean_response_time().map(|mean| mean.as_secs_f64() * 1000.0),
        }
    }
}

impl Choreographer {
    /// Returns the groups of a service, newest revision first.
    pub fn groups(&self, service: &str) -> Vec<api::Group> {
        let all = self.inner.groups.all.lock();
        let of = all.values().filter(|shares| shares.revision.service == service);
        let mut groups: Vec<api::Group> = of.map(|shares| shares.describe()).collect();
        drop(all);
        groups.sort_by_key(|group| std::cmp::Reverse(group.revision));
        groups
    }
}

/// Starts and ends the servants of a group, until no robot has a place in it or none of them answers.
async fn run_group(inner: Arc<ChoreographerInner>, shares: Arc<SharedGroup>) {
    let mut seats = shares.seats.subscribe();
    let (mut since, mut failed) = (LoadSince::default(), None);
    let over = loop {
        if let Some(failure) = members::observe(&inner, &shares) {
            failed = Some(Instant::now());
            // The robot is told at once; it comes again, and a new group starts.
            if shares.servants.lock().is_empty() {
                break Some(failure);
            }
        }
        if *seats.borrow_and_update() == 0 && inner.groups.remove_if_unused(&shares) {
            break None;
        }
        places::end_excess_places(&inner, &shares);
        let facts = group_facts(&inner, &shares, failed);
        let (step, next) = decide_group(&facts, since, Instant::now().into_std());
        since = next;
        let acts = step.is_some();
        match step {
            Some(GroupAction::Start(reason)) => {
                let begun = members::start_servant(&inner, &shares, &reason);
                if !begun {
                    break Some(Failure::from_reason("was not started: the daemon is ending"));
                }
            }
            Some(GroupAction::TakeBack(reason)) => members::take_back(&inner, &shares, &reason),
            Some(GroupAction::Retire(reason)) => members::retire(&inner, &shares, &reason),
            None => {}
        }
        if !acts {
            tokio::select! {
                _ = seats.changed() => {}
                () = shares.look.notified() => {}
                () = tokio::time::sleep(LOOKS) => {}
            }
        }
    };
    if let Some(failure) = over {
        shares.state.send_replace(GroupStage::Over(failure));
        inner.groups.remove_if_unused(&shares);
    }
    for one in std::mem::take(&mut *shares.servants.lock()) {
        if let Some(member) = one.member {
            shares.group.leave(member, END_WITHOUT_ROBOTS);
        }
    }
}

fn group_facts(inner: &ChoreographerInner, shares: &SharedGroup, failed: Option<Instant>) -> GroupFacts {
    let desired = places::shortest_desired_time(inner, shares);
    let servants = shares.servants.lock();
    let count = |which: &dyn Fn(&SharedServant) -> bool| servants.iter().filter(|one| which(one)).count();
    GroupFacts {
        bounds: (shares.rules.min as usize, shares.rules.max as usize),
        ready: count(&|one| one.member.is_some() && !one.retiring),
        starting: count(&|one| one.member.is_none() && !one.retiring),
        retiring: count(&|one| one.retiring),
        requests: shares.group.mean_load(),
        time: shares.group.counts().mean_response_time().zip(desired),
        failed: failed.map(Instant::into_std),
        calm: inner.options.grace,
    }
}
