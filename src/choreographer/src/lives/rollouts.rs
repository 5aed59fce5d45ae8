//! Brings services from one revision to another: robots are given the one or the other, what comes of it is counted, and what is
//! decided of that is carried out, told and written into the database, so that the next daemon goes on with it.

mod orders;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use api::rollout::RolloutState;
use parking_lot::Mutex;
use store::{NewEvent, RevisionRecord};
use tokio::sync::Notify;

pub use orders::check_terms;

use super::Inner;
use crate::decide::rollout::{Given, Rollout, Step, Wait, given, step};
use crate::lives::handle::Handle;
use crate::request::serves_no_robot;
use crate::{Error, ServantRequest};

/// Between two looks at what was counted.
const LOOK: Duration = Duration::from_secs(1);

/// Of all services that had one: the last.
#[derive(Default)]
pub(crate) struct Rollouts {
    /// Held for moments only: each request is counted here.
    kept: Mutex<Kept>,
    /// Held from reading what is kept until it is written, so that what is written last is the newest.
    writing: Mutex<()>,
    /// Held while a rollout begins, takes a step or is ordered to.
    turn: tokio::sync::Mutex<()>,
    /// One has begun.
    begun: Notify,
}

#[derive(Default)]
struct Kept {
    by_service: BTreeMap<String, Rollout>,
    /// Services whose counts or robots are not written yet.
    changed: BTreeSet<String>,
    /// What canaries wait for whose time to be promoted has come, by service.
    waits: BTreeMap<String, Wait>,
}

fn goes_on(of: &Rollout) -> bool {
    matches!(of.state, RolloutState::Canary | RolloutState::Draining)
}

impl Rollouts {
    /// A request to a servant of this revision was answered after so many milliseconds, or failed.
    pub(crate) fn note_request(&self, service: &str, revision: u64, millis: Option<f64>) {
        self.note(service, revision, |seen| {
            seen.requests.note(millis.is_none());
            millis.into_iter().for_each(|time| seen.times.note(time));
        });
    }

    /// A request that counts as failed, since it was late, was answered after all, after so many milliseconds.
    pub(crate) fn note_late_answer(&self, service: &str, revision: u64, millis: f64) {
        self.note(service, revision, |seen| seen.times.note(millis));
    }

    /// A servant has become ready, or has failed. One that is measured may be given limits that no servant can do with, and
    /// does not count.
    pub(crate) fn note_servant(&self, handle: &Handle, failed: bool) {
        if serves_no_robot(&handle.robot, handle.anonymous) {
            return;
        }
        self.note(handle.service(), handle.revision.number, |seen| {
            seen.servants.note(failed);
        });
    }

    /// A robot without a name is gone: it does not come back, and another takes its place in the canary.
    pub(crate) fn note_gone(&self, handle: &Handle) {
        let mut kept = self.kept.lock();
        let rollout = kept.by_service.get_mut(handle.service());
        if let Some(rollout) = rollout.filter(|_| handle.anonymous) {
            let before = rollout.robots.len();
            rollout.robots.retain(|robot| *robot != handle.robot);
            if rollout.robots.len() < before {
                kept.changed.insert(handle.service().to_owned());
            }
        }
    }

    fn note(
        &self,
        service: &str,
        revision: u64,
        change: impl FnOnce(&mut crate::decide::rollout::Seen),
    ) {
        let mut kept = self.kept.lock();
        let Some(rollout) = kept.by_service.get_mut(service) else {
            return;
        };
        let seen = match revision {
            _ if rollout.state != RolloutState::Canary => return,
            number if number == rollout.stable => &mut rollout.of_stable,
            number if number == rollout.candidate => &mut rollout.of_candidate,
            _ => return,
        };
        change(seen);
        kept.changed.insert(service.to_owned());
    }

    /// The robot is given the candidate from now on.
    pub(crate) fn takes_canary(&self, service: &str, robot: &str) {
        let mut kept = self.kept.lock();
        if let Some(rollout) = kept.by_service.get_mut(service) {
            rollout.robots.push(robot.to_owned());
            kept.changed.insert(service.to_owned());
        }
    }

    /// Revisions that serve robots besides the current ones, each with its service.
    pub(crate) fn candidates(&self) -> Vec<(String, u64)> {
        let kept = self.kept.lock();
        let canaries = kept.by_service.iter();
        canaries
            .filter(|(_, rollout)| rollout.state == RolloutState::Canary)
            .map(|(service, rollout)| (service.clone(), rollout.candidate))
            .collect()
    }
}

impl Inner {
    /// Reads what an earlier daemon had begun.
    pub(crate) fn read_rollouts(&self) -> Result<(), Error> {
        for (service, text) in self.state.rollouts()? {
            match serde_json::from_str(&text) {
                Ok(rollout) => {
                    let mut kept = self.rollouts.kept.lock();
                    kept.by_service.insert(service, rollout);
                }
                // Of a later version: the current revision serves all.
                Err(error) => tracing::warn!("the rollout of {service} cannot be read: {error}"),
            }
        }
        self.rollouts.begun.notify_one();
        Ok(())
    }

    /// The revision that a robot is given, and whether it is one more that is given the candidate. That is so once
    /// [`Rollouts::takes_canary`] is told: a robot that is refused, or keeps another servant, takes no place of a canary.
    pub(crate) fn revision_for(
        &self,
        request: &ServantRequest,
    ) -> Result<(Arc<RevisionRecord>, bool), Error> {
        let (service, robot) = (&request.service, &request.robot);
        let current = self.catalogue.current(service)?;
        if serves_no_robot(robot, request.anonymous) {
            return Ok((current, false));
        }
        let (candidate, from_now) = {
            let kept = self.rollouts.kept.lock();
            let rollout = kept.by_service.get(service);
            let Some(rollout) = rollout.filter(|rollout| rollout.stable == current.number) else {
                return Ok((current, false));
            };
            match given(rollout, service, robot) {
                Given::Current => return Ok((current, false)),
                Given::Candidate => (rollout.candidate, false),
                Given::CandidateFromNow => (rollout.candidate, true),
            }
        };
        Ok(match self.state.revision(service, candidate)? {
            Some(revision) => (revision, from_now),
            None => (current, false),
        })
    }

    /// What the canary of a service waits for whose time to be promoted has come.
    fn rollout_waits(&self, service: &str) -> Option<Wait> {
        self.rollouts.kept.lock().waits.get(service).copied()
    }

    /// Notes what a canary waits for, and tells of it when that is another thing than before.
    fn set_rollout_waits(&self, service: &str, candidate: u64, wait: Option<Wait>) {
        let before = {
            let waits = &mut self.rollouts.kept.lock().waits;
            match wait {
                Some(wait) => waits.insert(service.to_owned(), wait),
                None => waits.remove(service),
            }
        };
        let news = wait.filter(|wait| !before.is_some_and(|before| before.is_like(wait)));
        if let Some(wait) = news {
            let message = format!("revision {candidate} of {service} is not promoted yet: {wait}");
            let about = NewEvent {
                service: Some(service),
                ..NewEvent::default()
            };
            self.journal.info("rollout-waits", &message, &about);
        }
    }

    fn rollout(&self, service: &str) -> Option<Rollout> {
        self.rollouts.kept.lock().by_service.get(service).cloned()
    }

    fn write_rollout(&self, service: &str, rollout: &Rollout) -> Result<(), Error> {
        let text =
            serde_json::to_string(rollout).map_err(|_| Error::Internal("writing a rollout"))?;
        Ok(self.state.set_rollout(service, &text)?)
    }

    /// Writes the counts and robots that have changed. What cannot be written is tried again.
    pub(crate) fn write_changed(&self) {
        let changed = std::mem::take(&mut self.rollouts.kept.lock().changed);
        for service in changed {
            let _writing = self.rollouts.writing.lock();
            let Some(rollout) = self.rollout(&service) else {
                continue;
            };
            if let Err(error) = self.write_rollout(&service, &rollout) {
                tracing::warn!("the counts of the rollout of {service} are not written: {error}");
                self.rollouts.kept.lock().changed.insert(service);
            }
        }
    }

    /// A rollout that begins takes the place of the last one of its service.
    fn add_rollout(&self, service: &str, rollout: Rollout) -> Result<(), Error> {
        {
            let _writing = self.rollouts.writing.lock();
            self.write_rollout(service, &rollout)?;
            let mut kept = self.rollouts.kept.lock();
            kept.by_service.insert(service.to_owned(), rollout.clone());
        }
        self.tell_rollout(service, &rollout);
        Ok(())
    }

    /// Sets the state of a rollout that goes on and is of this candidate, in the database first; then tells of it. Whether there
    /// is such a one.
    fn set_rollout_state(
        &self,
        service: &str,
        candidate: u64,
        state: RolloutState,
        reason: &str,
    ) -> Result<bool, Error> {
        let next = {
            let _writing = self.rollouts.writing.lock();
            let rollout = self.rollout(service);
            let Some(mut next) = rollout.filter(|it| it.candidate == candidate && goes_on(it))
            else {
                return Ok(false);
            };
            next.state = state;
            next.reason = reason.to_owned();
            next.changed = store::now();
            self.write_rollout(service, &next)?;
            let mut kept = self.rollouts.kept.lock();
            if let Some(rollout) = kept.by_service.get_mut(service) {
                // What was counted meanwhile stays.
                (rollout.state, rollout.changed) = (next.state, next.changed);
                rollout.reason.clone_from(&next.reason);
            }
            kept.waits.remove(service);
            next
        };
        self.tell_rollout(service, &next);
        Ok(true)
    }

    fn tell_rollout(&self, service: &str, rollout: &Rollout) {
        let (candidate, reason) = (rollout.candidate, &rollout.reason);
        let (kind, what) = match rollout.state {
            RolloutState::Canary => ("rollout-started", "serves its first robots"),
            RolloutState::Draining => ("rollout-promoted", "serves all new robots"),
            RolloutState::Promoted => ("rollout-promoted", "serves all robots"),
            RolloutState::RolledBack => ("rollout-rolled-back", "was taken back"),
            RolloutState::Aborted => ("rollout-aborted", "was taken back"),
            RolloutState::Replaced => ("rollout-replaced", "is on its way no longer"),
        };
        let message = format!("revision {candidate} of {service} {what}: {reason}");
        let about = NewEvent {
            service: Some(service),
            ..NewEvent::default()
        };
        match rollout.state {
            RolloutState::RolledBack => self.journal.warning(kind, &message, &about),
            _ => self.journal.info(kind, &message, &about),
        }
        self.warm_pool.look();
    }

    fn end_servants(&self, service: &str, reason: &str, of: impl Fn(u64) -> bool) {
        let servants = self.servants.lock();
        let chosen = servants.all.values();
        for handle in chosen.filter(|it| it.service() == service && of(it.revision.number)) {
            handle.end(reason);
        }
    }

    /// Takes a canary back: its robots get the revision before when they come back.
    fn take_back(
        &self,
        service: &str,
        candidate: u64,
        state: RolloutState,
        reason: &str,
    ) -> Result<(), Error> {
        if self.set_rollout_state(service, candidate, state, reason)? {
            let words = format!("its revision was taken back: {reason}");
            self.end_servants(service, &words, |revision| revision == candidate);
        }
        Ok(())
    }

    /// A canary becomes the current revision. The turn is held: nobody takes it back meanwhile. Where another revision was
    /// published meanwhile, that one stays.
    async fn promote(&self, service: &str, canary: &Rollout, reason: &str) -> Result<(), Error> {
        let (stable, candidate) = (canary.stable, canary.candidate);
        if !self.catalogue.promote(service, stable, candidate).await? {
            let reason = "another revision was published";
            return self.take_back(service, candidate, RolloutState::Replaced, reason);
        }
        let state = canary.after_promotion();
        self.set_rollout_state(service, candidate, state, reason)?;
        Ok(())
    }

    /// Does what is to be done about the rollout of a service now.
    async fn take_step(&self, service: &str) -> Result<(), Error> {
        let _turn = self.rollouts.turn.lock().await;
        // Somebody else may have had the turn before.
        let Some(rollout) = self.rollout(service) else {
            return Ok(());
        };
        let candidate = rollout.candidate;
        let step = step(&rollout, store::now());
        let wait = match step {
            Step::Waits(wait) => Some(wait),
            _ => None,
        };
        self.set_rollout_waits(service, candidate, wait);
        match step {
            Step::Stays | Step::Waits(_) => {}
            Step::RollsBack(reason) => {
                self.take_back(service, candidate, RolloutState::RolledBack, &reason)?;
            }
            Step::Promotes(reason) => self.promote(service, &rollout, &reason).await?,
            Step::EndsOthers => {
                let reason = "the others' deadline is over";
                if self.set_rollout_state(service, candidate, RolloutState::Promoted, reason)? {
                    let words =
                        format!("its deadline is over: revision {candidate} takes its place");
                    self.end_servants(service, &words, |revision| revision != candidate);
                }
            }
        }
        Ok(())
    }
}

/// Looks after the rollouts that go on, for ever.
pub(crate) async fn keep(inner: Arc<Inner>) {
    loop {
        inner.write_changed();
        let on_the_way: Vec<String> = {
            let kept = inner.rollouts.kept.lock();
            let going = kept.by_service.iter().filter(|(_, it)| goes_on(it));
            going.map(|(service, _)| service.clone()).collect()
        };
        for service in &on_the_way {
            if let Err(error) = inner.take_step(service).await {
                tracing::warn!("the rollout of {service} does not go on: {error}");
            }
        }
        match on_the_way.is_empty() {
            true => inner.rollouts.begun.notified().await,
            false => tokio::time::sleep(LOOK).await,
        }
    }
}
