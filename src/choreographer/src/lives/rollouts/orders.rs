//! What is ordered of rollouts: that one begins, that its canary is promoted or taken back, that another revision takes its place.

use std::sync::Arc;

use api::rollout::{RolloutState, RolloutTerms};
use package::difference::Difference;
use store::RevisionRecord;

use super::{Inner, Rollout, Wait, goes_on, keep};
use crate::{Choreographer, Error};

/// Differences that are named.
const NAMED: usize = 8;

fn shown(service: &str, of: &Rollout, waits: Option<Wait>) -> api::Rollout {
    api::Rollout {
        service: service.to_owned(),
        stable: of.stable,
        candidate: of.candidate,
        state: of.state,
        reason: of.reason.clone(),
        waits: waits.map(|wait| wait.to_string()),
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
            Some(rollout) => {
                let waits = self.inner.rollout_waits(service);
                Ok(shown(service, &rollout, waits))
            }
            None => Err(Error::NoRollout(service.to_owned())),
        }
    }

    /// A published revision begins its way: as a canary beside the current one, or as the current one, the servants of others
    /// having a deadline. `stable` is the revision that was the current one, where `candidate` is it already.
    pub async fn begin_rollout(
        &self,
        service: &str,
        stable: Option<u64>,
        candidate: u64,
        terms: RolloutTerms,
    ) -> Result<api::Rollout, Error> {
        check_terms(&terms)?;
        let inner = &self.inner;
        let _turn = inner.rollouts.turn.lock().await;
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
        inner.replace_rollout(service, candidate)?;
        let now = store::now();
        let mut rollout = Rollout {
            stable: stable.unwrap_or(current.number),
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
        match terms.canary {
            Some(share) => {
                let who = match share {
                    api::rollout::Share::Robots(1) => "the first robot that comes".to_owned(),
                    api::rollout::Share::Robots(most) => format!("the first {most} robots"),
                    share => format!("{share} of the robots"),
                };
                rollout.reason = format!("{who} instead of revision {}", current.number);
            }
            None => {
                let catalogue = &inner.catalogue;
                if !catalogue
                    .promote(service, current.number, candidate)
                    .await?
                {
                    return Err(Error::Rollout(format!(
                        "another revision of {service} was published meanwhile; say again which is to be the current one"
                    )));
                }
                rollout.state = rollout.after_promotion();
                rollout.reason = "it was published".to_owned();
            }
        }
        inner.add_rollout(service, rollout)?;
        inner.rollouts.begun.notify_one();
        self.rollout(service)
    }

    /// The canary becomes the current revision.
    pub async fn promote_rollout(&self, service: &str) -> Result<api::Rollout, Error> {
        let inner = &self.inner;
        let _turn = inner.rollouts.turn.lock().await;
        let canary = self.canary(service)?;
        inner.promote(service, &canary, "somebody said so").await?;
        self.rollout(service)
    }

    /// The canary is taken back.
    pub async fn abort_rollout(&self, service: &str) -> Result<api::Rollout, Error> {
        let inner = &self.inner;
        let _turn = inner.rollouts.turn.lock().await;
        let (canary, state) = (self.canary(service)?, RolloutState::Aborted);
        inner.take_back(service, canary.candidate, state, "somebody said so")?;
        self.rollout(service)
    }

    /// Another revision than a canary has become the current one: a rollout that goes on is over.
    pub async fn revision_changed(&self, service: &str, to: u64) -> Result<(), Error> {
        let _turn = self.inner.rollouts.turn.lock().await;
        self.inner.replace_rollout(service, to)
    }

    /// A service was removed: its rollout is over, and nobody is told.
    pub async fn forget_rollout(&self, service: &str) {
        let rollouts = &self.inner.rollouts;
        let _turn = rollouts.turn.lock().await;
        let mut kept = rollouts.kept.lock();
        kept.by_service.remove(service);
        kept.changed.remove(service);
        kept.waits.remove(service);
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

impl Inner {
    /// Ends a rollout that goes on, since revision `to` is, or is to be, the current one.
    fn replace_rollout(&self, service: &str, to: u64) -> Result<(), Error> {
        let Some(rollout) = self.rollout(service).filter(goes_on) else {
            return Ok(());
        };
        let candidate = rollout.candidate;
        if candidate == to && rollout.state == RolloutState::Draining {
            return Ok(());
        }
        let reason = format!("revision {to} takes its place");
        let state = RolloutState::Replaced;
        if rollout.state == RolloutState::Canary && candidate != to {
            return self.take_back(service, candidate, state, &reason);
        }
        self.set_rollout_state(service, candidate, state, &reason)?;
        Ok(())
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
