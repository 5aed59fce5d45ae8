//! Decides which robots a new revision serves first, and when it is rolled back, promoted, or replaces the others.
//!
//! A canary is compared with the stable revision while requests arrive, so that the comparison ends as early as
//! possible, and evaluating it often does not make a wrong verdict likelier: failure rates by confidence bounds that
//! hold at all times together (Chernoff's bound with the divergence of Kullback and Leibler, as in A. Garivier and O.
//! Cappé, *The KL-UCB algorithm*, COLT 2011; the level divided over the evaluations as by D. A. Darling and H. Robbins,
//! *Confidence sequences*, PNAS 58, 1967), response times by the sign test (the fraction of requests that are slower
//! than the other's median) with the same bounds.

use std::f64::consts::PI;
use std::fmt;

use api::Millis;
use api::rollout::{Arm, RolloutState, RolloutTerms, Share};
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use super::sketch::Sketch;

/// Probability that an equally good canary is rolled back, over the whole rollout: divided among three comparisons of
/// two bounds.
const LEVEL: f64 = 0.05 / 6.0;
/// Minimum number of servants of the candidate before their failures count.
const SERVANTS: u64 = 3;

/// Number of attempts and failures.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AttemptCounts {
    /// Number of attempts.
    pub all: u64,
    /// Number of failed attempts.
    pub failed: u64,
}

impl AttemptCounts {
    /// Counts one attempt.
    pub fn record(&mut self, failed: bool) {
        self.all += 1;
        self.failed += u64::from(failed);
    }
}

/// Statistics of one revision.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct RevisionStats {
    /// Servants that became ready, or failed.
    pub servants: AttemptCounts,
    /// Requests to its servants.
    pub requests: AttemptCounts,
    /// Response times of the answered requests, in milliseconds.
    pub times: Sketch,
}

impl RevisionStats {
    /// Returns the statistics as shown by the API.
    pub fn to_arm(&self) -> Arm {
        Arm {
            servants: self.servants.all,
            servants_failed: self.servants.failed,
            requests: self.requests.all,
            requests_failed: self.requests.failed,
            p50: self.times.quantile(0.5),
            p95: self.times.quantile(0.95),
        }
    }
}

/// A rollout of a service from one revision to another. It is stored in the database in this form.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rollout {
    /// The revision that was the current one.
    pub stable: u64,
    /// The revision that is to become the current one.
    pub candidate: u64,
    /// State of the rollout.
    pub state: RolloutState,
    /// Reason of the state.
    pub reason: String,
    /// Time of its start.
    pub started: Millis,
    /// Time of its last state change.
    pub changed: Millis,
    /// Terms of the rollout.
    pub terms: RolloutTerms,
    /// Robots that were given the candidate, if their number is limited.
    #[serde(default)]
    pub robots: Vec<String>,
    /// Statistics of the stable revision.
    #[serde(default)]
    pub of_stable: RevisionStats,
    /// Statistics of the candidate.
    #[serde(default)]
    pub of_candidate: RevisionStats,
}

impl Rollout {
    /// Returns the state after the candidate has become the current revision.
    pub fn after_promotion(&self) -> RolloutState {
        match self.terms.deadline {
            Some(_) => RolloutState::Draining,
            None => RolloutState::Promoted,
        }
    }
}

/// The revision that a robot gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AssignedRevision {
    /// The current revision.
    Current,
    /// The candidate.
    Candidate,
    /// The candidate, and the robot is to be added to those that were given it.
    CandidateFromNow,
}

/// Decides which revision of `service` a robot gets. The same robot gets the same answer as long as the rollout lasts.
pub fn assign_revision(of: &Rollout, service: &str, robot: &str) -> AssignedRevision {
    let Some(share) = of.terms.canary.filter(|_| of.state == RolloutState::Canary) else {
        return AssignedRevision::Current;
    };
    match share {
        Share::Robots(_) if of.robots.iter().any(|known| known == robot) => AssignedRevision::Candidate,
        Share::Robots(most) if of.robots.len() < most as usize => AssignedRevision::CandidateFromNow,
        Share::Robots(_) => AssignedRevision::Current,
        Share::Percent(percent) => {
            let part = stable_hash(&[service, robot], of.candidate) as f64 / u64::MAX as f64;
            if part * 100.0 < percent { AssignedRevision::Candidate } else { AssignedRevision::Current }
        }
    }
}

/// Returns a hash that is stable across machines and versions: the first bytes of a SHA-256 digest.
fn stable_hash(words: &[&str], number: u64) -> u64 {
    let mut sum = Sha256::new();
    for word in words {
        sum.update((word.len() as u64).to_le_bytes());
        sum.update(word);
    }
    sum.update(number.to_le_bytes());
    let mut first = [0; 8];
    first.copy_from_slice(&sum.finalize()[..8]);
    u64::from_le_bytes(first)
}

/// Next step of a rollout.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RolloutStep {
    /// Nothing changes.
    Stays,
    /// The time to promote the candidate has come, but this is missing.
    Waits(PromotionBlocker),
    /// The candidate is rolled back, for this reason.
    RollsBack(String),
    /// The candidate becomes the current revision, for this reason.
    Promotes(String),
    /// Servants of other revisions than the candidate are ended.
    EndsOthers,
}

/// Reason why the promotion of a canary whose time has come is delayed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PromotionBlocker {
    /// None of its servants serves a robot.
    Servant,
    /// It received too few requests to judge its answers.
    Requests {
        /// Number of requests it received.
        seen: u64,
        /// Number of requests required.
        needed: u64,
    },
    /// It fails more often than the bound allows, and the stable revision received too few requests to compare the two.
    Comparison {
        /// Requests and failures of the candidate.
        failed: AttemptCounts,
        /// Number of requests that the stable revision received.
        seen: u64,
        /// Number of requests required.
        needed: u64,
    },
}

impl PromotionBlocker {
    /// Returns true if both differ only in their numbers, so that the second is not news.
    pub fn is_same_kind(&self, other: &PromotionBlocker) -> bool {
        std::mem::discriminant(self) == std::mem::discriminant(other)
    }
}

impl fmt::Display for PromotionBlocker {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            PromotionBlocker::Servant => write!(out, "none of its servants serves a robot yet"),
            PromotionBlocker::Requests { seen, needed } => {
                write!(out, "it has had {seen} requests of the {needed} required (--samples)")
            }
            PromotionBlocker::Comparison { failed, seen, needed } => write!(
                out,
                "{} of its {} requests failed, but the previous revision has had {seen} requests of the {needed} \
                    required for a comparison (--samples)",
                failed.failed, failed.all
            ),
        }
    }
}

/// Returns what is missing before a candidate whose time has come is promoted.
fn promotion_blocker(
    stable: &RevisionStats,
    candidate: &RevisionStats,
    terms: &RolloutTerms,
) -> Option<PromotionBlocker> {
    if candidate.servants.all <= candidate.servants.failed {
        return Some(PromotionBlocker::Servant);
    }
    let (needed, requests) = (u64::from(terms.samples.max(1)), candidate.requests);
    if requests.all < needed {
        return Some(PromotionBlocker::Requests { seen: requests.all, needed });
    }
    let seen = stable.requests.all;
    let fails = requests.failed as f64 > terms.bound * requests.all as f64;
    (seen < needed && fails).then_some(PromotionBlocker::Comparison { failed: requests, seen, needed })
}

/// Decides the next step of a rollout at `now`.
pub fn next_step(of: &Rollout, now: Millis) -> RolloutStep {
    let since = |seconds: f64| now.saturating_sub(of.changed) as f64 >= seconds * 1000.0;
    match of.state {
        RolloutState::Canary => {
            let (stable, candidate) = (&of.of_stable, &of.of_candidate);
            if let Some(reason) = regression(stable, candidate, &of.terms) {
                return RolloutStep::RollsBack(reason);
            }
            let Some(after) = of.terms.promote_after.filter(|after| since(*after)) else {
                return RolloutStep::Stays;
            };
            if let Some(wait) = promotion_blocker(stable, candidate, &of.terms) {
                return RolloutStep::Waits(wait);
            }
            let seen = candidate.requests.all;
            RolloutStep::Promotes(format!("it was not worse within {after} s and {seen} requests"))
        }
        RolloutState::Draining if of.terms.deadline.is_none_or(since) => RolloutStep::EndsOthers,
        _ => RolloutStep::Stays,
    }
}

/// Returns in what respect the candidate is worse than the stable revision by more than the terms allow, if it is.
pub fn regression(stable: &RevisionStats, candidate: &RevisionStats, terms: &RolloutTerms) -> Option<String> {
    let (bound, samples) = (terms.bound, u64::from(terms.samples.max(1)));
    let percent = |tries: AttemptCounts| 100.0 * tries.failed as f64 / tries.all.max(1) as f64;
    let says = |what: &str, candidate: AttemptCounts, stable: AttemptCounts| {
        format!(
            "{:.0} % of its {} {what} failed; previous revision: {:.0} % of {}",
            percent(candidate),
            candidate.all,
            percent(stable),
            stable.all
        )
    };
    // A pushed revision has started once: the stable one's servants count as sound if nothing else was seen.
    let starts = percent(stable.servants) / 100.0;
    let (servants, requests) = (candidate.servants, candidate.requests);
    if servants.all >= SERVANTS && lower_bound(servants) > starts + bound {
        return Some(says("servants", servants, stable.servants));
    }
    if requests.all < samples || stable.requests.all < samples {
        return None;
    }
    if lower_bound(requests) > upper_bound(stable.requests) + bound {
        return Some(says("requests", requests, stable.requests));
    }
    let median = stable.times.quantile(0.5)?;
    let slow =
        AttemptCounts { all: candidate.times.count(), failed: candidate.times.count_above(median * (1.0 + bound)) };
    if slow.all >= samples && lower_bound(slow) > 0.5 {
        return Some(format!(
            "its p50 response time is {:.0} ms; previous revision: {median:.0} ms",
            candidate.times.quantile(0.5).unwrap_or_default()
        ));
    }
    None
}

/// Returns the Kullback–Leibler divergence between two Bernoulli distributions.
fn kl_divergence(p: f64, q: f64) -> f64 {
    let part = |p: f64, q: f64| match p {
        0.0 => 0.0,
        _ if q <= 0.0 => f64::INFINITY,
        _ => p * (p / q).ln(),
    };
    part(p, q) + part(1.0 - p, 1.0 - q)
}

/// Returns the maximum divergence of the true rate from the observed one, such that over all evaluations together the
/// probability of exceeding it is at most [`LEVEL`].
fn max_divergence(tries: AttemptCounts) -> f64 {
    let n = tries.all as f64;
    ((n * n * PI * PI / 6.0) / LEVEL).ln() / n
}

fn bisect(mut inside: f64, mut outside: f64, seen: f64, allowed: f64) -> f64 {
    for _ in 0..60 {
        let middle = f64::midpoint(inside, outside);
        if kl_divergence(seen, middle) <= allowed { inside = middle } else { outside = middle }
    }
    outside
}

/// Returns a lower confidence bound of the failure rate.
pub fn lower_bound(tries: AttemptCounts) -> f64 {
    if tries.all == 0 {
        return 0.0;
    }
    let seen = tries.failed as f64 / tries.all as f64;
    bisect(seen, 0.0, seen, max_divergence(tries))
}

/// Returns an upper confidence bound of the failure rate.
pub fn upper_bound(tries: AttemptCounts) -> f64 {
    if tries.all == 0 {
        return 1.0;
    }
    let seen = tries.failed as f64 / tries.all as f64;
    bisect(seen, 1.0, seen, max_divergence(tries))
}

#[cfg(test)]
mod tests;
