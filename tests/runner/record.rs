//! Durations of the stories in the last run on this machine, so that the longest run first. A cache: without it stories
//! run in the order of the list.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use super::StoryOutcome;

/// Seconds by story name.
pub(super) struct StoryTimes(BTreeMap<String, f64>);

impl StoryTimes {
    pub(super) fn read() -> StoryTimes {
        let text = std::fs::read_to_string(times_path()).unwrap_or_default();
        StoryTimes(serde_json::from_str(&text).unwrap_or_default())
    }

    /// Returns the expected duration of a story, a long one if it has never run.
    pub(super) fn expected_time(&self, story: &str) -> Duration {
        let seconds = self.0.get(story).copied().unwrap_or(f64::MAX);
        Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX)
    }

    /// Adds the durations of this run and writes the file.
    pub(super) fn update(mut self, outcomes: &[StoryOutcome]) {
        let good = outcomes.iter().filter(|outcome| outcome.failure.is_none());
        self.0.extend(good.map(|outcome| {
            let worked = outcome.took.saturating_sub(outcome.waited);
            (outcome.name.to_owned(), worked.as_secs_f64())
        }));
        let path = times_path();
        let half = path.with_extension(format!("half-{}", std::process::id()));
        if let Ok(text) = serde_json::to_string_pretty(&self.0)
            && std::fs::write(&half, text).is_ok()
        {
            let _ = std::fs::rename(&half, &path);
        }
    }
}

fn times_path() -> PathBuf {
    support::binaries::cache().join("stories.json")
}
