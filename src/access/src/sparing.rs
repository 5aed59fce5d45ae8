//! What is told again and again is told once a minute. Pure: the time is given.

use std::collections::HashMap;

/// Milliseconds since any beginning.
type Millis = u64;

/// What is alike within that time is not told again.
const AGAIN: Millis = 60_000;
/// Different things that are remembered. While there are as many, others are not told either, and counted.
const DIFFERENT: usize = 256;

/// What was told lately.
#[derive(Debug, Default)]
pub struct Sparing {
    told: HashMap<String, Told>,
    /// For which there was no room.
    others: u64,
}

#[derive(Debug)]
struct Told {
    at: Millis,
    omitted: u64,
}

impl Sparing {
    /// Whether `what` is to be told now: then how many alike were not since the last time, or for which there was no room.
    pub fn ask(&mut self, what: &str, now: Millis) -> Option<u64> {
        if let Some(told) = self.told.get_mut(what) {
            if now.saturating_sub(told.at) < AGAIN {
                told.omitted += 1;
                return None;
            }
            told.at = now;
            return Some(std::mem::take(&mut told.omitted));
        }
        if self.told.len() >= DIFFERENT {
            // With what was omitted of those that nobody has asked about since.
            let mut omitted = 0;
            self.told.retain(|_, told| {
                let stays = now.saturating_sub(told.at) < AGAIN;
                omitted += if stays { 0 } else { told.omitted };
                stays
            });
            self.others += omitted;
        }
        if self.told.len() >= DIFFERENT {
            self.others += 1;
            return None;
        }
        let told = Told {
            at: now,
            omitted: 0,
        };
        self.told.insert(what.to_owned(), told);
        Some(std::mem::take(&mut self.others))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn what_is_alike_is_told_once_a_minute_with_how_often_it_was() {
        let mut sparing = Sparing::default();
        for (what, at, told) in [
            ("a", 0, Some(0)),
            ("a", 1, None),
            ("b", 1, Some(0)),
            ("a", AGAIN - 1, None),
            ("a", AGAIN, Some(2)),
            ("a", 2 * AGAIN, Some(0)),
        ] {
            assert_eq!(sparing.ask(what, at), told, "{what} {at}");
        }
    }

    #[test]
    fn a_great_many_different_things_are_counted() {
        let mut sparing = Sparing::default();
        for number in 0..DIFFERENT {
            assert_eq!(sparing.ask(&number.to_string(), 0), Some(0));
        }
        assert_eq!(sparing.ask("x", 1), None);
        assert_eq!(sparing.ask("0", 1), None);
        assert_eq!(sparing.ask("x", AGAIN), Some(2));
        assert_eq!(sparing.told.len(), 1);
    }

    proptest! {
        /// Nothing is lost: what was told, with what was said to be omitted and is still to be said, is what came.
        #[test]
        fn everything_is_told_or_counted(steps in prop::collection::vec((0u64..30_000, 0usize..500), 1..3_000)) {
            let mut sparing = Sparing::default();
            let (mut now, mut counted) = (0, 0);
            for (step, what) in &steps {
                now += step / 100;
                if let Some(omitted) = sparing.ask(&what.to_string(), now) {
                    counted += 1 + omitted;
                }
            }
            let kept: u64 = sparing.told.values().map(|told| told.omitted).sum();
            prop_assert_eq!(counted + kept + sparing.others, steps.len() as u64);
            prop_assert!(sparing.told.len() <= DIFFERENT);
        }
    }
}
