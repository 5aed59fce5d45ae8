//! `[people]`: lifetime of people's sessions.

use std::time::Duration;

use anyhow::bail;
use portal::SessionLifetimes;
use serde::Deserialize;

use super::Time;

/// Shortest lifetime of either kind: the time of last use is stored with a resolution of one minute.
const SHORTEST: Duration = Duration::from_secs(120);
/// Longest lifetime of either kind: browsers keep no cookie longer (RFC 6265bis, section 5.5).
const LONGEST: Duration = Duration::from_secs(400 * 86_400);

/// Lifetimes of people's sessions.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PeopleConfig {
    /// Time after which a session ends, however active it is.
    pub session: Time,
    /// Time without requests after which a session ends.
    pub idle: Time,
}

impl Default for PeopleConfig {
    fn default() -> Self {
        let SessionLifetimes { most, idle } = SessionLifetimes::default();
        PeopleConfig { session: Time(most), idle: Time(idle) }
    }
}

impl PeopleConfig {
    /// Returns the lifetimes as the portal takes them.
    pub fn session_lifetimes(&self) -> SessionLifetimes {
        SessionLifetimes { most: self.session.0, idle: self.idle.0 }
    }

    pub(super) fn check(&self) -> anyhow::Result<()> {
        for (name, time) in [("session", self.session.0), ("idle", self.idle.0)] {
            if !(SHORTEST..=LONGEST).contains(&time) {
                bail!("{name} is not between 2m and 9600h; write a time such as \"12h\"");
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_that_make_no_sense_are_refused() {
        let read = |text: &str| toml::from_str::<PeopleConfig>(text).expect("well-formed");
        read("session = \"8h\"\nidle = \"10m\"").check().expect("good");
        read("").check().expect("the default");
        for text in ["session = 0", "idle = \"1s\"", "session = \"20000h\""] {
            let refused = read(text).check().expect_err(text).to_string();
            assert!(refused.contains("is not between"), "{refused}");
        }
    }
}
