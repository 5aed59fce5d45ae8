//! Orders for rollouts: start, promotion, abort, and replacement by another revision.

use std::sync::Arc;

use api::rollout::{RolloutState, RolloutTerms};
use package::difference::Difference;
use store::RevisionRecord;

use super::{ChoreographerInner, PromotionBlocker, Rollout, is_ongoing, run_rollouts};
use crate::{Choreographer, Error};

/// Maximum number of differences named in an error.
const MAX_NAMED_DIFFERENCES: usize = 8;

fn to_api(service: &str, of: &Rollout, waits: Option<PromotionBlocker>) -> api::Rollout {
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
        of_stable: of.of_stable.to_arm(),
        of_candidate: of.of_candidate.to_arm(),
    }
}

/// Refuses invalid terms.
pub fn check_terms(terms: &RolloutTerms) -> Result<(), Error> {
    let times = [terms.deadline, terms.promote_after];
    let sane = |number: f64| number.is_finite() && number >= 0.0;
    if !sane(terms.bound) || !times.into_iter().flatten().all(sane) || terms.samples == 0 {
        return Err(Error::Rollout(
            "bound, deadline and promote_after must be 0 or greater, and samples at least 1".to_owned(),
        ));
    }
    if terms.promote_after.is_some() && terms.canary.is_none() {
        return Err(Error::Rollout(
            "promote_after needs a canary; set the robots that it serves, such as 10%".to_owned(),
        ));
    }
    Ok(())
}

impl Choreographer {
    /// Starts running rollouts, including those of an earlier daemon.
    pub fn keep_rollouts(&self) -> Result<(), Error> {
        self.inner.read_rollouts()?;
        tokio::spawn(run_rollouts(Arc::clone(&self.inner)));
        Ok(())
    }

    /// Refuses a canary that would break robots of the current revision.
    pub fn check_canary(&self, candidate: &RevisionRecord) -> Result<(), Error> {
        check_compatible(&*self.inner.catalogue.current_revision(&candidate.service)?, candidate)
    }

    /// Returns the last rollout of a service.
    pub fn rollout(&self, service: &str) -> Result<api::Rollout, Error> {
        self.inner.catalogue.current_revision(service)?;
        match self.inner.rollout(service) {
            Some(rollout) => {
                let waits = self.inner.promotion_blocker(service);
                Ok(to_api(service, &rollout, waits))
            }
            None => Err(Error::NoRollout(service.to_owned())),
        }
    }

    /// Starts the rollout of a published revision: as a canary beside the current one, or as the current one, with a
    /// deadline for servants of others. `stable` is the previous current revision, if `candidate` is the current one
    /// already.
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
        let current = inner.catalogue.current_revision(service)?;
        let Some(revision) = inner.state.revision(service, candidate)? else {
            return Err(Error::Rollout(format!("{service} has no revision {candidate}")));
        };
        let is_canary = terms.canary.is_some();
        if is_canary && candidate == current.number {
            return Err(Error::Rollout(format!("revision {candidate} of {service} is already the current one")));
        }
        if is_canary {
            check_compatible(&current, &revision)?;
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
                    api::rollout::Share::Robots(1) => "the first robot".to_owned(),
                    api::rollout::Share::Robots(most) => format!("the first {most} robots"),
                    share => format!("{share} of the robots"),
                };
                rollout.reason = format!("{who} instead of revision {}", current.number);
            }
            None => {
                let catalogue = &inner.catalogue;
                if !catalogue.promote(service, current.number, candidate).await? {
                    return Err(Error::Rollout(format!(
                        "another revision of {service} was published meanwhile; select the revision again"
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

    /// Promotes the canary to the current revision.
    pub async fn promote_rollout(&self, service: &str) -> Result<api::Rollout, Error> {
        let inner = &self.inner;
        let _turn = inner.rollouts.turn.lock().await;
        let canary = self.canary(service)?;
        inner.promote(service, &canary, "requested by a user").await?;
        self.rollout(service)
    }

    /// Rolls the canary back.
    pub async fn abort_rollout(&self, service: &str) -> Result<api::Rollout, Error> {
        let inner = &self.inner;
        let _turn = inner.rollouts.turn.lock().await;
        let (canary, state) = (self.canary(service)?, RolloutState::Aborted);
        inner.take_back(service, canary.candidate, state, "requested by a user")?;
        self.rollout(service)
    }

    /// Ends an ongoing rollout because another revision than the canary has become the current one.
    pub async fn revision_changed(&self, service: &str, to: u64) -> Result<(), Error> {
        let _turn = self.inner.rollouts.turn.lock().await;
        self.inner.replace_rollout(service, to)
    }

    /// Forgets the rollout of a removed service, without an event.
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
        rollout.filter(|rollout| rollout.state == RolloutState::Canary).ok_or_else(|| {
            Error::Rollout(format!(
                "revision {} of {service} is not a canary: {} ({})",
                shown.candidate, shown.state, shown.reason
            ))
        })
    }
}

impl ChoreographerInner {
    /// Ends an ongoing rollout, because revision `to` is, or is to become, the current one.
    fn replace_rollout(&self, service: &str, to: u64) -> Result<(), Error> {
        let Some(rollout) = self.rollout(service).filter(is_ongoing) else {
            return Ok(());
        };
        let candidate = rollout.candidate;
        if candidate == to && rollout.state == RolloutState::Draining {
            return Ok(());
        }
        let reason = format!("revision {to} replaces it");
        let state = RolloutState::Replaced;
        if rollout.state == RolloutState::Canary && candidate != to {
            return self.take_back(service, candidate, state, &reason);
        }
        self.set_rollout_state(service, candidate, state, &reason)?;
        Ok(())
    }
}

/// Checks that robots built for the stable revision find what they use in the candidate, too.
fn check_compatible(stable: &RevisionRecord, candidate: &RevisionRecord) -> Result<(), Error> {
    if stable.plan.shared.is_some() || candidate.plan.shared.is_some() {
        return Err(Error::Rollout(format!(
            "revision {} of {} cannot be a canary: robots share its servants, so all get the same revision",
            candidate.number, candidate.service
        )));
    }
    let difference = Difference::compare(&stable.interface, &candidate.interface);
    if difference.compatible() {
        return Ok(());
    }
    let breaking = difference.changes.iter().filter(|it| !it.compatible);
    let words: Vec<String> = breaking.take(MAX_NAMED_DIFFERENCES).map(ToString::to_string).collect();
    Err(Error::Rollout(format!(
        "revision {} of {} cannot be a canary: its interface breaks robots of revision {}: {}",
        candidate.number,
        candidate.service,
        stable.number,
        words.join("; ")
    )))
}
