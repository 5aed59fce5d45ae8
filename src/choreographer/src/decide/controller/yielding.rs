//! Decides which near servants yield when the cores do not suffice for all of them.
//!
//! Shared equally, the cores may leave every servant slightly late. The goal is the number of robots that are answered
//! in time; so the cores are given to as many as possible, and the others fall back to their promises. Every robot
//! counts as one, and all draw on the same cores: the maximum is reached by taking those that need least first (the
//! knapsack of items of equal value; Moore, 1968, does the same for the number of late jobs on one machine).

use std::time::{Duration, Instant};

use super::{
    ControlFacts, ControlHistory, HINDERED_SHARE, HOLD, MAX_HOLD_DOUBLINGS, MeasuredTimes, ResponseGoal, elapsed_since,
};

/// Fraction of the cores in use at which they count as used up: the rest is overhead.
const FULL: f64 = 0.85;
/// Time after which a yielding servant tries again; doubled after each vain attempt.
pub(super) const RETRY: Duration = Duration::from_secs(120);

impl ControlFacts<'_> {
    /// Returns true if its requests are late although it is not, and was not recently, throttled by `cpu.max`.
    fn is_late(&self, now: Instant) -> bool {
        let measured = self.measured.zip(self.goal.and_then(ResponseGoal::upper_bound));
        measured.is_some_and(|(measured, bound)| measured.total > bound)
            && self.throttled < HINDERED_SHARE
            && elapsed_since(self.history.raised, now) >= HOLD
    }

    /// Returns the cores with which its requests would be in time: its usage, scaled by the necessary speed-up. `None`
    /// if nothing is measured.
    fn demanded_cores(&self) -> Option<u64> {
        let (measured, bound) = self.measured.zip(self.goal.and_then(ResponseGoal::upper_bound))?;
        let MeasuredTimes { total, cloud } = measured;
        let allowed = bound - (total - cloud);
        let faster = if allowed > 0.0 { cloud / allowed } else { f64::INFINITY };
        // No machine has so many cores, and sums do not overflow.
        Some((self.used? as f64 * faster).min(f64::from(u32::MAX)) as u64)
    }

    /// Returns the cores it takes before the others share the rest.
    fn reserved_cores(&self, history: &ControlHistory) -> u64 {
        match (self.goal, history.yielded) {
            (Some(_), None) => self.estimated_need().min(self.quota),
            _ => self.floor(),
        }
    }

    /// Returns true if it has, or is to have, more than it was promised.
    fn is_sharing(&self, history: &ControlHistory) -> bool {
        let given = self.quota > self.limit.max(self.promised);
        history.yielded.is_none() && (given || history.near.is_some())
    }
}

/// Updates which servants yield.
pub(super) fn update_yields(cores: u64, servants: &[ControlFacts<'_>], histories: &mut [ControlHistory], now: Instant) {
    for history in histories.iter_mut() {
        if history.near.is_none() {
            (history.yielded, history.vain) = (None, 0);
        }
    }
    let all = || servants.iter().zip(histories.iter());
    let taken: u64 = all().map(|(one, history)| one.reserved_cores(history)).sum();
    let used: u64 = servants.iter().filter_map(|one| one.used).sum();
    let sharing = all().filter(|(one, history)| one.is_sharing(history)).count();
    let near = |history: &ControlHistory| history.near.is_some() && history.yielded.is_none();
    let late = all().any(|(one, history)| near(history) && one.is_late(now));
    if late && used as f64 >= cores as f64 * FULL {
        // The need of each beyond its floor, smallest first.
        let mut needs: Vec<(u64, usize)> = all()
            .enumerate()
            .filter(|(_, (_, history))| near(history))
            .filter_map(|(at, (one, _))| Some((one.demanded_cores()?.saturating_sub(one.floor()), at)))
            .collect();
        needs.sort_unstable();
        let (mut free, mut helped) = (cores, sharing - needs.len());
        for (at, (one, history)) in all().enumerate() {
            let asked = needs.iter().any(|(_, needing)| *needing == at);
            free = free.saturating_sub(if asked { one.floor() } else { one.reserved_cores(history) });
        }
        for (more, at) in needs {
            // If all yield, none is helped.
            if more <= free || helped == 0 {
                free = free.saturating_sub(more);
                helped += 1;
            } else {
                histories[at].yielded = Some(now);
            }
        }
        return;
    }
    for (one, history) in servants.iter().zip(histories) {
        let Some(since) = history.yielded else {
            continue;
        };
        let since = now.saturating_duration_since(since);
        let beside = taken - one.floor();
        let fits = |demand: u64| beside + demand <= cores;
        let again = since >= RETRY * 2u32.pow(history.vain);
        if again {
            history.vain = MAX_HOLD_DOUBLINGS.min(history.vain + 1);
        }
        if again || (since >= HOLD && (sharing == 0 || one.demanded_cores().is_some_and(fits))) {
            history.yielded = None;
        }
    }
}
