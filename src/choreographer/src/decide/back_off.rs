//! Back-off for failed servants: at once after the first failure, then after pauses that double (truncated exponential
//! back-off, as in IEEE 802.3).

use std::time::{Duration, Instant};

/// Pause after the second failure in a row.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const LONGEST_PAUSE: Duration = Duration::from_secs(300);
/// Longest pause if several robots share it, because one of them may have caused the failure with its messages.
const MAX_SHARED_PAUSE: Duration = Duration::from_secs(4);
/// Time after which a ready servant, or a running node, counts as recovered from earlier failures.
pub const RECOVERY_TIME: Duration = Duration::from_secs(60);
/// Time after a failure's pause until the failure is forgotten.
const FAILURE_EXPIRY: Duration = Duration::from_secs(600);

/// Consecutive failures of one robot's servants of one revision.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FailureStreak {
    /// The failing revision.
    pub revision: u64,
    /// Number of failures in a row.
    pub failures: u32,
    /// The last failure, as a phrase that starts with a verb.
    pub reason: String,
    /// Earliest time of the next start.
    pub again: Instant,
}

/// Records that a servant of `revision` has failed at `now`, after being ready for `ready_for` if it ever was.
/// `shared`: the pause applies to several robots.
pub fn after_failure(
    before: Option<&FailureStreak>,
    (revision, shared): (u64, bool),
    ready_for: Option<Duration>,
    reason: &str,
    now: Instant,
) -> FailureStreak {
    let counts = |before: &&FailureStreak| {
        let recovered = ready_for.is_some_and(|time| time >= RECOVERY_TIME);
        before.revision == revision && !recovered && !is_forgotten(before, now)
    };
    let failures = before.filter(counts).map_or(1, |before| before.failures.saturating_add(1));
    // A servant that was never ready has met no robot.
    let longest = if shared && ready_for.is_some() { MAX_SHARED_PAUSE } else { LONGEST_PAUSE };
    let pause = match failures {
        1 => Duration::ZERO,
        n => double_pause(FIRST_PAUSE, n - 2, longest),
    };
    FailureStreak { revision, failures, reason: reason.to_owned(), again: now + pause }
}

/// Returns `first`, doubled `times` times, and at most `longest`.
pub(super) fn double_pause(first: Duration, times: u32, longest: Duration) -> Duration {
    let pause = first.checked_mul(2u32.saturating_pow(times));
    pause.map_or(longest, |pause| pause.min(longest))
}

/// Returns how long a servant of `revision` may not be started yet, if so.
pub fn remaining_pause(of: &FailureStreak, revision: u64, now: Instant) -> Option<Duration> {
    let left = of.again.saturating_duration_since(now);
    (of.revision == revision && !left.is_zero()).then_some(left)
}

/// Returns true if the failures are too long ago to count.
pub fn is_forgotten(of: &FailureStreak, now: Instant) -> bool {
    now >= of.again + FAILURE_EXPIRY
}

/// Returns the remaining seconds, rounded up, so that a retry after them is not too early.
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
        let mut failing: Option<FailureStreak> = None;
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
        assert_eq!(fails(1, Some(RECOVERY_TIME / 2), none), 300, "not for long");
        assert_eq!(fails(1, Some(RECOVERY_TIME), none), 0, "it had recovered");
        assert_eq!(fails(1, None, none), 1);
        assert_eq!(fails(2, None, none), 0, "another revision");
        assert_eq!(fails(2, None, FAILURE_EXPIRY), 1);
        assert_eq!(fails(2, None, none), 0, "long ago");
    }

    #[test]
    fn no_robot_keeps_others_that_share_its_pause_away_for_long() {
        let now = Instant::now();
        let failing = |ready_for| {
            let mut before: Option<FailureStreak> = None;
            for _ in 0..20 {
                let next = after_failure(before.as_ref(), (1, true), ready_for, "died", now);
                before = Some(next);
            }
            before.expect("it failed").again - now
        };
        assert_eq!(failing(Some(Duration::ZERO)), MAX_SHARED_PAUSE);
        assert_eq!(failing(None), LONGEST_PAUSE, "no robot has done that");
    }

    #[test]
    fn only_the_revision_that_fails_waits() {
        let now = Instant::now();
        let second = Duration::from_secs(1);
        let failing = FailureStreak { revision: 2, failures: 3, reason: "died".into(), again: now + second };
        assert_eq!(remaining_pause(&failing, 2, now), Some(second));
        assert_eq!(remaining_pause(&failing, 1, now), None);
        assert_eq!(remaining_pause(&failing, 2, now + second), None);
    }

    proptest! {
        #[test]
        fn no_pause_is_shorter_than_the_one_before_while_it_fails(
            gaps in prop::collection::vec(0u64..900, 1..30),
        ) {
            let mut now = Instant::now();
            let mut before: Option<FailureStreak> = None;
            for gap in gaps {
                let next = after_failure(before.as_ref(), (1, false), None, "died", now);
                let pause = next.again - now;
                prop_assert!(pause <= LONGEST_PAUSE);
                prop_assert_eq!(pause.is_zero(), next.failures == 1);
                prop_assert_eq!(remaining_pause(&next, 1, now), (!pause.is_zero()).then_some(pause));
                if let Some(before) = before.filter(|before| !is_forgotten(before, now)) {
                    prop_assert_eq!(next.failures, before.failures + 1);
                }
                now = next.again + Duration::from_secs(gap);
                before = Some(next);
            }
        }
    }
}
