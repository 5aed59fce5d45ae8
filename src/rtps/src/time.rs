//! Times and durations on the wire: seconds and a fraction of 2^32 (9.3.2).

use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// A duration as it stands on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WireDuration {
    /// Whole seconds.
    pub seconds: i32,
    /// Parts of 2^32 of a second.
    pub fraction: u32,
}

impl WireDuration {
    /// Without end.
    pub const INFINITE: Self = Self {
        seconds: i32::MAX,
        fraction: u32::MAX,
    };

    /// The duration; none where it has no end. A negative one is zero.
    pub fn finite(self) -> Option<Duration> {
        // Some write the fraction of an infinite duration as the largest signed number.
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
            Ok(seconds) => Self {
                seconds,
                fraction: fraction(duration.subsec_nanos()),
            },
        }
    }
}

/// A point in time as it stands on the wire: since 1970.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WireTime {
    /// Whole seconds.
    pub seconds: u32,
    /// Parts of 2^32 of a second.
    pub fraction: u32,
}

impl From<SystemTime> for WireTime {
    fn from(time: SystemTime) -> Self {
        let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
        // The wire's clock goes to 2106.
        Self {
            seconds: since.as_secs() as u32,
            fraction: fraction(since.subsec_nanos()),
        }
    }
}

/// Rounded up: so the same nanoseconds come back, as reading rounds down.
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
        assert_eq!(
            WireDuration {
                seconds: -1,
                fraction: 0
            }
            .finite(),
            Some(Duration::ZERO)
        );
    }
}
