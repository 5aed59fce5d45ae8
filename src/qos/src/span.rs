//! Time spans in text form: `100ms`, `0.3s`, `0.3` (seconds).

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Maximum span: a longer one is a mistake of units, and sums of deadlines cannot overflow far above it.
pub(crate) const LONGEST: Duration = Duration::from_secs(86_400);

/// A positive time span of at most a day, exact to the nanosecond. Serialized as text such as `"100ms"`; a number of
/// seconds is accepted as well.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Span(Duration);

/// The error of a text that is no time span.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParseSpanError(String);

impl fmt::Display for ParseSpanError {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{:?} is not a time from a nanosecond to a day; write seconds, such as 0.3, or 300ms", self.0)
    }
}

impl std::error::Error for ParseSpanError {}

impl Span {
    /// Creates a span from milliseconds; `None` if it is zero or longer than a day.
    pub fn from_millis(millis: u64) -> Option<Span> {
        Span::from_duration(Duration::from_millis(millis))
    }

    /// Creates a span from seconds; `None` if it is zero, negative or longer than a day.
    pub fn from_seconds(seconds: f64) -> Option<Span> {
        Duration::try_from_secs_f64(seconds).ok().and_then(Span::from_duration)
    }

    fn from_duration(time: Duration) -> Option<Span> {
        (!time.is_zero() && time <= LONGEST).then_some(Span(time))
    }

    /// Returns the span as a duration.
    pub fn duration(self) -> Duration {
        self.0
    }

    /// Returns the span in seconds.
    pub fn as_seconds(self) -> f64 {
        self.0.as_secs_f64()
    }
}

impl FromStr for Span {
    type Err = ParseSpanError;

    fn from_str(text: &str) -> Result<Span, ParseSpanError> {
        let refused = || ParseSpanError(text.to_owned());
        let (number, scale) = match (text.strip_suffix("ms"), text.strip_suffix('s')) {
            (Some(number), _) => (number, 1e3),
            (None, Some(number)) => (number, 1.0),
            (None, None) => (text, 1.0),
        };
        let number: f64 = number.trim().parse().map_err(|_| refused())?;
        // A quotient is rounded once, a product with 0.001 twice.
        Span::from_seconds(number / scale).ok_or_else(refused)
    }
}

impl fmt::Display for Span {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (whole, rest, digits, unit) = match self.0.as_secs() {
            0 => {
                let nanos = self.0.subsec_nanos();
                (u64::from(nanos / 1_000_000), nanos % 1_000_000, 6, "ms")
            }
            seconds => (seconds, self.0.subsec_nanos(), 9, "s"),
        };
        if rest == 0 {
            return write!(out, "{whole}{unit}");
        }
        let rest = format!("{rest:0digits$}");
        write!(out, "{whole}.{}{unit}", rest.trim_end_matches('0'))
    }
}

impl Serialize for Span {
    fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
        out.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Span {
    fn deserialize<D: Deserializer<'de>>(source: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged, expecting = "a time: seconds, or text such as \"300ms\"")]
        enum RawSpan {
            Seconds(f64),
            Text(String),
        }
        let text = match RawSpan::deserialize(source)? {
            RawSpan::Seconds(seconds) => seconds.to_string(),
            RawSpan::Text(text) => text,
        };
        text.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read_as_people_write_them_and_printed_shortly() {
        for (text, nanos, printed) in [
            ("100ms", 100_000_000, "100ms"),
            ("0.1", 100_000_000, "100ms"),
            ("0.1s", 100_000_000, "100ms"),
            ("3", 3_000_000_000, "3s"),
            ("1.5 s", 1_500_000_000, "1.5s"),
            ("33.3ms", 33_300_000, "33.3ms"),
            ("1e-9", 1, "0.000001ms"),
            ("86400", 86_400_000_000_000, "86400s"),
        ] {
            let span: Span = text.parse().expect(text);
            assert_eq!(span.duration(), Duration::from_nanos(nanos), "{text}");
            assert_eq!(span.to_string(), printed);
            assert_eq!(printed.parse(), Ok(span), "printed and read again");
            let json = serde_json::to_string(&span).expect("text");
            assert_eq!(json, format!("{printed:?}"));
            assert_eq!(serde_json::from_str::<Span>(&json).expect("read"), span);
        }
        let seconds: Span = serde_json::from_str("0.25").expect("a number of seconds");
        assert_eq!(Some(seconds), Span::from_millis(250));
    }

    #[test]
    fn what_is_no_time_is_named() {
        for text in ["", "soon", "0", "0ms", "-1", "nan", "inf", "1e-12", "86401", "5 min", "ms"] {
            let refused = text.parse::<Span>().expect_err(text);
            assert!(refused.to_string().contains(&format!("{text:?}")), "{refused}");
        }
        assert_eq!((Span::from_millis(0), Span::from_seconds(1e9)), (None, None));
    }
}
