//! Remembers which robots' servants fail, and when each may be started again.

use std::collections::HashMap;
use std::time::Duration;

use parking_lot::Mutex;
use store::RevisionRecord;
use tokio::time::Instant;

use super::Inner;
use crate::Error;
use crate::decide::back_off::{Failing, RECOVERED, after_failure, is_forgotten, refusal, seconds};
use crate::lives::handle::{Failure, Handle};

/// Robots without a name are one here: each has a name of its own, and would never meet its pause.
const NAMELESS: &str = "~";
/// What is remembered of so many robots is looked through for what can be forgotten.
const MANY: usize = 256;

/// By service and robot.
#[derive(Default)]
pub(crate) struct BackOffs {
    failing: Mutex<HashMap<(String, String), Failing>>,
}

impl BackOffs {
    /// What refuses a servant of this revision to the robot now.
    pub(crate) fn refusal(
        &self,
        service: &str,
        robot: &str,
        revision: &RevisionRecord,
    ) -> Option<(Failing, Duration)> {
        let failing = self.failing.lock();
        let known = failing.get(&(service.to_owned(), robot.to_owned()))?;
        let left = refusal(known, revision.number, Instant::now().into_std())?;
        Some((known.clone(), left))
    }

    /// Whether the last servant of this revision for the robot has failed, and that is not forgotten.
    pub(crate) fn is_failing(&self, service: &str, robot: &str, revision: &RevisionRecord) -> bool {
        let failing = self.failing.lock();
        let known = failing.get(&(service.to_owned(), robot.to_owned()));
        known.is_some_and(|known| {
            known.revision == revision.number && !is_forgotten(known, Instant::now().into_std())
        })
    }

    /// A servant has failed; gives what follows.
    pub(crate) fn failed(
        &self,
        service: &str,
        robot: &str,
        revision: &RevisionRecord,
        ready_for: Option<Duration>,
        reason: &str,
    ) -> Failing {
        let now = Instant::now().into_std();
        let mut failing = self.failing.lock();
        if failing.len() >= MANY {
            failing.retain(|_, known| !is_forgotten(known, now));
        }
        let key = (service.to_owned(), robot.to_owned());
        let of = (revision.number, robot == NAMELESS);
        let next = after_failure(failing.get(&key), of, ready_for, reason, now);
        failing.insert(key, next.clone());
        next
    }

    /// The robot's servants do not fail any more.
    pub(crate) fn recovered(&self, service: &str, robot: &str) {
        let key = (service.to_owned(), robot.to_owned());
        self.failing.lock().remove(&key);
    }
}

/// Under which name a robot's failures are remembered. Those of a measurement (`~try-…`), which may look for where a servant
/// fails, are no robot's.
fn key(robot: &str, anonymous: bool) -> &str {
    match anonymous && !robot.contains('-') {
        true => NAMELESS,
        false => robot,
    }
}

impl Inner {
    /// Refuses a servant that has failed again and again until its pause is over.
    pub(crate) fn check_back_off(
        &self,
        revision: &RevisionRecord,
        robot: &str,
        anonymous: bool,
    ) -> Result<(), Error> {
        let service = &revision.service;
        let known = self
            .back_offs
            .refusal(service, key(robot, anonymous), revision);
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

    /// Takes in how a servant's life ended.
    pub(super) fn note_end(&self, handle: &Handle, outcome: &Result<String, Failure>) {
        let (service, revision) = (handle.service(), &handle.revision);
        let robot = key(&handle.robot, handle.anonymous);
        let ready_for = handle.ready_for();
        let reason = match outcome {
            // With so little memory it was measured, and robots are given more.
            Err(_) if handle.was_out_of_memory() && handle.gives_way() => return,
            Err(Failure::Broken { reason, .. }) => reason,
            Ok(_) if ready_for.is_some_and(|time| time >= RECOVERED) => {
                return self.back_offs.recovered(service, robot);
            }
            _ => return,
        };
        let failing = self
            .back_offs
            .failed(service, robot, revision, ready_for, reason);
        let now = Instant::now().into_std();
        if let Some(left) = refusal(&failing, revision.number, now) {
            let message = format!(
                "servants of {service} for {} have failed {} times in a row; the next is started in {} s at the earliest",
                handle.robot,
                failing.failures,
                seconds(left),
            );
            let about = handle.about();
            self.journal.warning("servant-back-off", &message, &about);
        }
    }

    /// All whose pause is not over.
    pub(crate) fn back_offs(&self) -> Vec<api::BackOff> {
        let now = Instant::now().into_std();
        let failing = self.back_offs.failing.lock();
        let mut all: Vec<api::BackOff> = failing
            .iter()
            .filter_map(|((service, robot), known)| {
                let left = refusal(known, known.revision, now)?;
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
