//! Runs rollouts: assigns robots to the stable revision or the candidate, counts results, and carries the decisions
//! out. State is reported and stored in the database, so that the next daemon continues it.

mod orders;
mod table;

use std::sync::Arc;
use std::time::Duration;

use api::rollout::RolloutState;
use store::{NewEvent, RevisionRecord};

pub use orders::check_terms;
pub(crate) use table::Rollouts;

use super::ChoreographerInner;
use crate::decide::rollout::{AssignedRevision, PromotionBlocker, Rollout, RolloutStep, assign_revision, next_step};
use crate::lives::handle::Handle;
use crate::request::serves_no_robot;
use crate::{Error, ServantRequest};

/// Interval between evaluations.
const LOOK: Duration = Duration::from_secs(1);

fn is_ongoing(of: &Rollout) -> bool {
    matches!(of.state, RolloutState::Canary | RolloutState::Draining)
}

impl Rollouts {
    /// Records that a request to a servant of this revision was answered after so many milliseconds, or failed.
    pub(crate) fn note_request(&self, service: &str, revision: u64, millis: Option<f64>) {
        self.record(service, revision, |seen| {
            seen.requests.record(millis.is_none());
            millis.into_iter().for_each(|time| seen.times.record(time));
        });
    }

    /// Records the late answer of a request that counts as failed.
    pub(crate) fn note_late_answer(&self, service: &str, revision: u64, millis: f64) {
        self.record(service, revision, |seen| seen.times.record(millis));
    }

    /// Records that a servant became ready or failed. A measured servant does not count, since its limits may be too
    /// low for any servant.
    pub(crate) fn note_servant(&self, handle: &Handle, failed: bool) {
        if serves_no_robot(&handle.robot, handle.anonymous) {
            return;
        }
        self.record(handle.service(), handle.revision.number, |seen| {
            seen.servants.record(failed);
        });
    }

    /// Frees the canary's place of a robot without a name, which does not come back.
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

    fn record(&self, service: &str, revision: u64, change: impl FnOnce(&mut crate::decide::rollout::RevisionStats)) {
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

    /// Assigns the candidate to the robot.
    pub(crate) fn add_canary_robot(&self, service: &str, robot: &str) {
        let mut kept = self.kept.lock();
        if let Some(rollout) = kept.by_service.get_mut(service) {
            rollout.robots.push(robot.to_owned());
            kept.changed.insert(service.to_owned());
        }
    }

    /// Returns the canary revisions, each with its service.
    pub(crate) fn candidates(&self) -> Vec<(String, u64)> {
        let kept = self.kept.lock();
        let canaries = kept.by_service.iter();
        canaries
            .filter(|(_, rollout)| rollout.state == RolloutState::Canary)
            .map(|(service, rollout)| (service.clone(), rollout.candidate))
            .collect()
    }
}

impl ChoreographerInner {
    /// Loads the rollouts of an earlier daemon.
    pub(crate) fn read_rollouts(&self) -> Result<(), Error> {
        for (service, text) in self.state.rollouts()? {
            match serde_json::from_str(&text) {
                Ok(rollout) => {
                    let mut kept = self.rollouts.kept.lock();
                    kept.by_service.insert(service, rollout);
                }
                // Written by a later version: the current revision serves all.
                Err(error) => tracing::warn!("cannot read the rollout of {service}: {error}"),
            }
        }
        self.rollouts.begun.notify_one();
        Ok(())
    }

    /// Returns the revision for a robot, and whether it is newly assigned to the candidate. The assignment takes effect
    /// with [`Rollouts::add_canary_robot`]: a robot that is refused, or keeps another servant, does not use up a
    /// canary's place.
    pub(crate) fn revision_for(&self, request: &ServantRequest) -> Result<(Arc<RevisionRecord>, bool), Error> {
        let (service, robot) = (&request.service, &request.robot);
        let current = self.catalogue.current_revision(service)?;
        if serves_no_robot(robot, request.anonymous) {
            return Ok((current, false));
        }
        let (candidate, from_now) = {
            let kept = self.rollouts.kept.lock();
            let rollout = kept.by_service.get(service);
            let Some(rollout) = rollout.filter(|rollout| rollout.stable == current.number) else {
                return Ok((current, false));
            };
            match assign_revision(rollout, service, robot) {
                AssignedRevision::Current => return Ok((current, false)),
                AssignedRevision::Candidate => (rollout.candidate, false),
                AssignedRevision::CandidateFromNow => (rollout.candidate, true),
            }
        };
        Ok(match self.state.revision(service, candidate)? {
            Some(revision) => (revision, from_now),
            None => (current, false),
        })
    }

    /// Returns what blocks the promotion of a service's canary.
    fn promotion_blocker(&self, service: &str) -> Option<PromotionBlocker> {
        self.rollouts.kept.lock().waits.get(service).copied()
    }

    /// Sets what blocks the promotion of a canary, and reports it if that is new.
    fn set_promotion_blocker(&self, service: &str, candidate: u64, wait: Option<PromotionBlocker>) {
        let before = {
            let waits = &mut self.rollouts.kept.lock().waits;
            match wait {
                Some(wait) => waits.insert(service.to_owned(), wait),
                None => waits.remove(service),
            }
        };
        let news = wait.filter(|wait| !before.is_some_and(|before| before.is_same_kind(wait)));
        if let Some(wait) = news {
            let message = format!("revision {candidate} of {service} is not promoted yet: {wait}");
            let about = NewEvent { service: Some(service), ..NewEvent::default() };
            self.journal.info("rollout-waits", &message, &about);
        }
    }

    fn rollout(&self, service: &str) -> Option<Rollout> {
        self.rollouts.kept.lock().by_service.get(service).cloned()
    }

    fn write_rollout(&self, service: &str, rollout: &Rollout) -> Result<(), Error> {
        let text = serde_json::to_string(rollout).map_err(|_| Error::Internal("writing a rollout"))?;
        Ok(self.state.set_rollout(service, &text)?)
    }

    /// Writes changed counts and robots. Failed writes are retried.
    pub(crate) fn write_changed(&self) {
        let changed = std::mem::take(&mut self.rollouts.kept.lock().changed);
        for service in changed {
            let _writing = self.rollouts.writing.lock();
            let Some(rollout) = self.rollout(&service) else {
                continue;
            };
            if let Err(error) = self.write_rollout(&service, &rollout) {
                tracing::warn!("cannot write the counts of the rollout of {service}: {error}");
                self.rollouts.kept.lock().changed.insert(service);
            }
        }
    }

    /// Adds a new rollout, which replaces the last one of its service.
    fn add_rollout(&self, service: &str, rollout: Rollout) -> Result<(), Error> {
        {
            let _writing = self.rollouts.writing.lock();
            self.write_rollout(service, &rollout)?;
            let mut kept = self.rollouts.kept.lock();
            kept.by_service.insert(service.to_owned(), rollout.clone());
        }
        self.report_rollout(service, &rollout);
        Ok(())
    }

    /// Sets the state of an ongoing rollout of this candidate, in the database first, and reports it. Returns false if
    /// there is no such rollout.
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
            let Some(mut next) = rollout.filter(|it| it.candidate == candidate && is_ongoing(it)) else {
                return Ok(false);
            };
            next.state = state;
            next.reason = reason.to_owned();
            next.changed = store::now();
            self.write_rollout(service, &next)?;
            let mut kept = self.rollouts.kept.lock();
            if let Some(rollout) = kept.by_service.get_mut(service) {
                // Counts from the meantime are kept.
                (rollout.state, rollout.changed) = (next.state, next.changed);
                rollout.reason.clone_from(&next.reason);
            }
            kept.waits.remove(service);
            next
        };
        self.report_rollout(service, &next);
        Ok(true)
    }

    fn report_rollout(&self, service: &str, rollout: &Rollout) {
        let (candidate, reason) = (rollout.candidate, &rollout.reason);
        let (kind, what) = match rollout.state {
            RolloutState::Canary => ("rollout-started", "serves its first robots"),
            RolloutState::Draining => ("rollout-promoted", "serves all new robots"),
            RolloutState::Promoted => ("rollout-promoted", "serves all robots"),
            RolloutState::RolledBack => ("rollout-rolled-back", "was rolled back"),
            RolloutState::Aborted => ("rollout-aborted", "was rolled back"),
            RolloutState::Replaced => ("rollout-replaced", "was replaced"),
        };
        let message = format!("revision {candidate} of {service} {what}: {reason}");
        let about = NewEvent { service: Some(service), ..NewEvent::default() };
        match rollout.state {
            RolloutState::RolledBack => self.journal.warning(kind, &message, &about),
            _ => self.journal.info(kind, &message, &about),
        }
        self.warm_pool.wake();
    }

    fn end_servants(&self, service: &str, reason: &str, of: impl Fn(u64) -> bool) {
        let servants = self.servants.lock();
        let chosen = servants.all.values();
        for handle in chosen.filter(|it| it.service() == service && of(it.revision.number)) {
            handle.end(reason);
        }
    }

    /// Rolls a canary back: its robots get the previous revision when they come back.
    fn take_back(&self, service: &str, candidate: u64, state: RolloutState, reason: &str) -> Result<(), Error> {
        if self.set_rollout_state(service, candidate, state, reason)? {
            let words = format!("its revision was rolled back: {reason}");
            self.end_servants(service, &words, |revision| revision == candidate);
        }
        Ok(())
    }

    /// Promotes a canary to the current revision. The caller holds the turn, so it is not rolled back meanwhile. If
    /// another revision was published meanwhile, that one stays.
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

    /// Takes the next step of a service's rollout.
    async fn take_step(&self, service: &str) -> Result<(), Error> {
        let _turn = self.rollouts.turn.lock().await;
        // It may have changed before the turn was acquired.
        let Some(rollout) = self.rollout(service) else {
            return Ok(());
        };
        let candidate = rollout.candidate;
        let step = next_step(&rollout, store::now());
        let wait = match step {
            RolloutStep::Waits(wait) => Some(wait),
            _ => None,
        };
        self.set_promotion_blocker(service, candidate, wait);
        match step {
            RolloutStep::Stays | RolloutStep::Waits(_) => {}
            RolloutStep::RollsBack(reason) => {
                self.take_back(service, candidate, RolloutState::RolledBack, &reason)?;
            }
            RolloutStep::Promotes(reason) => self.promote(service, &rollout, &reason).await?,
            RolloutStep::EndsOthers => {
                let reason = "the deadline of the other revisions has passed";
                if self.set_rollout_state(service, candidate, RolloutState::Promoted, reason)? {
                    let words = format!("its deadline has passed: revision {candidate} replaces it");
                    self.end_servants(service, &words, |revision| revision != candidate);
                }
            }
        }
        Ok(())
    }
}

/// Runs the ongoing rollouts forever.
pub(crate) async fn run_rollouts(inner: Arc<ChoreographerInner>) {
    loop {
        inner.write_changed();
        let on_the_way: Vec<String> = {
            let kept = inner.rollouts.kept.lock();
            let going = kept.by_service.iter().filter(|(_, it)| is_ongoing(it));
            going.map(|(service, _)| service.clone()).collect()
        };
        for service in &on_the_way {
            if let Err(error) = inner.take_step(service).await {
                tracing::warn!("cannot continue the rollout of {service}: {error}");
            }
        }
        if on_the_way.is_empty() { inner.rollouts.begun.notified().await } else { tokio::time::sleep(LOOK).await }
    }
}
