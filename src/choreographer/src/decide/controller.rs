//! Moves cores between the running servants of a machine: servants whose response times approach what their robots
//! accept get cores that others do not need. No servant gets less than it was promised.
//!
//! Two kernel settings are adjusted. `cpu.weight` determines who runs first under contention: a thousand for each
//! promised core, and for each one granted beyond. The sum of the extra grants never exceeds the unpromised cores, so
//! that a servant gets what it was promised as soon as it wants it, whatever was granted to others. `cpu.max` limits a
//! servant: it is raised in steps for a servant that is near its limit, lowered for neighbours without a stated time
//! while one is near, and restored afterwards.
//!
//! Background: water filling for max-min fair shares ([`super::shares`]); additive increase and multiplicative decrease
//! (AIMD; Chiu and Jain, 1989) for the steps; two thresholds and a hold time against flapping (a Schmitt trigger with a
//! dwell time).
//!
//! If the cores do not suffice for all servants that are near, some of them yield the unpromised cores to the others
//! ([`yielding`]).
//!
//! Cores do not help against network delay. So a servant is near only if its own share of the time (queueing and
//! computing in the cloud) is not small.

mod yielding;

use std::time::{Duration, Instant};

use super::shares::{Claim, fill_shares};

/// A servant becomes near when its requests take this fraction of the accepted time, …
const NEAR_SHARE: f64 = 0.85;
/// … and stops being near below this fraction.
const FAR: f64 = 0.7;
/// Minimum fraction of the requests' time spent in the cloud for cores to help.
const OURS: f64 = 0.2;
/// If no request is measured: fraction of the time in which the servant was runnable but throttled, or waited for cores
/// used by others.
const HINDERED_SHARE: f64 = 0.1;
/// Time after which the measures for a servant that is no longer near are reverted.
pub const HOLD: Duration = Duration::from_secs(5);
/// Maximum number of doublings of [`HOLD`], one for each time that the servant was near again soon after.
const MAX_HOLD_DOUBLINGS: u32 = 6;
/// "Soon" means within this multiple of the time waited before.
const SOON: u32 = 4;
/// Divisor: a near servant gets this fraction more at each step, at least [`STEP`].
const GROWTH: u64 = 4;
/// Minimum step, in thousandths of a core.
const STEP: u64 = 100;
/// Minimum for any servant, in thousandths of a core, so that it still answers, if slowly.
const MIN_QUOTA: u64 = 50;
/// Divisor of the headroom: usage may rise by a quarter in the next moment.
const HEADROOM: u64 = 4;
/// Divisor: changes smaller than this fraction are skipped, …
const DEADBAND: u64 = 10;
/// … and this one for changes that restore the original setting.
const ALMOST: u64 = 50;

/// Response times that a robot accepts, in milliseconds; both `None` if it stated something else than times of
/// requests.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ResponseGoal {
    /// T_desire.
    pub desire: Option<f64>,
    /// T_max.
    pub max: Option<f64>,
}

impl ResponseGoal {
    /// Returns the time that is not to be exceeded: T_max, or T_desire if only that is stated.
    pub fn upper_bound(self) -> Option<f64> {
        self.max.or(self.desire).filter(|bound| *bound > 0.0)
    }
}

/// 95th percentiles of recent response times, in milliseconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredTimes {
    /// Time from request to answer.
    pub total: f64,
    /// The part of it spent queueing and computing in the cloud.
    pub cloud: f64,
}

/// The controller's state about a servant between two rounds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ControlHistory {
    /// Last time it was near; `None` if it has never been, or that is over.
    near: Option<Instant>,
    /// Last time at which that ended.
    over: Option<Instant>,
    /// Number of times it was near again soon after.
    again: u32,
    /// Last time its `cpu.max` was raised, …
    raised: Option<Instant>,
    /// … and lowered.
    lowered: Option<Instant>,
    /// Time since which it yields the unpromised cores to other near servants; `None` while it does not.
    yielded: Option<Instant>,
    /// Number of retries in vain.
    vain: u32,
}

impl ControlHistory {
    /// Returns the time since which requests reflect its current cores.
    pub fn raised_at(self) -> Option<Instant> {
        self.raised
    }
}

/// Input about a running servant. Cores are in thousandths.
#[derive(Debug, Clone, Copy)]
pub struct ControlFacts<'a> {
    /// Id of the servant.
    pub id: &'a str,
    /// Cores promised on request; 0 if none were requested.
    pub promised: u64,
    /// `cpu.max` without a controller.
    pub limit: u64,
    /// `cpu.weight` without a controller.
    pub plain: u64,
    /// Maximum that it may ever have.
    pub ceiling: u64,
    /// The weight was requested explicitly and stays.
    pub weighed: bool,
    /// Current `cpu.max`.
    pub quota: u64,
    /// Current `cpu.weight`.
    pub weight: u64,
    /// Cores used since the last round, if known.
    pub used: Option<u64>,
    /// Fraction of the time since the last round in which it was runnable but throttled by `cpu.max`.
    pub throttled: f64,
    /// Fraction of the last ten seconds in which a task in it waited for a core.
    pub waited: f64,
    /// Response times that its robot accepts, if stated.
    pub goal: Option<ResponseGoal>,
    /// Response times of its robot's requests, if known.
    pub measured: Option<MeasuredTimes>,
    /// State from the last round.
    pub history: ControlHistory,
}

/// Decision about a servant.
#[derive(Debug, Clone, PartialEq)]
pub struct ControlDecision {
    /// New `cpu.max`, if it changes.
    pub quota: Option<u64>,
    /// New `cpu.weight`, if it changes.
    pub weight: Option<u64>,
    /// Reason for the change, if any.
    pub reason: String,
    /// State for the next round.
    pub history: ControlHistory,
}

/// Role of a servant in the distribution of cores.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    /// It is near the accepted time, or was until just now: it gets cores that others do not need.
    Near,
    /// The servant's robot has stated a goal, and it is met.
    Content,
    /// It has no goal, or yields to near servants: it gets the remaining cores.
    Rest,
}

impl ControlFacts<'_> {
    /// Returns true if it is near now; the threshold for leaving this state is lower.
    fn is_near(&self) -> bool {
        let Some(goal) = self.goal else {
            return false;
        };
        let was = self.history.near.is_some();
        match self.measured.zip(goal.upper_bound()) {
            Some((MeasuredTimes { total, cloud }, bound)) => {
                let threshold = if was { FAR } else { NEAR_SHARE };
                total >= bound * threshold && cloud >= total * OURS
            }
            None => {
                let threshold = if was { HINDERED_SHARE / 2.0 } else { HINDERED_SHARE };
                self.throttled >= threshold || self.waited >= threshold
            }
        }
    }

    /// Returns the estimated need for cores, based on usage; its whole quota if the usage is unknown.
    fn estimated_need(&self) -> u64 {
        match self.used {
            Some(used) => used + used / HEADROOM + MIN_QUOTA,
            None => self.quota,
        }
    }

    /// Returns true if it would use more cores.
    fn is_held_up(&self) -> bool {
        self.throttled >= HINDERED_SHARE
            || self.waited >= HINDERED_SHARE
            || (self.used.is_some() && self.estimated_need() >= self.quota)
    }

    /// Returns true if it would not be near with the reduced quota: it uses no more, or its requests would still be in
    /// time with proportionally longer computation.
    fn can_spare(&self, less: u64) -> bool {
        match (self.measured, self.goal.and_then(ResponseGoal::upper_bound)) {
            _ if self.estimated_need() <= less => true,
            (Some(MeasuredTimes { total, cloud }), Some(bound)) => {
                let longer = cloud * self.quota as f64 / less.max(1) as f64;
                total - cloud + longer < bound * NEAR_SHARE
            }
            (_, bound) => bound.is_none(),
        }
    }

    fn floor(&self) -> u64 {
        self.promised.max(MIN_QUOTA)
    }
}

/// Returns the decisions for all servants on a machine with so many `cores` (thousandths), in their order.
pub fn control(cores: u64, servants: &[ControlFacts<'_>], now: Instant) -> Vec<ControlDecision> {
    let mut histories: Vec<ControlHistory> = servants.iter().map(|one| update_history(one, now)).collect();
    yielding::update_yields(cores, servants, &mut histories, now);
    let roles: Vec<Role> = servants
        .iter()
        .zip(&histories)
        .map(|(one, history)| match (history.near, one.goal) {
            (Some(_), _) if history.yielded.is_some() => Role::Rest,
            (Some(_), _) => Role::Near,
            (None, Some(_)) => Role::Content,
            (None, None) => Role::Rest,
        })
        .collect();
    let near = servants.iter().zip(&roles).find(|(_, role)| **role == Role::Near);
    let near = near.map(|(one, _)| one.id);
    let quotas = cpu_quotas(cores, servants, &roles, near.is_some(), now);
    let weights = cpu_weights(cores, servants, &roles, &quotas);
    let all = servants.iter().zip(&roles).zip(histories);
    all.zip(quotas.iter().zip(weights))
        .map(|(((one, role), history), (quota, weight))| to_decision(one, *role, history, (*quota, weight), near, now))
        .collect()
}

/// Updates the state of a servant with this round.
fn update_history(one: &ControlFacts<'_>, now: Instant) -> ControlHistory {
    let mut history = one.history;
    let hold = HOLD * 2u32.pow(history.again);
    if one.is_near() {
        if history.near.is_none() {
            let soon = elapsed_since(history.over, now) < hold * SOON;
            history.again = if soon { MAX_HOLD_DOUBLINGS.min(history.again + 1) } else { 0 };
        }
        history.near = Some(now);
    } else if history.near.is_some() && elapsed_since(history.near, now) >= hold {
        history.near = None;
        history.over = Some(now);
    }
    history
}

fn elapsed_since(since: Option<Instant>, now: Instant) -> Duration {
    since.map_or(Duration::MAX, |since| now.saturating_duration_since(since))
}

/// Returns `cpu.max` for each servant.
fn cpu_quotas(cores: u64, servants: &[ControlFacts<'_>], roles: &[Role], any_near: bool, now: Instant) -> Vec<u64> {
    let all = || servants.iter().zip(roles);
    if !any_near {
        return all().map(|(one, _)| restored_quota(one, now)).collect();
    }
    // Satisfied servants come first, then those that are near, then all others.
    let content = all().filter(|(_, role)| **role == Role::Content);
    let needed = content.fold(0u64, |sum, (one, _)| sum.saturating_add(one.estimated_need().min(one.quota)));
    let beyond = cores.saturating_sub(needed);
    let near = |one: &ControlFacts<'_>| {
        if one.is_near() && one.is_held_up() {
            raised_quota(one)
        } else {
            one.estimated_need().min(one.quota).max(one.promised)
        }
    };
    let for_near = fill_role(beyond, all(), Role::Near, near);
    let given = all().zip(&for_near).filter(|((_, role), _)| **role == Role::Near);
    let given = given.fold(0u64, |sum, (_, share)| sum.saturating_add(*share));
    let left = cores.saturating_sub(needed).saturating_sub(given);
    let for_rest = fill_role(left, all(), Role::Rest, |one| one.estimated_need().min(one.limit));
    all()
        .zip(for_near.into_iter().zip(for_rest))
        .map(|((one, role), (_, rest))| match role {
            // A near servant keeps its quota: others that need more get it by weight. The same holds between near
            // servants: each is limited by what the others do not need, and none by its share of that, since a
            // throttled servant waits for the rest of a period although cores are idle.
            Role::Near => near(one).min(beyond).max(one.quota.min(one.ceiling)).max(one.promised),
            Role::Content => restored_quota(one, now),
            Role::Rest if one.used.is_none() => one.quota.max(one.promised),
            // At most halved in one step.
            Role::Rest => rest.max(one.quota / 2).min(one.quota).max(one.floor().min(one.limit)).max(one.promised),
        })
        .collect()
}

/// Returns the quota a near servant would like: one step more, up to its ceiling.
fn raised_quota(one: &ControlFacts<'_>) -> u64 {
    let more = one.quota.saturating_add(STEP.max(one.quota / GROWTH));
    more.min(one.ceiling).max(one.promised)
}

/// Distributes `capacity` by water filling among the servants with this role; others get nothing here.
fn fill_role<'a, 'b: 'a>(
    capacity: u64,
    all: impl Iterator<Item = (&'a ControlFacts<'b>, &'a Role)>,
    role: Role,
    wants: impl Fn(&ControlFacts<'_>) -> u64,
) -> Vec<u64> {
    let claims: Vec<Claim> =
        all.map(|(one, its)| {
            if *its == role { Claim { floor: one.floor(), wants: wants(one) } } else { Claim { floor: 0, wants: 0 } }
        })
        .collect();
    fill_shares(capacity, &claims)
}

/// Returns the next quota on the way back to the setting without a controller: an extra grant is halved as long as
/// requests stay in time; a reduction is reverted by doubling. Neither starts before [`HOLD`] has passed since the
/// opposite change.
fn restored_quota(one: &ControlFacts<'_>, now: Instant) -> u64 {
    let to = one.limit.max(one.promised);
    if one.quota > to && elapsed_since(one.history.raised, now) >= HOLD {
        let beyond = (one.quota - to) / 2;
        let less = to + if beyond > STEP { beyond } else { 0 };
        return if one.can_spare(less) { less } else { one.quota };
    }
    if one.quota < to && elapsed_since(one.history.lowered, now) >= HOLD {
        return one.quota.saturating_add(STEP.max(one.quota)).min(to);
    }
    one.quota.max(one.promised)
}

/// Returns `cpu.weight` for each servant: a thousand per promised core, and per core granted beyond.
fn cpu_weights(cores: u64, servants: &[ControlFacts<'_>], roles: &[Role], quotas: &[u64]) -> Vec<u64> {
    let promised = servants.iter().fold(0u64, |sum, one| sum.saturating_add(one.promised));
    // If no cores are promised, none need protection.
    let open = promised == 0 && !roles.contains(&Role::Near);
    let free = if open { u64::MAX } else { cores.saturating_sub(promised) };
    let all = || servants.iter().zip(roles).zip(quotas);
    let of = |first: bool| -> Vec<Claim> {
        all()
            .map(|((one, role), quota)| {
                // It keeps an earlier extra grant until that is reverted.
                let raised = *role == Role::Near || *quota > one.limit.max(one.promised);
                let wants = match (raised, first) {
                    (true, true) => one.plain.max(*quota).saturating_sub(one.promised),
                    (false, false) => one.plain.saturating_sub(one.promised),
                    _ => 0,
                };
                Claim { floor: 0, wants }
            })
            .collect()
    };
    let near = fill_shares(free, &of(true));
    let rest = fill_shares(free.saturating_sub(near.iter().sum()), &of(false));
    servants
        .iter()
        .zip(near.into_iter().zip(rest))
        .map(|(one, (near, rest))| if one.weighed { one.weight } else { (one.promised + near + rest).clamp(1, 10_000) })
        .collect()
}

/// Turns the new settings into a decision: which of them are changes, and why.
fn to_decision(
    one: &ControlFacts<'_>,
    role: Role,
    mut history: ControlHistory,
    (quota, weight): (u64, u64),
    near: Option<&str>,
    now: Instant,
) -> ControlDecision {
    let quota = Some(quota).filter(|quota| is_worthwhile(one.quota, *quota, one.limit.max(one.promised)));
    let weight = Some(weight).filter(|weight| is_worthwhile(one.weight, *weight, one.plain));
    match quota {
        Some(quota) if quota > one.quota => history.raised = Some(now),
        Some(_) => history.lowered = Some(now),
        None => {}
    }
    let changes = quota.is_some() || weight.is_some();
    let reason = if changes { change_reason(one, role, near, weight) } else { String::new() };
    ControlDecision { quota, weight, reason, history }
}

/// Returns true if a change is worthwhile: it is not small, or restores the setting without a controller.
fn is_worthwhile(is: u64, to_be: u64, without: u64) -> bool {
    let part = if to_be == without { ALMOST } else { DEADBAND };
    is != to_be && is.abs_diff(to_be).saturating_mul(part) >= is
}

fn change_reason(one: &ControlFacts<'_>, role: Role, near: Option<&str>, weight: Option<u64>) -> String {
    match (role, near) {
        (Role::Near, _) => match (one.measured, one.goal.and_then(ResponseGoal::upper_bound)) {
            (Some(measured), Some(bound)) => {
                format!("its requests take {:.0} ms; its robot accepts {bound:.0} ms", measured.total)
            }
            _ => format!(
                "its robot has set a goal, and it was throttled {:.0} % of the time",
                one.throttled.max(one.waited) * 100.0
            ),
        },
        (_, None) if weight.is_some_and(|weight| weight < one.plain) => {
            "the cores are reserved for other servants".to_owned()
        }
        (Role::Content, None) => "its requests are answered in time without more".to_owned(),
        (Role::Content | Role::Rest, Some(near)) => {
            format!("servant {near} needs cores that are not reserved for this one")
        }
        (Role::Rest, None) => "no other servant needs the cores now".to_owned(),
    }
}

#[cfg(test)]
mod tests;
