//! `[logs]`: logs that are kept of ended servants.

use anyhow::bail;
use api::Size;
use choreographer::{KeptLogOptions, Quota};
use serde::Deserialize;

use super::Time;

/// Least size of all logs: that of one servant, which is rotated once.
const MIN_TOTAL: u64 = 2 * servant::logs::ROTATE_AT;

/// Logs of ended servants.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LogsConfig {
    /// Time for which a log is kept after the end of its servant; 0 keeps none.
    pub keep: Time,
    /// Largest number of logs.
    pub servants: u64,
    /// Largest size of all logs together, in bytes.
    pub disk: Size,
}

impl Default for LogsConfig {
    fn default() -> Self {
        LogsConfig { keep: Time::seconds(14 * 86_400), servants: 1000, disk: Size(512 << 20) }
    }
}

impl LogsConfig {
    /// Returns the options as the choreographer takes them.
    pub fn options(&self) -> KeptLogOptions {
        let files = usize::try_from(self.servants).unwrap_or(usize::MAX);
        KeptLogOptions { age: self.keep.0, quota: Quota { files, bytes: self.disk.0 } }
    }

    /// Checks the values.
    pub(super) fn check(&self) -> anyhow::Result<()> {
        if self.servants == 0 || self.disk.0 < MIN_TOTAL {
            bail!(
                "servants must be at least 1 and disk at least {}, the size of one log; for no logs write keep = 0",
                Size(MIN_TOTAL)
            );
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quota_without_room_for_one_log_is_refused() {
        let check = |text: &str| toml::from_str::<LogsConfig>(text).expect("well-formed").check();
        for text in ["", "keep = 0", "keep = \"30d\"\nservants = 1\ndisk = \"32M\""] {
            check(text).expect(text);
        }
        for text in ["servants = 0", "disk = \"31M\""] {
            let refused = check(text).expect_err(text).to_string();
            assert!(refused.contains("disk at least 32M"), "{refused}");
        }
    }
}
