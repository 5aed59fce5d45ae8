//! The servants of a group: they are started, join as members when they answer, retire and are taken back.

use std::collections::BTreeSet;
use std::sync::Arc;

use api::Phase;
use catalogue::names;
use store::RevisionRecord;

use crate::Lease;
use crate::decide::placement::Placement;
use crate::lives::driver::{self, ServantSource};
use crate::lives::handle::{Failure, Handle};
use crate::lives::shared_group::{GroupStage, SharedGroup, SharedServant};
use crate::lives::{ChoreographerInner, Servants};

/// Prefix of a group's name, in place of a robot's name.
const NAME_PREFIX: &str = "~group-";

/// Updates the state of the servants; returns the failure of one that never answered.
pub(super) fn observe(inner: &ChoreographerInner, shares: &SharedGroup) -> Option<Failure> {
    let mut failure = None;
    let mut servants = shares.servants.lock();
    servants.retain_mut(|one| {
        let handle = one.lease.handle();
        let life = handle.life();
        if life.is_over() || handle.is_ending() {
            let reason = life.reason().unwrap_or_else(|| "it is being ended".to_owned());
            match one.member {
                Some(member) => {
                    shares.group.leave(member, &reason);
                    let message = format!(
                        "servant {} of {} was lost with its robots' requests: {reason}",
                        handle.id, shares.revision.service
                    );
                    if life.failure.is_some() {
                        inner.journal.warning("shared-servant-lost", &message, &handle.event_context());
                    }
                }
                None => {
                    let ended = || Failure::from_reason(format!("has lost its servant: {reason}"));
                    failure = Some(life.failure.clone().unwrap_or_else(ended));
                }
            }
            return false;
        }
        let stage = match life.phase {
            Phase::Requested => GroupStage::Queued,
            Phase::Ready => GroupStage::Ready,
            _ => GroupStage::Admitted,
        };
        if let (GroupStage::Ready, None, Some(reach)) = (&stage, one.member, handle.reach()) {
            one.member = Some(shares.group.join(&handle.id, reach.bus()));
        }
        if let (true, Some(member)) = (one.retiring, one.member)
            && shares.group.member_load(member) == 0
        {
            shares.group.leave(member, "it is no longer needed");
            handle.end("fewer servants are needed");
            return false;
        }
        shares.state.send_if_modified(|known| {
            let further = matches!(
                (&*known, &stage),
                (GroupStage::Queued, GroupStage::Admitted | GroupStage::Ready)
                    | (GroupStage::Admitted, GroupStage::Ready)
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

/// Starts one more servant, or takes an existing one; returns false if the daemon is ending.
pub(super) fn start_servant(inner: &Arc<ChoreographerInner>, shares: &Arc<SharedGroup>, reason: &str) -> bool {
    let taken: BTreeSet<usize> = shares.servants.lock().iter().map(|one| one.number).collect();
    let number = (1..).find(|number| !taken.contains(number)).unwrap_or(1);
    let Some(lease) = find_or_start(inner, &shares.revision, number) else {
        return false;
    };
    let handle = Arc::clone(lease.handle());
    let message = format!("servant {} of {} now answers robots, too: {reason}", handle.id, shares.revision.service);
    inner.journal.info("shared-servant", &message, &handle.event_context());
    shares.servants.lock().push(SharedServant { number, lease, member: None, retiring: false });
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

/// Retires the servant with the fewest requests: it gets no more.
pub(super) fn retire(inner: &ChoreographerInner, shares: &SharedGroup, reason: &str) {
    let mut servants = shares.servants.lock();
    let ready = servants.iter_mut().filter(|one| !one.retiring);
    let fewest = ready.min_by_key(|one| {
        let load = one.member.map_or(0, |member| shares.group.member_load(member));
        (load, std::cmp::Reverse(one.number))
    });
    let Some(one) = fewest else { return };
    one.retiring = true;
    if let Some(member) = one.member {
        shares.group.retire(member);
    }
    let handle = one.lease.handle();
    let service = &shares.revision.service;
    let message = format!("servant {} of {service} no longer answers robots: {reason}", handle.id);
    inner.journal.info("shared-servant-retires", &message, &handle.event_context());
    // It may be idle already.
    shares.look.notify_one();
}

/// Takes back the retiring servant with the fewest requests: it gets requests again.
pub(super) fn take_back(inner: &ChoreographerInner, shares: &SharedGroup, reason: &str) {
    let mut servants = shares.servants.lock();
    let retiring = servants.iter_mut().filter(|one| one.retiring);
    let fewest = retiring.min_by_key(|one| {
        let load = one.member.map_or(0, |member| shares.group.member_load(member));
        (load, one.number)
    });
    let Some(one) = fewest else { return };
    one.retiring = false;
    if let Some(member) = one.member {
        shares.group.reinstate(member);
    }
    let handle = one.lease.handle();
    let message = format!("servant {} of {} answers robots again: {reason}", handle.id, shares.revision.service);
    inner.journal.info("shared-servant", &message, &handle.event_context());
}

/// Returns a lease of a group's servant with this number: the existing one, or a new one; `None` if the daemon is
/// ending.
fn find_or_start(inner: &Arc<ChoreographerInner>, revision: &Arc<RevisionRecord>, number: usize) -> Option<Lease> {
    let robot = format!("{NAME_PREFIX}{}-{number}", revision.number);
    let key = (revision.service.clone(), robot.clone());
    let mut servants = inner.servants.lock();
    if inner.is_ending() {
        return None;
    }
    let has = servants.given.get(&key).filter(|handle| !handle.is_ending());
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
        inner.push_limits(revision),
        Arc::clone(revision),
        store::now(),
    ));
    servants.add(key, &handle);
    let lease = Lease::new(Arc::clone(&handle), "");
    drop(servants);
    let beginning = ServantSource::Asked(warm.map(Box::new));
    driver::start(inner, handle, beginning);
    Some(lease)
}

impl Servants {
    /// Registers the handle under this key.
    fn add(&mut self, key: (String, String), handle: &Arc<Handle>) {
        self.all.insert(handle.id.clone(), Arc::clone(handle));
        self.given.insert(key, Arc::clone(handle));
    }
}
