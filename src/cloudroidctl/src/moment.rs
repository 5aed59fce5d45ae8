//! Points in time as people write and read them: in UTC, as RFC 3339, or as the time that has passed since.

use std::time::Duration;

use anyhow::anyhow;
use api::Millis;
use chrono::{DateTime, NaiveDate, NaiveDateTime, NaiveTime, SecondsFormat};

use crate::token::lifetime;

/// Dates with times in UTC, with a space in place of the `T`.
const FORMATS: [&str; 2] = ["%Y-%m-%d %H:%M:%S%.f", "%Y-%m-%d %H:%M"];

/// A point in time that the user names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moment {
    /// This time before now.
    Ago(Duration),
    /// Milliseconds since 1970.
    At(Millis),
}

impl Moment {
    /// Parses the time that has passed (`10m`), a date, or a date and time in UTC (`2026-11-30T07:00:00Z`).
    pub fn parse(text: &str) -> anyhow::Result<Moment> {
        if let Some(at) = parse_date(text) {
            return Ok(Moment::At(at));
        }
        let wrong = || anyhow!("write how long ago, such as 10m, or a time in UTC, such as 2026-11-30T07:00:00Z");
        lifetime(text).map(Moment::Ago).map_err(|_| wrong())
    }
}

/// Formats a date and time in UTC (RFC 3339).
pub fn format_date(time: Millis) -> String {
    let time = i64::try_from(time).ok().and_then(DateTime::from_timestamp_millis);
    time.unwrap_or_default().to_rfc3339_opts(SecondsFormat::Millis, true)
}

/// Parses a date, or a date and time in UTC; `None` if the text is neither, or before 1970.
fn parse_date(text: &str) -> Option<Millis> {
    let plain = text.strip_suffix('Z').unwrap_or(text).replace('T', " ");
    let midnight = || NaiveDate::parse_from_str(&plain, "%Y-%m-%d").map(|date| date.and_time(NaiveTime::MIN)).ok();
    let mut formats = FORMATS.iter();
    let time = formats.find_map(|format| NaiveDateTime::parse_from_str(&plain, format).ok()).or_else(midnight);
    u64::try_from(time?.and_utc().timestamp_millis()).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_come_back_as_they_were_written() {
        for text in ["1970-01-01T00:00:00.000Z", "2024-02-29T23:59:59.999Z", "2026-11-30T07:38:00.500Z"] {
            let at = parse_date(text).expect(text);
            assert_eq!(format_date(at), text);
        }
        assert_eq!(parse_date("2001-09-09 01:46:40"), Some(1_000_000_000_000));
        assert_eq!(parse_date("2001-09-09T01:46"), Some(999_999_960_000));
    }

    #[test]
    fn a_moment_is_a_date_or_how_long_ago() {
        assert_eq!(Moment::parse("1970-01-02").expect("a date"), Moment::At(86_400_000));
        assert_eq!(Moment::parse("10m").expect("a duration"), Moment::Ago(Duration::from_secs(600)));
        for text in ["yesterday", "2026-13-01", "2026-11-30T25:00", "1969-12-31", ""] {
            let refused = Moment::parse(text).expect_err(text).to_string();
            assert!(refused.contains("such as 10m"), "{refused}");
        }
    }
}
