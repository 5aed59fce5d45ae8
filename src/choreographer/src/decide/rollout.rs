//! Which robots a new revision serves first, and when it is taken back, promoted, or takes the others' place.
//!
//! A canary is compared with the revision that it is to follow while requests come, so that the comparison ends as soon as it
//! can, and looking often makes no wrong verdict likelier: shares of failures by confidence bounds that hold at all times
//! together (Chernoff's bound with the divergence of Kullback and Leibler, as in A. Garivier and O. Cappé, *The KL-UCB algorithm*,
//! COLT 2011; the level divided over the looks as by D. A. Darling and H. Robbins, *Confidence sequences*, PNAS 58, 1967), response
//! times by the sign test (the share of requests that are slower than the other's median) with the same bounds.

use std::f64::consts::PI;
use std::fmt;

use api::Millis;
use api::rollout::{Arm, RolloutState, RolloutTerms, Share};
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use super::sketch::Sketch;

/// The chance that a canary is taken back that is no worse, over the whole rollout: shared by three comparisons of two bounds.
const LEVEL: f64 = 0.05 / 6.0;
/// Servants of the candidate before their failures count.
const SERVANTS: u64 = 3;

/// How often something was tried and failed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tries {
    /// The number of tries.
    pub all: u64,
    /// Those that failed.
    pub failed: u64,
}

impl Tries {
    /// Counts one try.
    pub fn note(&mut self, failed: bool) {
        self.all += 1;
        self.failed += u64::from(failed);
    }
}

/// What was seen of one revision.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Seen {
    /// Its servants: ready, or failed.
    pub servants: Tries,
    /// Requests to them.
    pub requests: Tries,
    /// Response times of those that were answered, milliseconds.
    pub times: Sketch,
}

impl Seen {
    /// As it is shown.
    pub fn shown(&self) -> Arm {
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

/// A service on its way from one revision to another. It is written into the database as it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rollout {
    /// The revision that was the current one.
    pub stable: u64,
    /// The revision that is to be.
    pub candidate: u64,
    /// How far it has come.
    pub state: RolloutState,
    /// The reason of the state.
    pub reason: String,
    /// When it began.
    pub started: Millis,
    /// When its state changed last.
    pub changed: Millis,
    /// On which terms.
    pub terms: RolloutTerms,
    /// Robots that were given the candidate, where their number is limited.
    #[serde(default)]
    pub robots: Vec<String>,
    /// What was seen of the stable revision.
    #[serde(default)]
    pub of_stable: Seen,
    /// What was seen of the candidate.
    #[serde(default)]
    pub of_candidate: Seen,
}

impl Rollout {
    /// The state after its candidate has become the current revision.
    pub fn after_promotion(&self) -> RolloutState {
        match self.terms.deadline {
            Some(_) => RolloutState::Draining,
            None => RolloutState::Promoted,
        }
    }
}

/// Which revision a robot is given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Given {
    /// The current one.
    Current,
    /// The candidate.
    Candidate,
    /// The candidate, and the robot is one more of those that were given it.
    CandidateFromNow,
}

/// Which revision of `service` a robot is given. The same robot gets the same answer for as long as the rollout goes on.
pub fn given(of: &Rollout, service: &str, robot: &str) -> Given {
    let Some(share) = of.terms.canary.filter(|_| of.state == RolloutState::Canary) else {
        return Given::Current;
    };
    match share {
        Share::Robots(_) if of.robots.iter().any(|known| known == robot) => Given::Candidate,
        Share::Robots(most) if of.robots.len() < most as usize => Given::CandidateFromNow,
        Share::Robots(_) => Given::Current,
        Share::Percent(percent) => {
            let part = hash(&[service, robot], of.candidate) as f64 / u64::MAX as f64;
            match part * 100.0 < percent {
                true => Given::Candidate,
                false => Given::Current,
            }
        }
    }
}

/// The same on every machine and in every version: the first bytes of a SHA-256 sum.
fn hash(words: &[&str], number: u64) -> u64 {
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

/// What becomes of a rollout now.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Step {
    /// Nothing changes.
    Stays,
    /// The time to promote the candidate has come, and this is missing.
    Waits(Wait),
    /// The candidate is taken back, for this reason.
    RollsBack(String),
    /// The candidate becomes the current revision, for this reason.
    Promotes(String),
    /// Servants of other revisions than the candidate end.
    EndsOthers,
}

/// What a canary waits for whose time to be promoted has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wait {
    /// No servant of it serves a robot.
    Servant,
    /// It was asked too seldom to know how it answers.
    Requests {
        /// So often it was asked.
        seen: u64,
        /// So often it must be.
        needed: u64,
    },
    /// It fails more often than the bound allows, and the stable revision was asked too seldom to compare the two.
    Comparison {
        /// So many of the candidate's requests failed.
        failed: Tries,
        /// So often the stable revision was asked.
        seen: u64,
        /// So often it must be.
        needed: u64,
    },
}

impl Wait {
    /// Whether somebody who was told of the other knows this one, too: only numbers have changed.
    pub fn is_like(&self, other: &Wait) -> bool {
        std::mem::discriminant(self) == std::mem::discriminant(other)
    }
}

impl fmt::Display for Wait {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Wait::Servant => write!(out, "no servant of it serves a robot yet"),
            Wait::Requests { seen, needed } => write!(
                out,
                "it was asked {seen} times and {needed} are needed to know that it answers (--samples)"
            ),
            Wait::Comparison {
                failed,
                seen,
                needed,
            } => write!(
                out,
                "{} of its {} requests failed, and the previous revision was asked {seen} times of the {needed} that are needed to compare \
                 them (--samples)",
                failed.failed, failed.all
            ),
        }
    }
}

/// What is missing before a candidate whose time has come is promoted.
fn missing(stable: &Seen, candidate: &Seen, terms: &RolloutTerms) -> Option<Wait> {
    if candidate.servants.all <= candidate.servants.failed {
        return Some(Wait::Servant);
    }
    let (needed, requests) = (u64::from(terms.samples.max(1)), candidate.requests);
    if requests.all < needed {
        return Some(Wait::Requests {
            seen: requests.all,
            needed,
        });
    }
    let seen = stable.requests.all;
    let fails = requests.failed as f64 > terms.bound * requests.all as f64;
    (seen < needed && fails).then_some(Wait::Comparison {
        failed: requests,
        seen,
        needed,
    })
}

/// What becomes of a rollout at `now`.
pub fn step(of: &Rollout, now: Millis) -> Step {
    let since = |seconds: f64| now.saturating_sub(of.changed) as f64 >= seconds * 1000.0;
    match of.state {
        RolloutState::Canary => {
            let (stable, candidate) = (&of.of_stable, &of.of_candidate);
            if let Some(reason) = worse(stable, candidate, &of.terms) {
                return Step::RollsBack(reason);
            }
            let Some(after) = of.terms.promote_after.filter(|after| since(*after)) else {
                return Step::Stays;
            };
            if let Some(wait) = missing(stable, candidate, &of.terms) {
                return Step::Waits(wait);
            }
            let seen = candidate.requests.all;
            Step::Promotes(format!(
                "it was not worse within {after} s and {seen} requests"
            ))
        }
        RolloutState::Draining if of.terms.deadline.is_none_or(since) => Step::EndsOthers,
        _ => Step::Stays,
    }
}

/// In what the candidate is worse than the stable revision by more than the terms allow, if it is.
pub fn worse(stable: &Seen, candidate: &Seen, terms: &RolloutTerms) -> Option<String> {
    let (bound, samples) = (terms.bound, u64::from(terms.samples.max(1)));
    let percent = |tries: Tries| 100.0 * tries.failed as f64 / tries.all.max(1) as f64;
    let says = |what: &str, candidate: Tries, stable: Tries| {
        format!(
            "{:.0} % of its {} {what} failed, of the revision before {:.0} % of {}",
            percent(candidate),
            candidate.all,
            percent(stable),
            stable.all
        )
    };
    // A revision that was pushed has started once: the stable one's servants count as sound where nothing else was seen.
    let starts = percent(stable.servants) / 100.0;
    let (servants, requests) = (candidate.servants, candidate.requests);
    if servants.all >= SERVANTS && lower(servants) > starts + bound {
        return Some(says("servants", servants, stable.servants));
    }
    if requests.all < samples || stable.requests.all < samples {
        return None;
    }
    if lower(requests) > upper(stable.requests) + bound {
        return Some(says("requests", requests, stable.requests));
    }
    let median = stable.times.quantile(0.5)?;
    let slow = Tries {
        all: candidate.times.count(),
        failed: candidate.times.above(median * (1.0 + bound)),
    };
    if slow.all >= samples && lower(slow) > 0.5 {
        return Some(format!(
            "its median response time is {:.0} ms, that of the revision before {median:.0} ms",
            candidate.times.quantile(0.5).unwrap_or_default()
        ));
    }
    None
}

/// Divergence of Kullback and Leibler between two coins.
fn divergence(p: f64, q: f64) -> f64 {
    let part = |p: f64, q: f64| match p {
        0.0 => 0.0,
        _ if q <= 0.0 => f64::INFINITY,
        _ => p * (p / q).ln(),
    };
    part(p, q) + part(1.0 - p, 1.0 - q)
}

/// What the divergence of the true share from the one that was seen may be, so that it is that of no look with a chance above
/// [`LEVEL`].
fn allowed(tries: Tries) -> f64 {
    let n = tries.all as f64;
    ((n * n * PI * PI / 6.0) / LEVEL).ln() / n
}

fn bisect(mut inside: f64, mut outside: f64, seen: f64, allowed: f64) -> f64 {
    for _ in 0..60 {
        let middle = f64::midpoint(inside, outside);
        match divergence(seen, middle) <= allowed {
            true => inside = middle,
            false => outside = middle,
        }
    }
    outside
}

/// The share of failures is no smaller than this.
pub fn lower(tries: Tries) -> f64 {
    if tries.all == 0 {
        return 0.0;
    }
    let seen = tries.failed as f64 / tries.all as f64;
    bisect(seen, 0.0, seen, allowed(tries))
}

/// The share of failures is no greater than this.
pub fn upper(tries: Tries) -> f64 {
    if tries.all == 0 {
        return 1.0;
    }
    let seen = tries.failed as f64 / tries.all as f64;
    bisect(seen, 1.0, seen, allowed(tries))
}

#[cfg(test)]
mod tests;
