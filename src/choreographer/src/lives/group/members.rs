//! The servants of a group: begun, taken in as members when they answer, retired and taken back.

use std::collections::BTreeSet;
use std::sync::Arc;

use api::Phase;
use catalogue::names;
use reach::group::dispatch::Member;
use store::RevisionRecord;

use super::{Shares, Stage};
use crate::Lease;
use crate::decide::placement::Placement;
use crate::lives::driver::{self, Beginning};
use crate::lives::handle::{Failure, Handle};
use crate::lives::{Inner, Servants};

/// Before the name of a group where a robot's name stands.
const NAMED: &str = "~group-";

/// SharedServant of its servants.
pub(super) struct SharedServant {
    pub(super) number: usize,
    pub(super) lease: Lease,
    pub(super) member: Option<Member>,
    pub(super) retiring: bool,
}

/// Takes in what has become of the servants; why one that never answered has failed.
pub(super) fn observe(inner: &Inner, shares: &Shares) -> Option<Failure> {
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
pub(super) fn begin(inner: &Arc<Inner>, shares: &Arc<Shares>, reason: &str) -> bool {
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
    shares.servants.lock().push(SharedServant {
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
pub(super) fn retire(inner: &Inner, shares: &Shares, reason: &str) {
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
pub(super) fn take_back(inner: &Inner, shares: &Shares, reason: &str) {
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
