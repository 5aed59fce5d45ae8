//! When a servant that failed may be started again: at once after the first failure, then after pauses that double (truncated
//! exponential back-off, as in IEEE 802.3).

use std::time::{Duration, Instant};

/// After the second failure in a row.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const LONGEST_PAUSE: Duration = Duration::from_secs(300);
/// The same where the pause is that of several robots, and what one of them sent may have ended the servant.
const LONGEST_SHARED: Duration = Duration::from_secs(4);
/// A servant that was ready for so long before it failed had recovered, and so had a node that ran for so long.
pub const RECOVERED: Duration = Duration::from_secs(60);
/// Time after a failure's pause until the failure is forgotten.
const FORGOTTEN: Duration = Duration::from_secs(600);

/// Failures of one robot's servants of one revision, one after the other.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failing {
    /// Of which revision.
    pub revision: u64,
    /// How often in a row.
    pub failures: u32,
    /// What happened last, beginning with a verb.
    pub reason: String,
    /// Not before this moment is one started again.
    pub again: Instant,
}

/// A servant of `revision` has failed at `now`, after it was ready for `ready_for` if it ever was. `shared`: the pause is that of
/// several robots.
pub fn after_failure(
    before: Option<&Failing>,
    (revision, shared): (u64, bool),
    ready_for: Option<Duration>,
    reason: &str,
    now: Instant,
) -> Failing {
    let counts = |before: &&Failing| {
        let recovered = ready_for.is_some_and(|time| time >= RECOVERED);
        before.revision == revision && !recovered && !is_forgotten(before, now)
    };
    let failures = before
        .filter(counts)
        .map_or(1, |before| before.failures.saturating_add(1));
    // One that was never ready has met no robot.
    let longest = match shared && ready_for.is_some() {
        true => LONGEST_SHARED,
        false => LONGEST_PAUSE,
    };
    let pause = match failures {
        1 => Duration::ZERO,
        n => doubled(FIRST_PAUSE, n - 2, longest),
    };
    Failing {
        revision,
        failures,
        reason: reason.to_owned(),
        again: now + pause,
    }
}

/// A pause that was `first` and has doubled so many times.
pub(super) fn doubled(first: Duration, times: u32, longest: Duration) -> Duration {
    let pause = first.checked_mul(2u32.saturating_pow(times));
    pause.map_or(longest, |pause| pause.min(longest))
}

/// How long a servant of `revision` may not be started, if so.
pub fn refusal(of: &Failing, revision: u64, now: Instant) -> Option<Duration> {
    let left = of.again.saturating_duration_since(now);
    (of.revision == revision && !left.is_zero()).then_some(left)
}

/// Whether it is too long ago to count.
pub fn is_forgotten(of: &Failing, now: Instant) -> bool {
    now >= of.again + FORGOTTEN
}

/// The seconds that are left, rounded up: whoever comes after them is not too early.
pub fn seconds(left: Duration) -> u64 {
    left.as_millis().div_ceil(1000) as u64
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn pauses_double_until_the_longest_and_begin_anew() {
        let mut now = Instant::now();
        let mut failing: Option<Failing> = None;
        let mut fails = |revision, ready_for, after| {
            let next = after_failure(failing.as_ref(), (revision, false), ready_for, "died", now);
            let pause = (next.again - now).as_secs();
            now = next.again + after;
            failing = Some(next);
            pause
        };
        let none = Duration::ZERO;
        let pauses: Vec<u64> = (0..12).map(|_| fails(1, None, none)).collect();
        assert_eq!(pauses, [0, 1, 2, 4, 8, 16, 32, 64, 128, 256, 300, 300]);
        assert_eq!(fails(1, Some(RECOVERED / 2), none), 300, "not for long");
        assert_eq!(fails(1, Some(RECOVERED), none), 0, "it had recovered");
        assert_eq!(fails(1, None, none), 1);
        assert_eq!(fails(2, None, none), 0, "another revision");
        assert_eq!(fails(2, None, FORGOTTEN), 1);
        assert_eq!(fails(2, None, none), 0, "long ago");
    }

    #[test]
    fn no_robot_keeps_others_that_share_its_pause_away_for_long() {
        let now = Instant::now();
        let failing = |ready_for| {
            let mut before: Option<Failing> = None;
            for _ in 0..20 {
                let next = after_failure(before.as_ref(), (1, true), ready_for, "died", now);
                before = Some(next);
            }
            before.expect("it failed").again - now
        };
        assert_eq!(failing(Some(Duration::ZERO)), LONGEST_SHARED);
        assert_eq!(failing(None), LONGEST_PAUSE, "no robot has done that");
    }

    #[test]
    fn only_the_revision_that_fails_waits() {
        let now = Instant::now();
        let second = Duration::from_secs(1);
        let failing = Failing {
            revision: 2,
            failures: 3,
            reason: "died".into(),
            again: now + second,
        };
        assert_eq!(refusal(&failing, 2, now), Some(second));
        assert_eq!(refusal(&failing, 1, now), None);
        assert_eq!(refusal(&failing, 2, now + second), None);
    }

    proptest! {
        #[test]
        fn no_pause_is_shorter_than_the_one_before_while_it_fails(
            gaps in prop::collection::vec(0u64..900, 1..30),
        ) {
            let mut now = Instant::now();
            let mut before: Option<Failing> = None;
            for gap in gaps {
                let next = after_failure(before.as_ref(), (1, false), None, "died", now);
                let pause = next.again - now;
                prop_assert!(pause <= LONGEST_PAUSE);
                prop_assert_eq!(pause.is_zero(), next.failures == 1);
                prop_assert_eq!(refusal(&next, 1, now), (!pause.is_zero()).then_some(pause));
                if let Some(before) = before.filter(|before| !is_forgotten(before, now)) {
                    prop_assert_eq!(next.failures, before.failures + 1);
                }
                now = next.again + Duration::from_secs(gap);
                before = Some(next);
            }
        }
    }
}
