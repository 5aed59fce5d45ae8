//! Who yields where the cores do not suffice for all that are near what their robots accept.
//!
//! Shared equally, such cores may leave everybody a little late. What counts is how many robots are answered in time; so the
//! cores are given to as many as possible, and the others have what they were promised. Every robot counts as one, and all
//! draw on the same cores: the greatest number that fits is had by taking those first that need least (the knapsack of items of
//! one value; Moore, 1968, does the same for the number of late jobs on one machine).

use std::time::{Duration, Instant};

use super::{DOUBLED, Facts, Goal, HINDERED, HOLD, History, Measured, elapsed};

/// The cores are used up where servants use this part of them: the rest is needed to reach the servants.
const FULL: f64 = 0.85;
/// One that yielded tries again after so long, twice as long for each time that this was in vain.
pub(super) const RETRY: Duration = Duration::from_secs(120);

impl Facts<'_> {
    /// Its requests are answered too late, although no `cpu.max` keeps it from running, nor has lately.
    fn is_late(&self, now: Instant) -> bool {
        let measured = self.measured.zip(self.goal.and_then(Goal::bound));
        measured.is_some_and(|(measured, bound)| measured.total > bound)
            && self.throttled < HINDERED
            && elapsed(self.history.raised, now) >= HOLD
    }

    /// The cores with which its requests would be in time: what it uses, more by as much as they have to be faster. None
    /// where nothing is measured.
    fn demand(&self) -> Option<u64> {
        let (measured, bound) = self.measured.zip(self.goal.and_then(Goal::bound))?;
        let Measured { total, cloud } = measured;
        let allowed = bound - (total - cloud);
        let faster = match allowed > 0.0 {
            true => cloud / allowed,
            false => f64::INFINITY,
        };
        // No machine has so many, and sums of them do not overflow.
        Some((self.used? as f64 * faster).min(f64::from(u32::MAX)) as u64)
    }

    /// What it takes of the cores whoever shares the others.
    fn takes(&self, history: &History) -> u64 {
        match (self.goal, history.yielded) {
            (Some(_), None) => self.needs().min(self.quota),
            _ => self.floor(),
        }
    }

    /// It is given more than it was promised, or is to be.
    fn shares(&self, history: &History) -> bool {
        let given = self.quota > self.limit.max(self.promised);
        history.yielded.is_none() && (given || history.near.is_some())
    }
}

/// Notes who yields from now on, and who no longer does.
pub(super) fn decide(cores: u64, servants: &[Facts<'_>], histories: &mut [History], now: Instant) {
    for history in histories.iter_mut() {
        if history.near.is_none() {
            (history.yielded, history.vain) = (None, 0);
        }
    }
    let all = || servants.iter().zip(histories.iter());
    let taken: u64 = all().map(|(one, history)| one.takes(history)).sum();
    let used: u64 = servants.iter().filter_map(|one| one.used).sum();
    let sharing = all().filter(|(one, history)| one.shares(history)).count();
    let near = |history: &History| history.near.is_some() && history.yielded.is_none();
    let late = all().any(|(one, history)| near(history) && one.is_late(now));
    if late && used as f64 >= cores as f64 * FULL {
        // What each needs beyond what it has anyway, the least first.
        let mut needs: Vec<(u64, usize)> = all()
            .enumerate()
            .filter(|(_, (_, history))| near(history))
            .filter_map(|(at, (one, _))| Some((one.demand()?.saturating_sub(one.floor()), at)))
            .collect();
        needs.sort_unstable();
        let (mut free, mut helped) = (cores, sharing - needs.len());
        for (at, (one, history)) in all().enumerate() {
            let asked = needs.iter().any(|(_, needing)| *needing == at);
            free = free.saturating_sub(if asked {
                one.floor()
            } else {
                one.takes(history)
            });
        }
        for (more, at) in needs {
            // Nobody is helped where all yield.
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
            history.vain = DOUBLED.min(history.vain + 1);
        }
        if again || (since >= HOLD && (sharing == 0 || one.demand().is_some_and(fits))) {
            history.yielded = None;
        }
    }
}
