//! Throttle for repeated notices: equal ones are admitted once a minute. Pure: the time is passed in.

use std::collections::HashMap;

use api::Millis;

/// Interval between equal notices.
const AGAIN: Millis = 60_000;
/// Limit on the distinct notices remembered. While it is reached, further ones are only counted.
const DIFFERENT: usize = 256;

/// Throttle for repeated notices.
#[derive(Debug, Default)]
pub struct NoticeThrottle {
    told: HashMap<String, RecentNotice>,
    /// Number of notices omitted because the table was full.
    others: u64,
}

#[derive(Debug)]
struct RecentNotice {
    at: Millis,
    omitted: u64,
}

impl NoticeThrottle {
    /// Returns `Some` if the notice is admitted now, with the number of equal ones omitted since the last, or of
    /// those omitted because the table was full.
    pub fn admit(&mut self, what: &str, now: Millis) -> Option<u64> {
        if let Some(told) = self.told.get_mut(what) {
            if now.saturating_sub(told.at) < AGAIN {
                told.omitted += 1;
                return None;
            }
            told.at = now;
            return Some(std::mem::take(&mut told.omitted));
        }
        if self.told.len() >= DIFFERENT {
            // Includes the omissions of expired entries that were never admitted again.
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
        let told = RecentNotice { at: now, omitted: 0 };
        self.told.insert(what.to_owned(), told);
        Some(std::mem::take(&mut self.others))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn equal_notices_are_admitted_once_a_minute_with_a_count() {
        let mut throttle = NoticeThrottle::default();
        for (what, at, told) in [
            ("a", 0, Some(0)),
            ("a", 1, None),
            ("b", 1, Some(0)),
            ("a", AGAIN - 1, None),
            ("a", AGAIN, Some(2)),
            ("a", 2 * AGAIN, Some(0)),
        ] {
            assert_eq!(throttle.admit(what, at), told, "{what} {at}");
        }
    }

    #[test]
    fn a_great_many_different_things_are_counted() {
        let mut throttle = NoticeThrottle::default();
        for number in 0..DIFFERENT {
            assert_eq!(throttle.admit(&number.to_string(), 0), Some(0));
        }
        assert_eq!(throttle.admit("x", 1), None);
        assert_eq!(throttle.admit("0", 1), None);
        assert_eq!(throttle.admit("x", AGAIN), Some(2));
        assert_eq!(throttle.told.len(), 1);
    }

    proptest! {
        /// Nothing is lost: admitted notices plus reported and pending omissions equal the notices that came.
        #[test]
        fn everything_is_told_or_counted(steps in prop::collection::vec((0u64..30_000, 0usize..500), 1..3_000)) {
            let mut throttle = NoticeThrottle::default();
            let (mut now, mut counted) = (0, 0);
            for (step, what) in &steps {
                now += step / 100;
                if let Some(omitted) = throttle.admit(&what.to_string(), now) {
                    counted += 1 + omitted;
                }
            }
            let kept: u64 = throttle.told.values().map(|told| told.omitted).sum();
            prop_assert_eq!(counted + kept + throttle.others, steps.len() as u64);
            prop_assert!(throttle.told.len() <= DIFFERENT);
        }
    }
}
