//! Messages that the robot recently did not send, as reported by it.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

/// Length of the observation period.
const LATELY: Duration = Duration::from_secs(60);
/// Maximum number of reports kept; robots report once a second.
const REPORTS: usize = 120;

/// Messages of one session that the robot has not sent.
#[derive(Default)]
pub(super) struct UnsentCounter(Mutex<State>);

#[derive(Default)]
struct State {
    /// Total of the session.
    all: u64,
    /// Times and increments of the reports.
    reports: VecDeque<(Instant, u64)>,
}

impl UnsentCounter {
    /// Records the total reported for the session.
    pub(super) fn record_total(&self, all: u64) {
        let mut state = self.0.lock();
        let more = all.saturating_sub(state.all);
        state.all = all;
        state.reports.push_back((Instant::now(), more));
        let surplus = state.reports.len().saturating_sub(REPORTS);
        state.reports.drain(..surplus);
    }

    /// Returns the number in the last minute.
    pub(super) fn last_minute(&self) -> u64 {
        let state = self.0.lock();
        let lately = state.reports.iter().filter(|(at, _)| at.elapsed() <= LATELY);
        lately.map(|(_, more)| more).fold(0, |sum, more| sum.saturating_add(*more))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_told_of_the_session_is_summed_up_lately() {
        let unsent = UnsentCounter::default();
        unsent.record_total(3);
        unsent.record_total(10);
        assert_eq!(unsent.last_minute(), 10);
        // A robot may report anything.
        unsent.record_total(0);
        unsent.record_total(u64::MAX);
        assert_eq!(unsent.last_minute(), u64::MAX);
        for _ in 0..REPORTS {
            unsent.record_total(u64::MAX);
        }
        assert_eq!(unsent.last_minute(), 0, "the oldest are forgotten");
    }
}
