//! `[black_box]`: recording of the last seconds of servants, kept for when something goes wrong.

use std::time::Duration;

use anyhow::bail;
use api::Size;
use portal::BlackBoxOptions;
use serde::Deserialize;

use super::Time;

/// Longest time that is kept; for longer times there are recordings (`cloudroidctl record`).
const LONGEST: Duration = Duration::from_secs(3600);

/// The last seconds of the messages in servants.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BlackBoxConfig {
    /// Time that is kept of each servant; 0 disables the recording.
    pub seconds: Time,
    /// Memory for each servant's messages, in bytes.
    pub memory: Size,
    /// Topics, or prefixes of topics that end with `*`.
    pub topics: Vec<String>,
    /// Largest number of files.
    pub files: u64,
    /// Largest size of all files together, in bytes.
    pub disk: Size,
}

impl Default for BlackBoxConfig {
    fn default() -> Self {
        BlackBoxConfig {
            seconds: Time::seconds(0),
            memory: Size(64 << 20),
            topics: vec!["*".to_owned()],
            files: 100,
            disk: Size(10 << 30),
        }
    }
}

impl BlackBoxConfig {
    /// Returns the options as the portal takes them.
    pub fn options(&self) -> BlackBoxOptions {
        BlackBoxOptions {
            span: self.seconds.0,
            memory: usize::try_from(self.memory.0).unwrap_or(usize::MAX),
            topics: self.topics.clone(),
            files: usize::try_from(self.files).unwrap_or(usize::MAX),
            disk: self.disk.0,
        }
    }

    /// Checks the values. `servant` is the memory limit of one servant's messages.
    pub(super) fn check(&self, servant: Size) -> anyhow::Result<()> {
        if self.seconds.0 > LONGEST {
            bail!("seconds is more than an hour; for longer recordings use cloudroidctl record SERVANT -o FILE");
        }
        if self.memory.0 == 0 || self.files == 0 || self.disk.0 == 0 {
            bail!("memory, files or disk of 0 would record nothing; to turn recording off, write seconds = 0");
        }
        if self.memory.0 > servant.0 {
            bail!(
                "memory = \"{}\" is more than the limit per servant, \"{}\" (servant of [memory])",
                self.memory,
                servant
            );
        }
        if let Some(topic) = self.topics.iter().find(|topic| !is_pattern(topic)) {
            bail!(
                "{topic:?} is not a topic; write a name that begins with \"/\", a prefix that ends with \"*\", \
                    or \"*\" for all"
            );
        }
        Ok(())
    }
}

fn is_pattern(topic: &str) -> bool {
    let begins = topic.strip_suffix('*').unwrap_or(topic);
    topic == "*" || (begins.starts_with('/') && !begins.contains('*'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_makes_no_sense_is_refused() {
        let check = |text: &str| {
            let read = toml::from_str::<BlackBoxConfig>(text).expect("well-formed");
            read.check(Size(256 << 20)).map_err(|refused| refused.to_string())
        };
        assert_eq!(check(""), Ok(()));
        assert_eq!(check("seconds = \"30s\"\ntopics = [\"/tf\", \"/camera/*\"]"), Ok(()));
        for (text, expected) in [
            ("seconds = \"2h\"", "more than an hour"),
            ("memory = 0", "record nothing"),
            ("files = 0", "record nothing"),
            ("memory = \"1G\"", "more than the limit per servant"),
            ("topics = [\"tf\"]", "\"tf\" is not a topic"),
            ("topics = [\"/a*b*\"]", "is not a topic"),
        ] {
            let refused = check(text).expect_err(text);
            assert!(refused.contains(expected), "{refused}");
        }
    }
}
