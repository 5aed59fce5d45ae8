//! Times and durations: ROS 1's primitives (seconds and nanoseconds, both unsigned in a time and both signed in a
//! duration) and ROS 2's `builtin_interfaces` (signed seconds, unsigned nanoseconds).
//!
//! They are copied as they are, and not normalised, wherever the other ROS can hold the same two numbers.

use ros_message::RosVersion;

const SECOND: i64 = 1_000_000_000;

/// Kinds of stamps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stamp {
    Time,
    Duration,
}

/// Converts a stamp of ROS `from`, given as two words, into the other ROS's. Returns true beside it if it lies before
/// 1970 or after 2038 (or is no duration there) and the nearest one stands in its place.
pub(crate) fn convert_stamp(stamp: Stamp, from: RosVersion, seconds: u32, nanoseconds: u32) -> ([u32; 2], bool) {
    let (first, last) = ((i32::MIN as u32, 0), (i32::MAX as u32, SECOND as u32 - 1));
    let same = ([seconds, nanoseconds], false);
    let instead = |(seconds, nanoseconds)| ([seconds, nanoseconds], true);
    let is_negative = |word: u32| (word as i32) < 0;
    match (stamp, from) {
        (Stamp::Time, RosVersion::One) if is_negative(seconds) => instead(last),
        (Stamp::Time, RosVersion::Two) if is_negative(seconds) => instead((0, 0)),
        (Stamp::Time, _) => same,
        (Stamp::Duration, _) if !is_negative(nanoseconds) => same,
        (Stamp::Duration, _) => {
            // The word is below zero in ROS 1, above 2^31 in ROS 2.
            let nanoseconds = match from {
                RosVersion::One => i64::from(nanoseconds as i32),
                RosVersion::Two => i64::from(nanoseconds),
            };
            let whole = i64::from(seconds as i32) + nanoseconds.div_euclid(SECOND);
            let rest = nanoseconds.rem_euclid(SECOND) as u32;
            match i32::try_from(whole) {
                Ok(whole) => ([whole as u32, rest], false),
                Err(_) if whole < 0 => instead(first),
                Err(_) => instead(last),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_outside_of_both_calendars_become_the_nearest() {
        let (one, two) = (RosVersion::One, RosVersion::Two);
        let time = |from, seconds, nanoseconds| convert_stamp(Stamp::Time, from, seconds, nanoseconds);
        assert_eq!(time(one, 1_700_000_000, 5), ([1_700_000_000, 5], false));
        assert_eq!(time(one, i32::MAX as u32, 5), ([i32::MAX as u32, 5], false));
        assert_eq!(time(one, 1 << 31, 5), ([i32::MAX as u32, 999_999_999], true), "after 2038");
        assert_eq!(time(two, -1i32 as u32, 5), ([0, 0], true), "before 1970");
        assert_eq!(time(two, 3, u32::MAX), ([3, u32::MAX], false), "as it is");
    }

    #[test]
    fn durations_are_normalised_only_where_the_numbers_do_not_fit() {
        let (one, two) = (RosVersion::One, RosVersion::Two);
        let duration = |from, seconds: i32, nanoseconds: u32| {
            let ([seconds, nanoseconds], saturated) = convert_stamp(Stamp::Duration, from, seconds as u32, nanoseconds);
            (seconds as i32, nanoseconds, saturated)
        };
        assert_eq!(duration(one, -3, 7), (-3, 7, false));
        assert_eq!(duration(one, 1, -1i32 as u32), (0, 999_999_999, false), "a nanosecond less than one second");
        assert_eq!(duration(one, i32::MIN, -1i32 as u32), (i32::MIN, 0, true));
        assert_eq!(duration(two, 1, 2_000_000_000), (1, 2_000_000_000, false), "as it is");
        assert_eq!(duration(two, 1, 3_000_000_001), (4, 1, false));
        assert_eq!(duration(two, i32::MAX, 3_000_000_001), (i32::MAX, 999_999_999, true));
    }
}
