//! How long stories took last time on this machine, so that the longest are told first. A cache: without it the order is that of the list.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use super::Outcome;

/// Seconds, by a story's name.
pub(super) struct Record(BTreeMap<String, f64>);

impl Record {
    pub(super) fn read() -> Record {
        let text = std::fs::read_to_string(path()).unwrap_or_default();
        Record(serde_json::from_str(&text).unwrap_or_default())
    }

    /// How long a story is expected to take. One that was never told may take long.
    pub(super) fn expected(&self, story: &str) -> Duration {
        let seconds = self.0.get(story).copied().unwrap_or(f64::MAX);
        Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX)
    }

    /// Keeps what was measured now beside what is known of other stories.
    pub(super) fn write(mut self, outcomes: &[Outcome]) {
        let good = outcomes.iter().filter(|outcome| outcome.failure.is_none());
        self.0.extend(good.map(|outcome| {
            let worked = outcome.took.saturating_sub(outcome.waited);
            (outcome.name.to_owned(), worked.as_secs_f64())
        }));
        let path = path();
        let half = path.with_extension(format!("half-{}", std::process::id()));
        if let Ok(text) = serde_json::to_string_pretty(&self.0)
            && std::fs::write(&half, text).is_ok()
        {
            let _ = std::fs::rename(&half, &path);
        }
    }
}

fn path() -> PathBuf {
    support::binaries::cache().join("stories.json")
}
