//! Times and numbers as people write them.

use std::time::Duration;

use serde::Deserialize;

use crate::sla_error::SlaError;

/// Beyond a day it is a mistake of units, and far below it sums of deadlines cannot overflow.
pub(super) const LONGEST: Duration = Duration::from_secs(86_400);

/// A time as written: seconds, or text with a unit.
#[derive(Deserialize, Clone)]
#[serde(
    untagged,
    expecting = "a time: seconds as a number, or text such as \"300ms\""
)]
pub(super) enum Span {
    Seconds(f64),
    Text(String),
}

impl Span {
    pub(super) fn check(&self, field: &str) -> Result<Duration, SlaError> {
        let seconds =
            match self {
                Self::Seconds(seconds) => *seconds,
                Self::Text(text) => {
                    let text = text.trim();
                    let (number, scale) = match (text.strip_suffix("ms"), text.strip_suffix('s')) {
                        (Some(number), _) => (number, 1e-3),
                        (None, Some(number)) => (number, 1.0),
                        (None, None) => (text, 1.0),
                    };
                    number.trim().parse::<f64>().map(|number| number * scale).map_err(|_| {
                    SlaError::new(
                        field,
                        format!("{text:?} is not a time; write seconds, such as 0.3, or \"300ms\""),
                    )
                })?
                }
            };
        positive(field, seconds)?;
        if seconds > LONGEST.as_secs_f64() {
            return Err(SlaError::new(
                field,
                format!("{seconds} s is more than a day; times are in seconds"),
            ));
        }
        let time = Duration::from_secs_f64(seconds);
        if time.is_zero() {
            return Err(SlaError::new(
                field,
                format!("{seconds} s is less than a nanosecond"),
            ));
        }
        Ok(time)
    }
}

/// The time between two frames of a rate.
pub(super) fn interval(field: &str, rate: f64) -> Result<Duration, SlaError> {
    Span::Seconds(1.0 / rate).check(field)
}

pub(super) fn positive(field: &str, value: f64) -> Result<(), SlaError> {
    if value.is_finite() && value > 0.0 && (4.0 * value).is_normal() {
        return Ok(());
    }
    Err(SlaError::new(
        field,
        format!("{value} is not a positive number"),
    ))
}
