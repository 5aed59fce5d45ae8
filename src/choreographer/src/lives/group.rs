//! Services that robots share. Each robot has a servant of its own in name only: a place in the group ([`sit`]), which ends as a
//! servant does when its robot stays away. The group's servants are ordinary ones whose robot is the group; its task ([`keep`])
//! starts and ends them as [`group`](crate::decide::group) decides, and lives while there is a place.
//!
//! ```text
//!  robot ─▶ Handle (place) ─▶ seat ─┐                        ┌─▶ Lease ─▶ Handle `~group-1-1` ─▶ container
//!  robot ─▶ Handle (place) ─▶ seat ─┴▶ reach::group::Group ◀─┴─▶ Lease ─▶ Handle `~group-1-2` ─▶ container
//! ```

use std::collections::{BTreeSet, HashMap};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Weak};
use std::time::Duration;

use api::{GroupServant, Phase, Shared};
use catalogue::names;
use parking_lot::Mutex;
use reach::group::dispatch::{Member, Rules};
use reach::group::{Group, seat};
use store::RevisionRecord;
use tokio::sync::{Notify, watch};
use tokio::time::Instant;

use super::driver::{self, Beginning};
use super::{Inner, Servants, reaching};
use crate::decide::group::{Facts, Since, Step, given_up, look};
use crate::decide::placement::Placement;
use crate::handle::{Failure, Handle};
use crate::lives::lifetime::unneeded;
use crate::{Choreographer, Lease};

/// A group's load is looked at so often.
const LOOKS: Duration = Duration::from_millis(250);
/// Why the servants of a group end that has no robot.
const UNUSED: &str = "no robot uses the service";
/// Before the name of a group where a robot's name stands.
const NAMED: &str = "~group-";

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
    servants: Mutex<Vec<One>>,
    /// Something has happened to a servant.
    look: Notify,
}

/// How far a group is.
#[derive(Debug, Clone)]
enum Stage {
    /// None of its servants has capacity.
    Queued,
    /// One has.
    Admitted,
    /// One answers.
    Ready,
    /// None answers, or ever will.
    Over(Failure),
}

/// One of its servants.
struct One {
    number: usize,
    lease: Lease,
    member: Option<Member>,
    retiring: bool,
}

/// A robot's place; given up when it is dropped.
struct Place(Arc<Shares>);

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
        shares.seats.send_modify(|seats| *seats += 1);
        Place(shares)
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

/// The life of a robot's place in a group; from asked for to why it ended.
pub(super) async fn sit(
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

/// Starts and ends the servants of a group, until no robot has a place in it or none of them answers.
async fn keep(inner: Arc<Inner>, shares: Arc<Shares>) {
    let mut seats = shares.seats.subscribe();
    let (mut since, mut failed) = (Since::default(), None);
    let over = loop {
        if let Some(failure) = observe(&inner, &shares) {
            failed = Some(Instant::now());
            // A robot is told at once; it comes again, and so does the group.
            if shares.servants.lock().is_empty() {
                break Some(failure);
            }
        }
        if *seats.borrow_and_update() == 0 && inner.groups.leave(&shares) {
            break None;
        }
        give_up_places(&inner, &shares);
        let facts = facts(&inner, &shares, failed);
        let (step, next) = look(&facts, since, Instant::now().into_std());
        since = next;
        let acts = step.is_some();
        match step {
            Some(Step::Start(reason)) => {
                let begun = begin(&inner, &shares, &reason);
                if !begun {
                    break Some(Failure::broken("was not started: the daemon is ending"));
                }
            }
            Some(Step::TakeBack(reason)) => take_back(&inner, &shares, &reason),
            Some(Step::Retire(reason)) => retire(&inner, &shares, &reason),
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

/// The places of robots in the group.
fn places<'a>(servants: &'a Servants, shares: &'a Shares) -> impl Iterator<Item = &'a Arc<Handle>> {
    servants.all.values().filter(|handle| {
        handle.is_place()
            && handle.revision.number == shares.revision.number
            && handle.service() == shares.revision.service
    })
}

/// Ends places that robots have left, where those are too many.
fn give_up_places(inner: &Inner, shares: &Shares) {
    let servants = inner.servants.lock();
    let left = places(&servants, shares);
    let left = left.filter(|handle| !handle.is_ending() && handle.connections() == 0);
    let left = left.filter_map(|handle| Some((handle.idle_until()?, &*handle.id)));
    for id in given_up(left.collect()) {
        servants.all[id].end("robots have left more places than are kept");
    }
}

/// The shortest response time that a robot of the group wishes for.
fn desired(inner: &Inner, shares: &Shares) -> Option<Duration> {
    let servants = inner.servants.lock();
    let terms = places(&servants, shares).map(|handle| handle.terms());
    let times = terms.flat_map(|terms| terms.stated.into_values());
    times
        .filter_map(|stated| Some(stated.sla.rrt?.duration()))
        .min()
}

fn facts(inner: &Inner, shares: &Shares, failed: Option<Instant>) -> Facts {
    let desired = desired(inner, shares);
    let servants = shares.servants.lock();
    let count = |which: &dyn Fn(&One) -> bool| servants.iter().filter(|one| which(one)).count();
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

/// Takes in what has become of the servants; why one that never answered has failed.
fn observe(inner: &Inner, shares: &Shares) -> Option<Failure> {
    let mut failure = None;
    let mut servants = shares.servants.lock();
    servants.retain_mut(|one| {
        let handle = one.lease.handle();
        let life = handle.life();
        if life.is_over() || handle.is_ending() {
            let reason = life
                .reason()
                .unwrap_or_else(|| "it is being ended".to_owned());
            match one.member {
                Some(member) => {
                    shares.group.leave(member, &reason);
                    let message = format!(
                        "servant {} of {} was lost with what it worked at for robots: {reason}",
                        handle.id, shares.revision.service
                    );
                    if life.failure.is_some() {
                        inner
                            .journal
                            .warning("shared-servant-lost", &message, &handle.about());
                    }
                }
                None => {
                    let ended = || Failure::broken(format!("has lost its servant: {reason}"));
                    failure = Some(life.failure.clone().unwrap_or_else(ended));
                }
            }
            return false;
        }
        let stage = match life.phase {
            Phase::Requested => Stage::Queued,
            Phase::Ready => Stage::Ready,
            _ => Stage::Admitted,
        };
        if let (Stage::Ready, None, Some(reach)) = (&stage, one.member, handle.reach()) {
            one.member = Some(shares.group.join(&handle.id, reach.bus()));
        }
        if let (true, Some(member)) = (one.retiring, one.member)
            && shares.group.load_of(member) == 0
        {
            shares.group.leave(member, "it is not needed any more");
            handle.end("fewer servants are needed");
            return false;
        }
        shares.state.send_if_modified(|known| {
            let further = matches!(
                (&*known, &stage),
                (Stage::Queued, Stage::Admitted | Stage::Ready) | (Stage::Admitted, Stage::Ready)
            );
            if further {
                *known = stage;
            }
            further
        });
        true
    });
    failure
}

/// Starts one more servant, or takes one that is there; false where none is started any more.
fn begin(inner: &Arc<Inner>, shares: &Arc<Shares>, reason: &str) -> bool {
    let taken: BTreeSet<usize> = shares
        .servants
        .lock()
        .iter()
        .map(|one| one.number)
        .collect();
    let number = (1..).find(|number| !taken.contains(number)).unwrap_or(1);
    let Some(lease) = servant(inner, &shares.revision, number) else {
        return false;
    };
    let handle = Arc::clone(lease.handle());
    let message = format!(
        "servant {} of {} answers robots too: {reason}",
        handle.id, shares.revision.service
    );
    inner
        .journal
        .info("shared-servant", &message, &handle.about());
    shares.servants.lock().push(One {
        number,
        lease,
        member: None,
        retiring: false,
    });
    let shares = Arc::downgrade(shares);
    tokio::spawn(async move {
        let mut life = handle.watch();
        while let Some(shares) = shares.upgrade() {
            shares.look.notify_one();
            drop(shares);
            let over = life.borrow_and_update().is_over();
            if over || life.changed().await.is_err() {
                return;
            }
        }
    });
    true
}

/// The servant with the fewest requests gets no more.
fn retire(inner: &Inner, shares: &Shares, reason: &str) {
    let mut servants = shares.servants.lock();
    let ready = servants.iter_mut().filter(|one| !one.retiring);
    let fewest = ready.min_by_key(|one| {
        let load = one.member.map_or(0, |member| shares.group.load_of(member));
        (load, std::cmp::Reverse(one.number))
    });
    let Some(one) = fewest else { return };
    one.retiring = true;
    if let Some(member) = one.member {
        shares.group.retire(member);
    }
    let handle = one.lease.handle();
    let service = &shares.revision.service;
    let message = format!(
        "servant {} of {service} answers no more robots: {reason}",
        handle.id
    );
    inner
        .journal
        .info("shared-servant-retires", &message, &handle.about());
    // It may have nothing to do.
    shares.look.notify_one();
}

/// Of those that retire, the one with the fewest requests gets more again.
fn take_back(inner: &Inner, shares: &Shares, reason: &str) {
    let mut servants = shares.servants.lock();
    let retiring = servants.iter_mut().filter(|one| one.retiring);
    let fewest = retiring.min_by_key(|one| {
        let load = one.member.map_or(0, |member| shares.group.load_of(member));
        (load, one.number)
    });
    let Some(one) = fewest else { return };
    one.retiring = false;
    if let Some(member) = one.member {
        shares.group.take_back(member);
    }
    let handle = one.lease.handle();
    let message = format!(
        "servant {} of {} answers robots again: {reason}",
        handle.id, shares.revision.service
    );
    inner
        .journal
        .info("shared-servant", &message, &handle.about());
}

/// A group's servant of this number: the one that is there, or a new one; none if the daemon is ending.
fn servant(inner: &Arc<Inner>, revision: &Arc<RevisionRecord>, number: usize) -> Option<Lease> {
    let robot = format!("{NAMED}{}-{number}", revision.number);
    let key = (revision.service.clone(), robot.clone());
    let mut servants = inner.servants.lock();
    if inner.is_ending() {
        return None;
    }
    let has = servants
        .given
        .get(&key)
        .filter(|handle| !handle.is_ending());
    if let Some(handle) = has {
        return Some(Lease::new(Arc::clone(handle), ""));
    }
    let (placement, warm) = inner.warm_pool.place(None, revision, (&robot, false));
    debug_assert!(matches!(placement, Placement::Start { ends: None, .. }));
    let id = warm.as_ref().map(|warm| warm.container.id().to_owned());
    let handle = Arc::new(Handle::new(
        id.unwrap_or_else(|| names::servant_id(&revision.service)),
        robot,
        false,
        inner.of_push(revision),
        Arc::clone(revision),
        store::now(),
    ));
    servants.add(key, &handle);
    let lease = Lease::new(Arc::clone(&handle), "");
    drop(servants);
    let beginning = Beginning::Asked(warm);
    tokio::spawn(driver::drive(Arc::clone(inner), handle, beginning));
    Some(lease)
}

impl Servants {
    /// From now on the handle can be given under this key.
    fn add(&mut self, key: (String, String), handle: &Arc<Handle>) {
        self.all.insert(handle.id.clone(), Arc::clone(handle));
        self.given.insert(key, Arc::clone(handle));
    }
}
