//! Ordering of connection attempts, which may overtake each other in the network: of the attempts of one run of a node,
//! the last one counts, whichever arrives first.

use std::collections::VecDeque;

use parking_lot::Mutex;

/// Number of runs remembered; the least recently seen ones are forgotten.
const MAX_RUNS: usize = 256;

/// The last attempt of each run.
#[derive(Debug, Default)]
pub(super) struct Attempts {
    last: Mutex<VecDeque<(String, u64)>>,
}

impl Attempts {
    /// Returns whether no later attempt of this run has arrived before. Stubs that do not count attempts send 0.
    pub(super) fn is_newest(&self, run: &str, attempt: u64) -> bool {
        let mut last = self.last.lock();
        let known = last.iter().position(|(known, _)| known == run);
        let known = known.and_then(|at| last.remove(at));
        let newest = known.map_or(0, |(_, newest)| newest);
        if last.len() == MAX_RUNS {
            last.pop_front();
        }
        last.push_back((run.to_owned(), newest.max(attempt)));
        attempt == 0 || attempt >= newest
    }

    /// Marks a run as ended: any further attempt is too late.
    pub(super) fn mark_ended(&self, run: &str) {
        self.is_newest(run, u64::MAX);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_older_attempt_is_known_as_such() {
        let attempts = Attempts::default();
        assert!(attempts.is_newest("life", 1));
        assert!(attempts.is_newest("life", 3));
        assert!(!attempts.is_newest("life", 2), "it was overtaken");
        assert!(attempts.is_newest("life", 4));
        assert!(attempts.is_newest("another", 1));
        assert!(attempts.is_newest("one that does not count", 0));
        assert!(attempts.is_newest("one that does not count", 0));
        attempts.mark_ended("life");
        assert!(!attempts.is_newest("life", 5));
    }

    #[test]
    fn few_are_remembered() {
        let attempts = Attempts::default();
        for number in 0..MAX_RUNS * 2 {
            assert!(attempts.is_newest("mine", 2));
            assert!(attempts.is_newest(&number.to_string(), 1));
        }
        assert_eq!(attempts.last.lock().len(), MAX_RUNS);
        assert!(!attempts.is_newest("mine", 1), "it was heard of again and again");
    }
}
