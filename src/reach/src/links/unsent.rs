//! What the robot did not send lately, as it tells.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

/// What counts as lately.
const LATELY: Duration = Duration::from_secs(60);
/// Reports kept: robots tell once a second.
const REPORTS: usize = 120;

/// Messages of one session that the robot has not sent.
#[derive(Default)]
pub(super) struct Unsent(Mutex<State>);

#[derive(Default)]
struct State {
    /// Over the session.
    all: u64,
    /// How many more there were, and when that was told.
    reports: VecDeque<(Instant, u64)>,
}

impl Unsent {
    /// So many it was over the session.
    pub(super) fn note(&self, all: u64) {
        let mut state = self.0.lock();
        let more = all.saturating_sub(state.all);
        state.all = all;
        state.reports.push_back((Instant::now(), more));
        let surplus = state.reports.len().saturating_sub(REPORTS);
        state.reports.drain(..surplus);
    }

    /// So many it was in the last minute.
    pub(super) fn lately(&self) -> u64 {
        let state = self.0.lock();
        let lately = state
            .reports
            .iter()
            .filter(|(at, _)| at.elapsed() <= LATELY);
        lately
            .map(|(_, more)| more)
            .fold(0, |sum, more| sum.saturating_add(*more))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_told_of_the_session_is_summed_up_lately() {
        let unsent = Unsent::default();
        unsent.note(3);
        unsent.note(10);
        assert_eq!(unsent.lately(), 10);
        // A robot may tell anything.
        unsent.note(0);
        unsent.note(u64::MAX);
        assert_eq!(unsent.lately(), u64::MAX);
        for _ in 0..REPORTS {
            unsent.note(u64::MAX);
        }
        assert_eq!(unsent.lately(), 0, "the oldest are forgotten");
    }
}
