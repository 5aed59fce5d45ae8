//! Options of conversions, and the time that they fill in.

use std::time::{SystemTime, UNIX_EPOCH};

/// Default limit of a conversion's output: 256 MiB.
pub const DEFAULT_MAX_BYTES: usize = 256 << 20;

/// A ROS time since the epoch (or since the start of simulated time).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Time {
    /// Whole seconds.
    pub secs: u32,
    /// Nanoseconds of the current second, below 1e9.
    pub nsecs: u32,
}

impl Time {
    /// Returns the current wall-clock time.
    pub fn now() -> Time {
        Time::from(SystemTime::now())
    }
}

impl From<SystemTime> for Time {
    fn from(time: SystemTime) -> Time {
        let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
        Time { secs: u32::try_from(since.as_secs()).unwrap_or(u32::MAX), nsecs: since.subsec_nanos() }
    }
}

/// Representation of NaN and infinities in JSON, which has none of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum NonFinite {
    /// `null`, as in rosbridge.
    #[default]
    Null,
    /// `"NaN"`, `"Infinity"`, `"-Infinity"`.
    String,
    /// `NaN`, `Infinity`, `-Infinity`: as in Python; refused by strict parsers.
    Bare,
}

/// Treatment of ROS strings that are not UTF-8.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum InvalidUtf8 {
    /// Replace each invalid sequence with U+FFFD.
    #[default]
    Replace,
    /// Return an error that names the field.
    Refuse,
}

/// Options for writing JSON.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct JsonOptions {
    /// Representation of NaN and infinities.
    pub non_finite: NonFinite,
    /// Treatment of strings that are not UTF-8.
    pub invalid_utf8: InvalidUtf8,
    /// Maximum number of bytes to write.
    pub max_bytes: usize,
}

impl Default for JsonOptions {
    fn default() -> JsonOptions {
        JsonOptions {
            non_finite: NonFinite::default(),
            invalid_utf8: InvalidUtf8::default(),
            max_bytes: DEFAULT_MAX_BYTES,
        }
    }
}

/// Options for writing CBOR.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CborOptions {
    /// Write numeric arrays as RFC 8746 typed arrays, little endian; otherwise as plain arrays.
    pub typed_arrays: bool,
    /// Treatment of strings that are not UTF-8.
    pub invalid_utf8: InvalidUtf8,
    /// Maximum number of bytes to write.
    pub max_bytes: usize,
}

impl Default for CborOptions {
    fn default() -> CborOptions {
        CborOptions { typed_arrays: true, invalid_utf8: InvalidUtf8::default(), max_bytes: DEFAULT_MAX_BYTES }
    }
}

/// Options for completing partial input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FillOptions {
    /// Current time: used for `"now"` in place of a time, and for the stamp of a `std_msgs/Header` that is missing from
    /// its message or has no stamp. Without it both are zero. (ROS 2 counts signed seconds: until 2038.)
    pub now: Option<Time>,
    /// Maximum number of bytes to write.
    pub max_bytes: usize,
}

impl Default for FillOptions {
    fn default() -> FillOptions {
        FillOptions { now: None, max_bytes: DEFAULT_MAX_BYTES }
    }
}

/// Content of the input that the message cannot hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FillReport {
    /// True if a `std_msgs/Header` of a ROS 2 message, at any depth, came with `seq`, which ROS 2 removed from headers:
    /// it was dropped.
    pub dropped_seq: bool,
}
