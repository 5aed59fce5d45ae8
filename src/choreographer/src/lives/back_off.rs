//! Tracks which robots' servants fail, and when each may be started again.

mod failures;

use std::time::Duration;

use store::RevisionRecord;
use tokio::time::Instant;

use super::ChoreographerInner;
use crate::Error;
use crate::decide::back_off::{FailureStreak, RECOVERY_TIME, after_failure, is_forgotten, remaining_pause, seconds};
use crate::lives::handle::{Failure, Handle};

pub(crate) use failures::BackOffs;

/// Common key of robots without a name: each has a name of its own, and would never see its pause.
const NAMELESS: &str = "~";
/// Number of entries from which on expired ones are removed.
const PRUNE_FROM: usize = 256;

impl BackOffs {
    /// Returns the failures that forbid a servant of this revision for the robot now, with the remaining pause.
    pub(crate) fn find_refusal(
        &self,
        service: &str,
        robot: &str,
        revision: &RevisionRecord,
    ) -> Option<(FailureStreak, Duration)> {
        let failing = self.failing.lock();
        let known = failing.get(&(service.to_owned(), robot.to_owned()))?;
        let left = remaining_pause(known, revision.number, Instant::now().into_std())?;
        Some((known.clone(), left))
    }

    /// Returns true if the robot's last servant of this revision has failed and that is not forgotten.
    pub(crate) fn is_failing(&self, service: &str, robot: &str, revision: &RevisionRecord) -> bool {
        let failing = self.failing.lock();
        let known = failing.get(&(service.to_owned(), robot.to_owned()));
        known.is_some_and(|known| known.revision == revision.number && !is_forgotten(known, Instant::now().into_std()))
    }

    /// Records the failure of a servant; returns the resulting state.
    pub(crate) fn record_failure(
        &self,
        service: &str,
        robot: &str,
        revision: &RevisionRecord,
        ready_for: Option<Duration>,
        reason: &str,
    ) -> FailureStreak {
        let now = Instant::now().into_std();
        let mut failing = self.failing.lock();
        if failing.len() >= PRUNE_FROM {
            failing.retain(|_, known| !is_forgotten(known, now));
        }
        let key = (service.to_owned(), robot.to_owned());
        let of = (revision.number, robot == NAMELESS);
        let next = after_failure(failing.get(&key), of, ready_for, reason, now);
        failing.insert(key, next.clone());
        next
    }

    /// Clears the failures of the robot's servants.
    pub(crate) fn clear(&self, service: &str, robot: &str) {
        let key = (service.to_owned(), robot.to_owned());
        self.failing.lock().remove(&key);
    }
}

/// Returns the key of a robot's failures. A measurement (`~try-…`), which may look for the limits at which a servant
/// fails, is no robot.
fn back_off_key(robot: &str, anonymous: bool) -> &str {
    if anonymous && !robot.contains('-') { NAMELESS } else { robot }
}

impl ChoreographerInner {
    /// Refuses a servant that has failed repeatedly until its pause is over.
    pub(crate) fn check_back_off(&self, revision: &RevisionRecord, robot: &str, anonymous: bool) -> Result<(), Error> {
        let service = &revision.service;
        let known = self.back_offs.find_refusal(service, back_off_key(robot, anonymous), revision);
        match known {
            None => Ok(()),
            Some((failing, again)) => Err(Error::BackOff {
                service: service.clone(),
                robot: robot.to_owned(),
                failures: failing.failures,
                reason: failing.reason,
                again,
            }),
        }
    }

    /// Records how a servant's life ended.
    pub(super) fn note_end(&self, handle: &Handle, outcome: &Result<String, Failure>) {
        let (service, revision) = (handle.service(), &handle.revision);
        let robot = back_off_key(&handle.robot, handle.anonymous);
        let ready_for = handle.ready_for();
        let reason = match outcome {
            // It was measured with little memory, and robots are given more.
            Err(_) if handle.was_out_of_memory() && handle.gives_way() => return,
            Err(Failure::Broken { reason, .. }) => reason,
            Ok(_) if ready_for.is_some_and(|time| time >= RECOVERY_TIME) => {
                return self.back_offs.clear(service, robot);
            }
            _ => return,
        };
        let failing = self.back_offs.record_failure(service, robot, revision, ready_for, reason);
        let now = Instant::now().into_std();
        if let Some(left) = remaining_pause(&failing, revision.number, now) {
            let message = format!(
                "servants of {service} for {} have failed {} times in a row; next start in {} s at the earliest",
                handle.robot,
                failing.failures,
                seconds(left),
            );
            let about = handle.event_context();
            self.journal.warning("servant-back-off", &message, &about);
        }
    }

    /// Returns all entries whose pause is not over.
    pub(crate) fn back_offs(&self) -> Vec<api::BackOff> {
        let now = Instant::now().into_std();
        let failing = self.back_offs.failing.lock();
        let mut all: Vec<api::BackOff> = failing
            .iter()
            .filter_map(|((service, robot), known)| {
                let left = remaining_pause(known, known.revision, now)?;
                Some(api::BackOff {
                    service: service.clone(),
                    robot: robot.clone(),
                    revision: known.revision,
                    failures: known.failures,
                    reason: known.reason.clone(),
                    again: store::now() + left.as_millis() as u64,
                })
            })
            .collect();
        all.sort_by(|one, other| (&one.service, &one.robot).cmp(&(&other.service, &other.robot)));
        all
    }
}
