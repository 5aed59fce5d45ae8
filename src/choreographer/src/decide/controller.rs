//! Moves cores between the servants of a machine while they work: those near the time that their robots accept at most get
//! what others do not need. Nobody gets less than it was promised.
//!
//! Two settings of the kernel are moved. `cpu.weight` says who runs first where all want to: a thousand for each core that is
//! promised, and for each one that is given beyond. What is given beyond is never more than what nobody is promised, so that
//! a promise holds in the same moment in which its servant wants it, whatever was given to others. `cpu.max` bounds what a
//! servant takes: it is raised in steps for a servant that is near, lowered for neighbours without a stated time while one
//! is, and taken back when it is over.
//!
//! Sources of the ideas: water filling for max-min fair shares ([`super::shares`]); additive increase and multiplicative
//! decrease (AIMD; Chiu and Jain, 1989) for the steps; two thresholds and a time to hold against flapping (a Schmitt
//! trigger with a dwell time).
//!
//! Where the cores do not suffice for all that are near, some of them leave what nobody was promised to the others
//! ([`yielding`]).
//!
//! What a robot waits for on the network is not helped by cores. So a servant is near only where its own share of the time
//! (waiting and computing in the cloud) is not small.

mod yielding;

use std::time::{Duration, Instant};

use super::shares::{Claim, fill};

/// Near: requests take this part of the time that is accepted at most, …
const NEAR: f64 = 0.85;
/// … and no longer, when they take this part.
const FAR: f64 = 0.7;
/// A servant whose requests spend less than this part of their time in the cloud is not helped by cores.
const OURS: f64 = 0.2;
/// Where no request is measured: part of the time in which it wanted to run and had used up its cores, or others had
/// them.
const HINDERED: f64 = 0.1;
/// What was done for a servant that was near is taken back when it has not been for so long, and what was taken from others
/// is given back.
pub const HOLD: Duration = Duration::from_secs(5);
/// Twice as long for each time that it was near again soon after, up to so often.
const DOUBLED: u32 = 6;
/// Soon: within so many times what was waited before.
const SOON: u32 = 4;
/// A servant that is near gets this part more at each look, at least [`STEP`].
const GROWTH: u64 = 4;
/// Thousandths of a core.
const STEP: u64 = 100;
/// Nobody is left with less than this: it is to answer, if slowly. Thousandths of a core.
const LEAST: u64 = 50;
/// What is used now may be a quarter more in the next moment.
const HEADROOM: u64 = 4;
/// Changes by less than this part are left, …
const DEADBAND: u64 = 10;
/// … and by less than this part those that lead back to what is had without a controller.
const ALMOST: u64 = 50;

/// What a robot accepts, milliseconds; neither, where it stated something else than times of requests.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Goal {
    /// T_desire.
    pub desire: Option<f64>,
    /// T_max.
    pub max: Option<f64>,
}

impl Goal {
    /// What is not to be exceeded: T_max, or T_desire where that alone is stated.
    pub fn bound(self) -> Option<f64> {
        self.max.or(self.desire).filter(|bound| *bound > 0.0)
    }
}

/// What requests took lately, milliseconds (the time that 19 of 20 did not exceed).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// From asked to answered.
    pub total: f64,
    /// Of that, waiting and computing in the cloud.
    pub cloud: f64,
}

/// What the controller remembers of a servant from one look to the next.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct History {
    /// When it was near last; none while it has never been, or that is over.
    near: Option<Instant>,
    /// When that was over last.
    over: Option<Instant>,
    /// So often it was near again soon after.
    again: u32,
    /// When its `cpu.max` was raised last, …
    raised: Option<Instant>,
    /// … and lowered.
    lowered: Option<Instant>,
    /// Since when it leaves what nobody was promised to others that are near; none while it does not.
    yielded: Option<Instant>,
    /// So often it tried again in vain.
    vain: u32,
}

impl History {
    /// Since when requests tell what its cores do for it.
    pub fn raised(self) -> Option<Instant> {
        self.raised
    }
}

/// A servant that works. Cores are in thousandths.
#[derive(Debug, Clone, Copy)]
pub struct Facts<'a> {
    /// Its id.
    pub id: &'a str,
    /// Cores promised because somebody asked for them; 0 where nobody did.
    pub promised: u64,
    /// `cpu.max` without a controller.
    pub limit: u64,
    /// `cpu.weight` without a controller.
    pub plain: u64,
    /// The most that it may ever have.
    pub ceiling: u64,
    /// Somebody asked for this weight, which stays.
    pub weighed: bool,
    /// `cpu.max` as it is.
    pub quota: u64,
    /// `cpu.weight` as it is.
    pub weight: u64,
    /// Cores used since the last look, where that is known.
    pub used: Option<u64>,
    /// Part of the time since the last look in which it wanted to run and had used up its `cpu.max`.
    pub throttled: f64,
    /// Part of the last ten seconds in which something in it waited for a core.
    pub waited: f64,
    /// What its robot accepts, where that is stated.
    pub goal: Option<Goal>,
    /// What its robot's requests took, where that is known.
    pub measured: Option<Measured>,
    /// What was remembered of it.
    pub history: History,
}

/// What becomes of a servant.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Its new `cpu.max`, if that changes.
    pub quota: Option<u64>,
    /// Its new `cpu.weight`, if that changes.
    pub weight: Option<u64>,
    /// Why, where something changes.
    pub reason: String,
    /// To be remembered.
    pub history: History,
}

/// What a servant is in the eyes of the others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    /// It is near what its robot accepts at most, or was until just now: gets what others do not need.
    Near,
    /// Its robot said what it accepts, and gets it.
    Content,
    /// Nobody said anything, or it yields to others that are near: gets what is left.
    Rest,
}

impl Facts<'_> {
    /// Whether it is near now. Once it is, it takes a greater distance not to be.
    fn is_near(&self) -> bool {
        let Some(goal) = self.goal else {
            return false;
        };
        let was = self.history.near.is_some();
        match self.measured.zip(goal.bound()) {
            Some((Measured { total, cloud }, bound)) => {
                let threshold = if was { FAR } else { NEAR };
                total >= bound * threshold && cloud >= total * OURS
            }
            None => {
                let threshold = if was { HINDERED / 2.0 } else { HINDERED };
                self.throttled >= threshold || self.waited >= threshold
            }
        }
    }

    /// What it needs, as far as can be seen from what it uses; all that it has, where that is not known.
    fn needs(&self) -> u64 {
        match self.used {
            Some(used) => used + used / HEADROOM + LEAST,
            None => self.quota,
        }
    }

    /// More cores would be used.
    fn is_held_up(&self) -> bool {
        self.throttled >= HINDERED
            || self.waited >= HINDERED
            || (self.used.is_some() && self.needs() >= self.quota)
    }

    /// It would not be near with so little: it uses no more, or its requests, computed so much longer, are still in time.
    fn spares(&self, less: u64) -> bool {
        match (self.measured, self.goal.and_then(Goal::bound)) {
            _ if self.needs() <= less => true,
            (Some(Measured { total, cloud }), Some(bound)) => {
                let longer = cloud * self.quota as f64 / less.max(1) as f64;
                total - cloud + longer < bound * NEAR
            }
            (_, bound) => bound.is_none(),
        }
    }

    fn floor(&self) -> u64 {
        self.promised.max(LEAST)
    }
}

/// Shares of all servants on a machine with so many `cores` (thousandths), in their order.
pub fn control(cores: u64, servants: &[Facts<'_>], now: Instant) -> Vec<Outcome> {
    let mut histories: Vec<History> = servants.iter().map(|one| remembered(one, now)).collect();
    yielding::decide(cores, servants, &mut histories, now);
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
    let near = servants
        .iter()
        .zip(&roles)
        .find(|(_, role)| **role == Role::Near);
    let near = near.map(|(one, _)| one.id);
    let quotas = quotas(cores, servants, &roles, near.is_some(), now);
    let weights = weights(cores, servants, &roles, &quotas);
    let all = servants.iter().zip(&roles).zip(histories);
    all.zip(quotas.iter().zip(weights))
        .map(|(((one, role), history), (quota, weight))| {
            outcome(one, *role, history, (*quota, weight), near, now)
        })
        .collect()
}

/// What is known of it with this look: it is near, was until just now, or is not.
fn remembered(one: &Facts<'_>, now: Instant) -> History {
    let mut history = one.history;
    let hold = HOLD * 2u32.pow(history.again);
    if one.is_near() {
        if history.near.is_none() {
            let soon = elapsed(history.over, now) < hold * SOON;
            history.again = if soon {
                DOUBLED.min(history.again + 1)
            } else {
                0
            };
        }
        history.near = Some(now);
    } else if history.near.is_some() && elapsed(history.near, now) >= hold {
        history.near = None;
        history.over = Some(now);
    }
    history
}

fn elapsed(since: Option<Instant>, now: Instant) -> Duration {
    since.map_or(Duration::MAX, |since| now.saturating_duration_since(since))
}

/// `cpu.max` for each.
fn quotas(
    cores: u64,
    servants: &[Facts<'_>],
    roles: &[Role],
    any_near: bool,
    now: Instant,
) -> Vec<u64> {
    let all = || servants.iter().zip(roles);
    if !any_near {
        return all().map(|(one, _)| back(one, now)).collect();
    }
    // What those need whose robots have what they want comes first, then those that are near, then all others.
    let content = all().filter(|(_, role)| **role == Role::Content);
    let needed = content.fold(0u64, |sum, (one, _)| {
        sum.saturating_add(one.needs().min(one.quota))
    });
    let beyond = cores.saturating_sub(needed);
    let near = |one: &Facts<'_>| match one.is_near() && one.is_held_up() {
        true => wish(one),
        false => one.needs().min(one.quota).max(one.promised),
    };
    let for_near = share(beyond, all(), Role::Near, near);
    let given = all()
        .zip(&for_near)
        .filter(|((_, role), _)| **role == Role::Near);
    let given = given.fold(0u64, |sum, (_, share)| sum.saturating_add(*share));
    let left = cores.saturating_sub(needed).saturating_sub(given);
    let for_rest = share(left, all(), Role::Rest, |one| one.needs().min(one.limit));
    all()
        .zip(for_near.into_iter().zip(for_rest))
        .map(|((one, role), (_, rest))| match role {
            // What it has it keeps while it is near: what others need more is theirs by weight. So it is between those that
            // are near: each is bounded by what the others do not need, and none by its share of that, since one that is
            // throttled waits for the rest of a period although cores are idle.
            Role::Near => near(one)
                .min(beyond)
                .max(one.quota.min(one.ceiling))
                .max(one.promised),
            Role::Content => back(one, now),
            Role::Rest if one.used.is_none() => one.quota.max(one.promised),
            // At most halved at once.
            Role::Rest => rest
                .max(one.quota / 2)
                .min(one.quota)
                .max(one.floor().min(one.limit))
                .max(one.promised),
        })
        .collect()
}

/// What a servant that is near would like: a step more than it has, up to what it may have.
fn wish(one: &Facts<'_>) -> u64 {
    let more = one.quota.saturating_add(STEP.max(one.quota / GROWTH));
    more.min(one.ceiling).max(one.promised)
}

/// Water filling among those with this role; others get nothing here.
fn share<'a, 'b: 'a>(
    capacity: u64,
    all: impl Iterator<Item = (&'a Facts<'b>, &'a Role)>,
    role: Role,
    wants: impl Fn(&Facts<'_>) -> u64,
) -> Vec<u64> {
    let claims: Vec<Claim> = all
        .map(|(one, its)| match *its == role {
            true => Claim {
                floor: one.floor(),
                wants: wants(one),
            },
            false => Claim { floor: 0, wants: 0 },
        })
        .collect();
    fill(capacity, &claims)
}

/// On the way back to what it has without a controller: what it was given beyond is halved, as far as its requests are
/// answered in time without; what it was taken is given back by doubling. Neither before [`HOLD`] has passed since the opposite.
fn back(one: &Facts<'_>, now: Instant) -> u64 {
    let to = one.limit.max(one.promised);
    if one.quota > to && elapsed(one.history.raised, now) >= HOLD {
        let beyond = (one.quota - to) / 2;
        let less = to + if beyond > STEP { beyond } else { 0 };
        return if one.spares(less) { less } else { one.quota };
    }
    if one.quota < to && elapsed(one.history.lowered, now) >= HOLD {
        return one.quota.saturating_add(STEP.max(one.quota)).min(to);
    }
    one.quota.max(one.promised)
}

/// `cpu.weight` for each: a thousand for each core that it is promised or given beyond.
fn weights(cores: u64, servants: &[Facts<'_>], roles: &[Role], quotas: &[u64]) -> Vec<u64> {
    let promised = servants
        .iter()
        .fold(0u64, |sum, one| sum.saturating_add(one.promised));
    // Where nobody is promised any, none is to be protected.
    let open = promised == 0 && !roles.contains(&Role::Near);
    let free = if open {
        u64::MAX
    } else {
        cores.saturating_sub(promised)
    };
    let all = || servants.iter().zip(roles).zip(quotas);
    let of = |first: bool| -> Vec<Claim> {
        all()
            .map(|((one, role), quota)| {
                // What it was given before it keeps until that is taken back.
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
    let near = fill(free, &of(true));
    let rest = fill(free.saturating_sub(near.iter().sum()), &of(false));
    servants
        .iter()
        .zip(near.into_iter().zip(rest))
        .map(|(one, (near, rest))| match one.weighed {
            true => one.weight,
            false => (one.promised + near + rest).clamp(1, 10_000),
        })
        .collect()
}

/// What of it is a change, and why.
fn outcome(
    one: &Facts<'_>,
    role: Role,
    mut history: History,
    (quota, weight): (u64, u64),
    near: Option<&str>,
    now: Instant,
) -> Outcome {
    let quota = Some(quota).filter(|quota| differs(one.quota, *quota, one.limit.max(one.promised)));
    let weight = Some(weight).filter(|weight| differs(one.weight, *weight, one.plain));
    match quota {
        Some(quota) if quota > one.quota => history.raised = Some(now),
        Some(_) => history.lowered = Some(now),
        None => {}
    }
    let changes = quota.is_some() || weight.is_some();
    let reason = match changes {
        true => reason(one, role, near, weight),
        false => String::new(),
    };
    Outcome {
        quota,
        weight,
        reason,
        history,
    }
}

/// Whether a change is worth it: it is no small one, or it leads to what is had without a controller.
fn differs(is: u64, to_be: u64, without: u64) -> bool {
    let part = if to_be == without { ALMOST } else { DEADBAND };
    is != to_be && is.abs_diff(to_be).saturating_mul(part) >= is
}

fn reason(one: &Facts<'_>, role: Role, near: Option<&str>, weight: Option<u64>) -> String {
    match (role, near) {
        (Role::Near, _) => match (one.measured, one.goal.and_then(Goal::bound)) {
            (Some(measured), Some(bound)) => format!(
                "its requests take {:.0} ms of the {bound:.0} ms that its robot accepts",
                measured.total
            ),
            _ => format!(
                "its robot has stated what it accepts, and it was held up in {:.0} % of the time",
                one.throttled.max(one.waited) * 100.0
            ),
        },
        (_, None) if weight.is_some_and(|weight| weight < one.plain) => {
            "the cores are promised to other servants".to_owned()
        }
        (Role::Content, None) => "its requests are answered in time without".to_owned(),
        (Role::Content | Role::Rest, Some(near)) => {
            format!("servant {near} needs cores that this one is not promised")
        }
        (Role::Rest, None) => "no other servant needs them now".to_owned(),
    }
}

#[cfg(test)]
mod tests;
