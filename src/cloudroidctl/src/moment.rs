//! Points in time as people write and read them: in UTC, as RFC 3339, or as the time that has passed since.

use std::time::Duration;

use anyhow::anyhow;
use api::Millis;

use crate::token::lifetime;

/// Days from the year 0 of the Gregorian calendar, beginning on 1 March, to 1970-01-01.
const UNIX_EPOCH_DAYS: u64 = 719_468;
/// Days in 400 years.
const ERA_DAYS: u64 = 146_097;
/// Milliseconds in a day.
const DAY: u64 = 86_400_000;

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
    let days = time / DAY + UNIX_EPOCH_DAYS;
    let (era, day_of_era) = (days / ERA_DAYS, days % ERA_DAYS);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    // Counted from March, so that the leap day is the last of the year.
    let from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * from_march + 2) / 5 + 1;
    let month = if from_march < 10 { from_march + 3 } else { from_march - 9 };
    let year = era * 400 + year_of_era + u64::from(month <= 2);
    format!("{year:04}-{month:02}-{day:02}T{}Z", crate::output::clock(time))
}

/// Parses a date, or a date and time in UTC; `None` if the text is neither.
fn parse_date(text: &str) -> Option<Millis> {
    let text = text.strip_suffix('Z').unwrap_or(text);
    let (date, time) = text.split_once(['T', ' ']).unwrap_or((text, "00:00"));
    let mut parts = date.splitn(3, '-').map(|part| part.parse::<u64>().ok());
    let (year, month, day) = (parts.next()??, parts.next()??, parts.next()??);
    let mut parts = time.splitn(3, ':');
    let (hour, minute) = (parts.next()?.parse::<u64>().ok()?, parts.next()?.parse::<u64>().ok()?);
    let second = parts.next().unwrap_or("0").parse::<f64>().ok()?;
    let is_date = (1970..=9999).contains(&year) && (1..=12).contains(&month) && (1..=31).contains(&day);
    if !is_date || hour > 23 || minute > 59 || !(0.0..61.0).contains(&second) {
        return None;
    }
    let (year, from_march) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    let days = year * 365 + year / 4 - year / 100 + year / 400 + (153 * from_march + 2) / 5 + day - 1;
    let days = days.checked_sub(UNIX_EPOCH_DAYS)?;
    Some(days * DAY + (hour * 60 + minute) * 60_000 + (second * 1000.0).round() as u64)
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
        // 10,000 days in steps that are no whole number of months.
        for day in (0..10_000).step_by(17) {
            assert_eq!(parse_date(&format_date(day * DAY + 1)), Some(day * DAY + 1));
        }
        assert_eq!(parse_date("2001-09-09 01:46:40"), Some(1_000_000_000_000));
        assert_eq!(parse_date("2001-09-09T01:46"), Some(999_999_960_000));
    }

    #[test]
    fn a_moment_is_a_date_or_how_long_ago() {
        assert_eq!(Moment::parse("1970-01-02").expect("a date"), Moment::At(DAY));
        assert_eq!(Moment::parse("10m").expect("a duration"), Moment::Ago(Duration::from_secs(600)));
        for text in ["yesterday", "2026-13-01", "2026-11-30T25:00", ""] {
            let refused = Moment::parse(text).expect_err(text).to_string();
            assert!(refused.contains("such as 10m"), "{refused}");
        }
    }
}
