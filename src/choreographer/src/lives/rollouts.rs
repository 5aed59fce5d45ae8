//! Brings services from one revision to another: robots are given the one or the other, what comes of it is counted, and what is
//! decided of that is carried out, told and written into the database, so that the next daemon goes on with it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use api::rollout::{RolloutState, RolloutTerms};
use package::difference::Difference;
use parking_lot::Mutex;
use store::{NewEvent, RevisionRecord};
use tokio::sync::Notify;

use super::Inner;
use crate::decide::rollout::{Given, Rollout, Step, given, step};
use crate::handle::Handle;
use crate::{Choreographer, Error};

/// Between two looks at what was counted.
const LOOK: Duration = Duration::from_secs(1);
/// Differences that are named.
const NAMED: usize = 8;

/// Of all services that had one: the last.
#[derive(Default)]
pub(crate) struct Rollouts {
    kept: Mutex<Kept>,
    /// One has begun.
    begun: Notify,
}

#[derive(Default)]
struct Kept {
    by_service: BTreeMap<String, Rollout>,
    /// Services whose counts are not written yet.
    counted: BTreeSet<String>,
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

    /// A servant has become ready, or has failed.
    pub(crate) fn note_servant(&self, handle: &Handle, failed: bool) {
        self.note(handle.service(), handle.revision.number, |seen| {
            seen.servants.note(failed);
        });
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
        kept.counted.insert(service.to_owned());
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

    /// The revision that this robot is given.
    pub(crate) fn revision_for(
        &self,
        service: &str,
        robot: &str,
        anonymous: bool,
    ) -> Result<Arc<RevisionRecord>, Error> {
        let current = self.catalogue.current(service)?;
        let candidate = {
            let mut kept = self.rollouts.kept.lock();
            let rollout = kept.by_service.get_mut(service);
            let Some(rollout) = rollout.filter(|rollout| rollout.stable == current.number) else {
                return Ok(current);
            };
            let given = given(rollout, service, robot);
            match given {
                Given::Current => return Ok(current),
                Given::Candidate => {}
                Given::CandidateFromNow if anonymous && robot.contains('-') => {
                    // It is nobody's, and there for a measurement alone.
                    return Ok(current);
                }
                Given::CandidateFromNow => {
                    rollout.robots.push(robot.to_owned());
                    // At once: a daemon that is started after this one was killed would give it to another robot.
                    let rollout = rollout.clone();
                    self.write_rollout(service, &rollout)?;
                }
            }
            kept.by_service[service].candidate
        };
        Ok(self.state.revision(service, candidate)?.unwrap_or(current))
    }

    fn rollout(&self, service: &str) -> Option<Rollout> {
        self.rollouts.kept.lock().by_service.get(service).cloned()
    }

    fn write_rollout(&self, service: &str, rollout: &Rollout) -> Result<(), Error> {
        let text =
            serde_json::to_string(rollout).map_err(|_| Error::Internal("writing a rollout"))?;
        Ok(self.state.set_rollout(service, &text)?)
    }

    /// Writes the counts that have changed.
    fn write_counts(&self) {
        let changed: Vec<(String, Rollout)> = {
            let mut kept = self.rollouts.kept.lock();
            let counted = std::mem::take(&mut kept.counted);
            let of = |service: String| {
                let rollout = kept.by_service.get(&service).cloned()?;
                Some((service, rollout))
            };
            counted.into_iter().filter_map(of).collect()
        };
        for (service, rollout) in changed {
            if let Err(error) = self.write_rollout(&service, &rollout) {
                tracing::warn!("the counts of a rollout are not written: {error}");
            }
        }
    }

    /// Sets the state of a rollout that goes on and is the one that was looked at; then tells of it.
    fn set_rollout_state(
        &self,
        service: &str,
        candidate: u64,
        state: RolloutState,
        reason: &str,
    ) -> Result<bool, Error> {
        let rollout = {
            let mut kept = self.rollouts.kept.lock();
            let rollout = kept.by_service.get_mut(service);
            let Some(rollout) = rollout.filter(|it| it.candidate == candidate && goes_on(it))
            else {
                return Ok(false);
            };
            rollout.state = state;
            rollout.reason = reason.to_owned();
            rollout.changed = store::now();
            rollout.clone()
        };
        self.write_rollout(service, &rollout)?;
        let (kind, what) = match state {
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
        match state {
            RolloutState::RolledBack => self.journal.warning(kind, &message, &about),
            _ => self.journal.info(kind, &message, &about),
        }
        self.warm_pool.look();
        Ok(true)
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

    async fn promote(&self, service: &str, rollout: &Rollout, reason: &str) -> Result<(), Error> {
        let candidate = rollout.candidate;
        self.catalogue.rollback(service, Some(candidate)).await?;
        let state = match rollout.terms.deadline {
            Some(_) => RolloutState::Draining,
            None => RolloutState::Promoted,
        };
        self.set_rollout_state(service, candidate, state, reason)?;
        Ok(())
    }

    async fn take_step(&self, service: &str, rollout: &Rollout) -> Result<(), Error> {
        let candidate = rollout.candidate;
        match step(rollout, store::now()) {
            Step::Stays => Ok(()),
            Step::RollsBack(reason) => {
                self.take_back(service, candidate, RolloutState::RolledBack, &reason)
            }
            Step::Promotes(reason) => self.promote(service, rollout, &reason).await,
            Step::EndsOthers => {
                let reason = "the others' deadline is over";
                self.set_rollout_state(service, candidate, RolloutState::Promoted, reason)?;
                let words = format!("its deadline is over: revision {candidate} takes its place");
                self.end_servants(service, &words, |revision| revision != candidate);
                Ok(())
            }
        }
    }
}

/// Looks after the rollouts that go on, for ever.
pub(crate) async fn keep(inner: Arc<Inner>) {
    loop {
        inner.write_counts();
        let on_the_way: Vec<(String, Rollout)> = {
            let kept = inner.rollouts.kept.lock();
            let going = kept.by_service.iter().filter(|(_, it)| goes_on(it));
            going.map(|(name, it)| (name.clone(), it.clone())).collect()
        };
        for (service, rollout) in &on_the_way {
            if let Err(error) = inner.take_step(service, rollout).await {
                tracing::warn!("the rollout of {service} does not go on: {error}");
            }
        }
        match on_the_way.is_empty() {
            true => inner.rollouts.begun.notified().await,
            false => tokio::time::sleep(LOOK).await,
        }
    }
}

fn shown(service: &str, of: &Rollout) -> api::Rollout {
    api::Rollout {
        service: service.to_owned(),
        stable: of.stable,
        candidate: of.candidate,
        state: of.state,
        reason: of.reason.clone(),
        started: of.started,
        changed: of.changed,
        terms: of.terms,
        of_stable: of.of_stable.shown(),
        of_candidate: of.of_candidate.shown(),
    }
}

/// Refuses terms that make no sense.
pub fn check_terms(terms: &RolloutTerms) -> Result<(), Error> {
    let times = [terms.deadline, terms.promote_after];
    let sane = |number: f64| number.is_finite() && number >= 0.0;
    if !sane(terms.bound) || !times.into_iter().flatten().all(sane) || terms.samples == 0 {
        return Err(Error::Rollout(
            "a bound, a deadline and promote_after are numbers from 0 on, and samples are at least 1".to_owned(),
        ));
    }
    if terms.promote_after.is_some() && terms.canary.is_none() {
        return Err(Error::Rollout(
            "promote_after is for a canary; say which robots it serves, such as 10%".to_owned(),
        ));
    }
    Ok(())
}

impl Choreographer {
    /// Looks after rollouts from now on, those of an earlier daemon, too.
    pub fn keep_rollouts(&self) -> Result<(), Error> {
        self.inner.read_rollouts()?;
        tokio::spawn(keep(Arc::clone(&self.inner)));
        Ok(())
    }

    /// Refuses a revision that is to be published as a canary and would break robots of the current one.
    pub fn check_canary(&self, candidate: &RevisionRecord) -> Result<(), Error> {
        fits(
            &*self.inner.catalogue.current(&candidate.service)?,
            candidate,
        )
    }

    /// The last rollout of a service.
    pub fn rollout(&self, service: &str) -> Result<api::Rollout, Error> {
        self.inner.catalogue.current(service)?;
        match self.inner.rollout(service) {
            Some(rollout) => Ok(shown(service, &rollout)),
            None => Err(Error::NoRollout(service.to_owned())),
        }
    }

    /// A published revision begins its way: as a canary beside the current one, or as the current one, the servants of others
    /// having a deadline.
    pub async fn begin_rollout(
        &self,
        service: &str,
        candidate: u64,
        terms: RolloutTerms,
    ) -> Result<api::Rollout, Error> {
        check_terms(&terms)?;
        let inner = &self.inner;
        let current = inner.catalogue.current(service)?;
        let Some(revision) = inner.state.revision(service, candidate)? else {
            return Err(Error::Rollout(format!(
                "{service} has no revision {candidate}"
            )));
        };
        let is_canary = terms.canary.is_some();
        if is_canary && candidate == current.number {
            return Err(Error::Rollout(format!(
                "revision {candidate} of {service} is the current one already"
            )));
        }
        if is_canary {
            fits(&current, &revision)?;
        }
        self.revision_changed(service, candidate)?;
        let now = store::now();
        let rollout = Rollout {
            stable: current.number,
            candidate,
            state: RolloutState::Canary,
            reason: String::new(),
            started: now,
            changed: now,
            terms,
            robots: Vec::new(),
            of_stable: Default::default(),
            of_candidate: Default::default(),
        };
        {
            let mut kept = inner.rollouts.kept.lock();
            kept.by_service.insert(service.to_owned(), rollout.clone());
        }
        match terms.canary {
            Some(share) => {
                let who = match share {
                    api::rollout::Share::Robots(1) => "the first robot that comes".to_owned(),
                    api::rollout::Share::Robots(most) => format!("the first {most} robots"),
                    share => format!("{share} of the robots"),
                };
                let reason = format!("{who} instead of revision {}", current.number);
                inner.set_rollout_state(service, candidate, RolloutState::Canary, &reason)?;
            }
            None => inner.promote(service, &rollout, "it was published").await?,
        }
        inner.rollouts.begun.notify_one();
        self.rollout(service)
    }

    /// The canary becomes the current revision.
    pub async fn promote_rollout(&self, service: &str) -> Result<api::Rollout, Error> {
        let rollout = self.canary(service)?;
        self.inner
            .promote(service, &rollout, "somebody said so")
            .await?;
        self.rollout(service)
    }

    /// The canary is taken back.
    pub fn abort_rollout(&self, service: &str) -> Result<api::Rollout, Error> {
        let rollout = self.canary(service)?;
        let (inner, state) = (&self.inner, RolloutState::Aborted);
        inner.take_back(service, rollout.candidate, state, "somebody said so")?;
        self.rollout(service)
    }

    /// Another revision than a canary becomes the current one, or is to be one: a rollout that goes on is over.
    pub fn revision_changed(&self, service: &str, to: u64) -> Result<(), Error> {
        let Some(rollout) = self.inner.rollout(service).filter(goes_on) else {
            return Ok(());
        };
        if rollout.candidate == to && rollout.state == RolloutState::Draining {
            return Ok(());
        }
        let reason = format!("revision {to} takes its place");
        let (inner, state) = (&self.inner, RolloutState::Replaced);
        match rollout.state {
            RolloutState::Canary if rollout.candidate != to => {
                inner.take_back(service, rollout.candidate, state, &reason)
            }
            _ => inner
                .set_rollout_state(service, rollout.candidate, state, &reason)
                .map(|_| ()),
        }
    }

    fn canary(&self, service: &str) -> Result<Rollout, Error> {
        let shown = self.rollout(service)?;
        let rollout = self.inner.rollout(service);
        rollout
            .filter(|rollout| rollout.state == RolloutState::Canary)
            .ok_or_else(|| {
                Error::Rollout(format!(
                    "revision {} of {service} is no canary: {} ({})",
                    shown.candidate, shown.state, shown.reason
                ))
            })
    }
}

/// Robots that were made for the stable revision have to find what they use in the candidate, too.
fn fits(stable: &RevisionRecord, candidate: &RevisionRecord) -> Result<(), Error> {
    if stable.plan.shared.is_some() || candidate.plan.shared.is_some() {
        return Err(Error::Rollout(format!(
            "revision {} of {} cannot be a canary: robots share its servants, and get the same revision",
            candidate.number, candidate.service
        )));
    }
    let difference = Difference::between(&stable.interface, &candidate.interface);
    if difference.compatible() {
        return Ok(());
    }
    let breaking = difference.changes.iter().filter(|it| !it.compatible);
    let words: Vec<String> = breaking.take(NAMED).map(ToString::to_string).collect();
    Err(Error::Rollout(format!(
        "revision {} of {} cannot be a canary: robots of revision {} would not find what they use: {}",
        candidate.number,
        candidate.service,
        stable.number,
        words.join("; ")
    )))
}
