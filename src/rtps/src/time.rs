//! Wire format of times and durations: seconds and a fraction of 2^32 (9.3.2).

use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Wire format of a duration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WireDuration {
    /// Whole seconds.
    pub seconds: i32,
    /// Fraction in units of 2^-32 seconds.
    pub fraction: u32,
}

impl WireDuration {
    /// Infinite duration.
    pub const INFINITE: Self = Self { seconds: i32::MAX, fraction: u32::MAX };

    /// Returns the duration; `None` if it is infinite. Negative durations become zero.
    pub fn finite(self) -> Option<Duration> {
        // Some implementations write the largest signed number as the fraction of an infinite duration.
        if self.seconds == i32::MAX {
            return None;
        }
        let seconds = u64::try_from(self.seconds).unwrap_or(0);
        let nanoseconds = (u64::from(self.fraction) * 1_000_000_000) >> 32;
        Some(Duration::new(seconds, nanoseconds as u32))
    }
}

impl From<Duration> for WireDuration {
    fn from(duration: Duration) -> Self {
        match i32::try_from(duration.as_secs()) {
            Ok(i32::MAX) | Err(_) => Self::INFINITE,
            Ok(seconds) => Self { seconds, fraction: fraction(duration.subsec_nanos()) },
        }
    }
}

/// Wire format of a time since the Unix epoch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WireTime {
    /// Whole seconds.
    pub seconds: u32,
    /// Fraction in units of 2^-32 seconds.
    pub fraction: u32,
}

impl From<SystemTime> for WireTime {
    fn from(time: SystemTime) -> Self {
        let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
        // The wire format ends in 2106.
        Self { seconds: since.as_secs() as u32, fraction: fraction(since.subsec_nanos()) }
    }
}

/// Rounded up, so that the same nanoseconds result when reading rounds down.
fn fraction(nanoseconds: u32) -> u32 {
    (u64::from(nanoseconds) << 32).div_ceil(1_000_000_000) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_come_back_and_endless_ones_stay_endless() {
        let half = WireDuration::from(Duration::from_millis(1500));
        assert_eq!((half.seconds, half.fraction), (1, 1 << 31));
        assert_eq!(half.finite(), Some(Duration::from_millis(1500)));
        assert_eq!(WireDuration::INFINITE.finite(), None);
        assert_eq!(WireDuration::from(Duration::MAX), WireDuration::INFINITE);
        assert_eq!(WireDuration { seconds: -1, fraction: 0 }.finite(), Some(Duration::ZERO));
    }
}
