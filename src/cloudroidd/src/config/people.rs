//! `[people]`: how long who has signed in stays so.

use std::time::Duration;

use anyhow::bail;
use portal::Lasting;
use serde::Deserialize;

use super::Time;

/// The shortest that either may be: uses are written to the disk to the minute.
const SHORTEST: Duration = Duration::from_secs(120);
/// And the longest, which browsers keep no cookie beyond (RFC 6265bis, section 5.5).
const LONGEST: Duration = Duration::from_secs(400 * 86_400);

/// People's sessions.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct People {
    /// After which a session ends, whatever is done.
    pub session: Time,
    /// After which it ends where nothing is asked.
    pub idle: Time,
}

impl Default for People {
    fn default() -> Self {
        let Lasting { most, idle } = Lasting::default();
        People {
            session: Time(most),
            idle: Time(idle),
        }
    }
}

impl People {
    /// As the portal has it.
    pub fn lasting(&self) -> Lasting {
        Lasting {
            most: self.session.0,
            idle: self.idle.0,
        }
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
        let read = |text: &str| toml::from_str::<People>(text).expect("well-formed");
        read("session = \"8h\"\nidle = \"10m\"")
            .check()
            .expect("good");
        read("").check().expect("the default");
        for text in ["session = 0", "idle = \"1s\"", "session = \"20000h\""] {
            let refused = read(text).check().expect_err(text).to_string();
            assert!(refused.contains("is not between"), "{refused}");
        }
    }
}
