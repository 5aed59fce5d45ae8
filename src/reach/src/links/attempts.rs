//! Connections overtake one another on their way: of those that one life of a node has tried, the last one counts,
//! whichever comes first.

use std::collections::VecDeque;

use parking_lot::Mutex;

/// Lives of nodes that are remembered; those of which nothing was heard for longest are forgotten.
const REMEMBERED: usize = 256;

/// The last attempt of each life.
#[derive(Debug, Default)]
pub(super) struct Attempts {
    last: Mutex<VecDeque<(String, u64)>>,
}

impl Attempts {
    /// Whether no later attempt of this life has come before. 0 is that of a stub which does not count them.
    pub(super) fn is_newest(&self, run: &str, attempt: u64) -> bool {
        let mut last = self.last.lock();
        let known = last.iter().position(|(known, _)| known == run);
        let known = known.and_then(|at| last.remove(at));
        let newest = known.map_or(0, |(_, newest)| newest);
        if last.len() == REMEMBERED {
            last.pop_front();
        }
        last.push_back((run.to_owned(), newest.max(attempt)));
        attempt == 0 || attempt >= newest
    }

    /// The node has ended: whatever still comes of this life is too late.
    pub(super) fn ended(&self, run: &str) {
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
        attempts.ended("life");
        assert!(!attempts.is_newest("life", 5));
    }

    #[test]
    fn few_are_remembered() {
        let attempts = Attempts::default();
        for number in 0..REMEMBERED * 2 {
            assert!(attempts.is_newest("mine", 2));
            assert!(attempts.is_newest(&number.to_string(), 1));
        }
        assert_eq!(attempts.last.lock().len(), REMEMBERED);
        assert!(
            !attempts.is_newest("mine", 1),
            "it was heard of again and again"
        );
    }
}
