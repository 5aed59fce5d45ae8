//! Durations as people write them in the configuration.

use std::time::Duration;

use serde::{Deserialize, Deserializer};

/// A duration: `"500ms"`, `"30s"`, `"5m"`, `"1h"`, or a number of seconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Time(pub Duration);

impl Time {
    pub(super) const fn seconds(seconds: u64) -> Time {
        Time(Duration::from_secs(seconds))
    }

    fn parse(text: &str) -> Option<Time> {
        let text = text.trim();
        let number_ends = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
        let (number, unit) = text.split_at(number_ends);
        let number: f64 = number.parse().ok()?;
        let factor = match unit.trim() {
            "ms" => 0.001,
            "s" | "" => 1.0,
            "m" | "min" => 60.0,
            "h" => 3600.0,
            "d" => 86_400.0,
            _ => return None,
        };
        Duration::try_from_secs_f64(number * factor).ok().map(Time)
    }
}

impl<'de> Deserialize<'de> for Time {
    fn deserialize<D: Deserializer<'de>>(source: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Written {
            Number(f64),
            Text(String),
        }
        let written = match Written::deserialize(source)? {
            Written::Number(seconds) => seconds.to_string(),
            Written::Text(text) => text,
        };
        Time::parse(&written).ok_or_else(|| {
            serde::de::Error::custom(format!(
                "{written:?} is not a duration; write a number with ms, s, m or h, such as \"30s\""
            ))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    #[test]
    fn durations_are_read_as_people_write_them() {
        let config =
            Config::parse("[servant]\ngrace = \"500ms\"\nstart = 5\n[portal]\ndrain = \"1.5m\"").expect("valid");
        assert_eq!(config.servant.grace.0, Duration::from_millis(500));
        assert_eq!(config.servant.start.0, Duration::from_secs(5));
        assert_eq!(config.portal.drain.0, Duration::from_secs(90));
        let refused = Config::parse("[servant]\ngrace = \"soon\"").expect_err("no duration").to_string();
        assert!(refused.contains("\"soon\" is not a duration"), "{refused}");
        Config::parse("[servant]\ngrace = \"-1s\"").expect_err("negative");
    }
}
