//! `[black_box]`: what of servants is kept for when something goes wrong.

use std::time::Duration;

use anyhow::bail;
use api::Size;
use portal::BlackBoxOptions;
use serde::Deserialize;

use super::Time;

/// Longer than this is a recording (`cloudroidctl record`).
const LONGEST: Duration = Duration::from_secs(3600);

/// The last seconds of what flows in servants.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BlackBox {
    /// So much of each servant; 0: nothing.
    pub seconds: Time,
    /// Bytes of each servant's messages.
    pub memory: Size,
    /// Topics, or beginnings of topics before a last `*`.
    pub topics: Vec<String>,
    /// Files at most.
    pub files: u64,
    /// Bytes of all files at most.
    pub disk: Size,
}

impl Default for BlackBox {
    fn default() -> Self {
        BlackBox {
            seconds: Time::seconds(0),
            memory: Size(64 << 20),
            topics: vec!["*".to_owned()],
            files: 100,
            disk: Size(10 << 30),
        }
    }
}

impl BlackBox {
    /// As the portal has it.
    pub fn options(&self) -> BlackBoxOptions {
        BlackBoxOptions {
            span: self.seconds.0,
            memory: usize::try_from(self.memory.0).unwrap_or(usize::MAX),
            topics: self.topics.clone(),
            files: usize::try_from(self.files).unwrap_or(usize::MAX),
            disk: self.disk.0,
        }
    }

    /// `servant`: what one servant's messages may hold, all together.
    pub(super) fn check(&self, servant: Size) -> anyhow::Result<()> {
        if self.seconds.0 > LONGEST {
            bail!(
                "seconds is more than an hour; for longer times there is cloudroidctl record SERVANT -o FILE"
            );
        }
        if self.memory.0 == 0 || self.files == 0 || self.disk.0 == 0 {
            bail!(
                "memory, files or disk of 0 would keep nothing; to keep nothing, write seconds = 0"
            );
        }
        if self.memory.0 > servant.0 {
            bail!(
                "memory = \"{}\" is more than a servant may hold, which is \"{}\" (servant of [memory])",
                self.memory,
                servant
            );
        }
        if let Some(topic) = self.topics.iter().find(|topic| !is_pattern(topic)) {
            bail!(
                "{topic:?} is no topic; write one that begins with \"/\", one with a \"*\" at its end, or \"*\" for all"
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
            let read = toml::from_str::<BlackBox>(text).expect("well-formed");
            read.check(Size(256 << 20))
                .map_err(|refused| refused.to_string())
        };
        assert_eq!(check(""), Ok(()));
        assert_eq!(
            check("seconds = \"30s\"\ntopics = [\"/tf\", \"/camera/*\"]"),
            Ok(())
        );
        for (text, expected) in [
            ("seconds = \"2h\"", "more than an hour"),
            ("memory = 0", "keep nothing"),
            ("files = 0", "keep nothing"),
            ("memory = \"1G\"", "more than a servant may hold"),
            ("topics = [\"tf\"]", "\"tf\" is no topic"),
            ("topics = [\"/a*b*\"]", "is no topic"),
        ] {
            let refused = check(text).expect_err(text);
            assert!(refused.contains(expected), "{refused}");
        }
    }
}
