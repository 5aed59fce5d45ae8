//! Observers by servant, and how often recordings of a servant may be written.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use choreographer::Handle;
use observe::{BlackBox, GoalMonitor};
use parking_lot::Mutex;
use tokio::time::Instant;
use tokio_util::task::AbortOnDropHandle;

use crate::errors::Error;

/// Minimum interval between two automatic recordings of a servant.
const PAUSE: Duration = Duration::from_secs(60);
/// Minimum interval between two requested recordings of a servant.
const RECORDING_INTERVAL: Duration = Duration::from_secs(5);

/// Black box settings of the configuration.
#[derive(Debug, Clone)]
pub struct BlackBoxOptions {
    /// Age up to which messages are kept; zero disables black boxes.
    pub span: Duration,
    /// Memory limit per servant in bytes, including the overhead per message.
    pub memory: usize,
    /// Topics to record: names, or prefixes ending in `*`.
    pub topics: Vec<String>,
    /// Maximum number of files; beyond it, the service with most files loses its oldest.
    pub files: usize,
    /// Maximum size of all files in bytes.
    pub disk: u64,
}

impl BlackBoxOptions {
    pub(super) fn matches_topic(&self, topic: &str) -> bool {
        self.topics.iter().any(|pattern| match pattern.strip_suffix('*') {
            Some(begins) => topic.starts_with(begins),
            None => topic == pattern,
        })
    }
}

/// Observers of all servants.
#[derive(Default)]
pub struct Observers {
    pub(super) all: Mutex<HashMap<String, ServantObservers>>,
    /// Time of the last automatic recording, by servant or, for nameless robots, by service, because each of their
    /// connections has a servant of its own.
    written: Mutex<HashMap<String, Instant>>,
    /// Held while a file is written: which files are removed for it depends on those that exist.
    pub(crate) writing: tokio::sync::Mutex<()>,
}

/// Observers of a servant.
#[derive(Default)]
pub(super) struct ServantObservers {
    pub(super) kept: Option<Arc<BlackBox>>,
    pub(super) goals: Option<Arc<GoalMonitor>>,
    /// Time of the last requested recording.
    pub(super) taken: Option<Instant>,
    /// Task that joins the servant's ROS; aborted when dropped.
    pub(super) _joining: Option<AbortOnDropHandle<()>>,
}

impl Observers {
    /// Returns the black box of a servant.
    pub(crate) fn black_box(&self, servant: &str) -> Option<Arc<BlackBox>> {
        self.all.lock().get(servant)?.kept.clone()
    }

    /// Returns the goal monitor of a servant; `None` if the servant has no actions.
    pub(crate) fn goals(&self, servant: &str) -> Option<Arc<GoalMonitor>> {
        self.all.lock().get(servant)?.goals.clone()
    }

    /// Refuses requests for recordings of this servant that follow too closely.
    pub(crate) fn check_take(&self, servant: &str) -> Result<(), Error> {
        let mut all = self.all.lock();
        let observed = all.get_mut(servant).filter(|one| one.kept.is_some());
        let Some(observed) = observed else {
            return Err(Error::NoBlackBox(servant.to_owned()));
        };
        match remaining(observed.taken, RECORDING_INTERVAL) {
            Some(left) => Err(Error::RecordedLately { servant: servant.to_owned(), again: left.as_secs() + 1 }),
            None => {
                observed.taken = Some(Instant::now());
                Ok(())
            }
        }
    }

    /// Returns true if an automatic recording of this servant may be written; the next one may be a minute later.
    pub(super) fn is_due(&self, handle: &Handle) -> bool {
        // Without a black box there is nothing to write.
        let is_heard = self.black_box(&handle.id).is_some();
        let whose =
            if handle.robot.starts_with('~') { format!("service {}", handle.service()) } else { handle.id.clone() };
        is_heard && claim_interval(&mut self.written.lock(), whose)
    }
}

/// Returns the time left until something may be done again, if any.
fn remaining(last: Option<Instant>, pause: Duration) -> Option<Duration> {
    let left = pause.checked_sub(last?.elapsed())?;
    (!left.is_zero()).then_some(left)
}

/// Returns true if the last recording is long enough ago, and marks a new one.
fn claim_interval(written: &mut HashMap<String, Instant>, whose: String) -> bool {
    written.retain(|_, last| remaining(Some(*last), PAUSE).is_some());
    let is_due = !written.contains_key(&whose);
    if is_due {
        written.insert(whose, Instant::now());
    }
    is_due
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn files_that_nobody_asked_for_are_a_minute_apart() {
        let mut written = HashMap::new();
        let mut is_due = |whose: &str| claim_interval(&mut written, whose.to_owned());
        assert!(is_due("s1") && is_due("s2") && !is_due("s1"));
        tokio::time::advance(PAUSE / 2).await;
        assert!(!is_due("s1") && is_due("s3"));
        tokio::time::advance(PAUSE / 2).await;
        assert!(is_due("s1") && !is_due("s3"));
        // Expired entries are removed.
        assert_eq!(written.len(), 2);
    }

    #[tokio::test(start_paused = true)]
    async fn whoever_asks_for_files_again_and_again_waits() {
        assert_eq!(remaining(None, RECORDING_INTERVAL), None);
        let now = Some(Instant::now());
        assert_eq!(remaining(now, RECORDING_INTERVAL), Some(RECORDING_INTERVAL));
        tokio::time::advance(RECORDING_INTERVAL).await;
        assert_eq!(remaining(now, RECORDING_INTERVAL), None);
        let observers = Observers::default();
        let refused = observers.check_take("s1").expect_err("nothing is kept");
        assert!(matches!(refused, Error::NoBlackBox(_)), "{refused}");
    }
}
