//! Services that robots share. Each robot has a servant of its own in name only: a place in the group ([`places`]), which ends as a
//! servant does when its robot stays away. The group's servants are ordinary ones whose robot is the group; its task ([`keep`])
//! starts and ends them as [`group`](crate::decide::group) decides, and lives while there is a place.
//!
//! ```text
//!  robot ─▶ Handle (place) ─▶ seat ─┐                        ┌─▶ Lease ─▶ Handle `~group-1-1` ─▶ container
//!  robot ─▶ Handle (place) ─▶ seat ─┴▶ reach::group::Group ◀─┴─▶ Lease ─▶ Handle `~group-1-2` ─▶ container
//! ```

mod members;
mod places;

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use api::{GroupServant, Shared};
use parking_lot::Mutex;
use reach::group::Group;
use reach::group::dispatch::Rules;
use store::RevisionRecord;
use tokio::sync::{Notify, watch};
use tokio::time::Instant;

use super::Inner;
use crate::Choreographer;
use crate::decide::group::{Facts, Since, Step, look};
use crate::lives::handle::{Failure, Handle};

use members::SharedServant;
use places::Place;

pub(super) use places::sit;
pub(crate) use places::{is_of_no_robot, is_place};

/// A group's load is looked at so often.
const LOOKS: Duration = Duration::from_millis(250);
/// Why the servants of a group end that has no robot.
const UNUSED: &str = "no robot uses the service";

/// All groups, by service and revision.
#[derive(Default)]
pub(crate) struct Groups {
    all: Mutex<HashMap<(String, u64), Arc<Shares>>>,
}

/// A group, and what its robots wait for.
struct Shares {
    group: Arc<Group>,
    revision: Arc<RevisionRecord>,
    rules: Shared,
    state: watch::Sender<Stage>,
    seats: watch::Sender<usize>,
    servants: Mutex<Vec<SharedServant>>,
    /// Something has happened to a servant.
    look: Notify,
}

/// How far a group is.
#[derive(Debug, Clone)]
enum Stage {
    /// None of its servants has capacity.
    Queued,
    /// SharedServant has.
    Admitted,
    /// SharedServant answers.
    Ready,
    /// None answers, or ever will.
    Over(Failure),
}

impl Groups {
    fn enter(&self, inner: &Arc<Inner>, handle: &Handle, rules: Shared) -> Place {
        let revision = &handle.revision;
        let mut all = self.all.lock();
        let key = (revision.service.clone(), revision.number);
        let known = all.get(&key).cloned();
        let over = |shares: &Arc<Shares>| matches!(*shares.state.borrow(), Stage::Over(_));
        let shares = match known.filter(|known| !over(known)) {
            Some(known) => known,
            None => {
                let shares = Arc::new(Shares::new(revision, rules));
                all.insert(key, Arc::clone(&shares));
                tokio::spawn(keep(Arc::clone(inner), Arc::clone(&shares)));
                shares
            }
        };
        Place::new(shares)
    }

    /// Forgets a group that nobody uses, or that is over; whether that was so.
    fn leave(&self, shares: &Arc<Shares>) -> bool {
        let mut all = self.all.lock();
        let over = matches!(*shares.state.borrow(), Stage::Over(_));
        if !over && *shares.seats.borrow() > 0 {
            return false;
        }
        // Under the lock: a robot that comes now begins a group, which must not find these and lose them.
        for one in shares.servants.lock().iter() {
            one.lease.handle().end(UNUSED);
        }
        let key = (shares.revision.service.clone(), shares.revision.number);
        if all
            .get(&key)
            .is_some_and(|known| Arc::ptr_eq(known, shares))
        {
            all.remove(&key);
        }
        true
    }
}

impl Shares {
    fn new(revision: &Arc<RevisionRecord>, shared: Shared) -> Shares {
        let rules = Rules {
            window: shared.calls as usize,
            replicas: shared.replicas as usize,
            idempotent: shared.idempotent,
        };
        let flavour = &revision.flavour;
        Shares {
            group: Group::new(
                flavour.ros.bus(),
                &flavour.distribution,
                &revision.interface,
                rules,
            ),
            revision: Arc::clone(revision),
            rules: shared,
            state: watch::Sender::new(Stage::Queued),
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
            under_way: one.member.map_or(0, |member| self.group.load_of(member)),
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
            mean_ms: counts.mean().map(|mean| mean.as_secs_f64() * 1000.0),
        }
    }
}

impl Choreographer {
    /// What robots share of a service: its groups, the newest revision first.
    pub fn groups(&self, service: &str) -> Vec<api::Group> {
        let all = self.inner.groups.all.lock();
        let of = all
            .values()
            .filter(|shares| shares.revision.service == service);
        let mut groups: Vec<api::Group> = of.map(|shares| shares.describe()).collect();
        drop(all);
        groups.sort_by_key(|group| std::cmp::Reverse(group.revision));
        groups
    }
}

/// Starts and ends the servants of a group, until no robot has a place in it or none of them answers.
async fn keep(inner: Arc<Inner>, shares: Arc<Shares>) {
    let mut seats = shares.seats.subscribe();
    let (mut since, mut failed) = (Since::default(), None);
    let over = loop {
        if let Some(failure) = members::observe(&inner, &shares) {
            failed = Some(Instant::now());
            // A robot is told at once; it comes again, and so does the group.
            if shares.servants.lock().is_empty() {
                break Some(failure);
            }
        }
        if *seats.borrow_and_update() == 0 && inner.groups.leave(&shares) {
            break None;
        }
        places::give_up_places(&inner, &shares);
        let facts = facts(&inner, &shares, failed);
        let (step, next) = look(&facts, since, Instant::now().into_std());
        since = next;
        let acts = step.is_some();
        match step {
            Some(Step::Start(reason)) => {
                let begun = members::begin(&inner, &shares, &reason);
                if !begun {
                    break Some(Failure::broken("was not started: the daemon is ending"));
                }
            }
            Some(Step::TakeBack(reason)) => members::take_back(&inner, &shares, &reason),
            Some(Step::Retire(reason)) => members::retire(&inner, &shares, &reason),
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
        shares.state.send_replace(Stage::Over(failure));
        inner.groups.leave(&shares);
    }
    for one in std::mem::take(&mut *shares.servants.lock()) {
        if let Some(member) = one.member {
            shares.group.leave(member, UNUSED);
        }
    }
}

fn facts(inner: &Inner, shares: &Shares, failed: Option<Instant>) -> Facts {
    let desired = places::desired(inner, shares);
    let servants = shares.servants.lock();
    let count =
        |which: &dyn Fn(&SharedServant) -> bool| servants.iter().filter(|one| which(one)).count();
    Facts {
        bounds: (shares.rules.min as usize, shares.rules.max as usize),
        ready: count(&|one| one.member.is_some() && !one.retiring),
        starting: count(&|one| one.member.is_none() && !one.retiring),
        retiring: count(&|one| one.retiring),
        requests: shares.group.mean_load(),
        time: shares.group.counts().mean().zip(desired),
        failed: failed.map(Instant::into_std),
        calm: inner.options.grace,
    }
}
