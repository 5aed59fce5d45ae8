//! The story that runs on a thread: the things it created, so that they can be kept when it fails, and how long it
//! waited for others.

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// One run of a story.
#[derive(Debug)]
pub struct StoryRun {
    /// Name of the story.
    pub name: &'static str,
    /// Directory for the evidence of a failure.
    pub evidence: PathBuf,
    /// Counted from 1.
    pub attempt: usize,
    made: Mutex<StoryArtifacts>,
}

#[derive(Debug, Default)]
struct StoryArtifacts {
    homes: Vec<PathBuf>,
    directories: Vec<PathBuf>,
    waited: Duration,
}

thread_local! {
    static CURRENT: RefCell<Option<Arc<StoryRun>>> = const { RefCell::new(None) };
}

impl StoryRun {
    /// Creates a run with the directory `evidence` for its evidence.
    pub fn new(name: &'static str, attempt: usize, evidence: PathBuf) -> Arc<StoryRun> {
        Arc::new(StoryRun { name, evidence, attempt, made: Mutex::default() })
    }

    /// Returns the homes of the daemons that the story started.
    pub fn homes(&self) -> Vec<PathBuf> {
        self.artifacts().homes.clone()
    }

    /// Returns the directories that the story created.
    pub fn directories(&self) -> Vec<PathBuf> {
        self.artifacts().directories.clone()
    }

    /// Returns how long the story waited for cores that other stories used.
    pub fn waiting_time(&self) -> Duration {
        self.artifacts().waited
    }

    fn artifacts(&self) -> std::sync::MutexGuard<'_, StoryArtifacts> {
        self.made.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Makes this thread the one that runs a story.
pub fn begin(telling: Arc<StoryRun>) {
    CURRENT.set(Some(telling));
}

/// Returns the story of this thread; `None` on threads that a story has started itself.
pub fn current() -> Option<Arc<StoryRun>> {
    CURRENT.with_borrow(Clone::clone)
}

/// Returns whether this thread repeats a story that has failed once.
pub(crate) fn is_repeated() -> bool {
    current().is_some_and(|telling| telling.attempt > 1)
}

/// Records a daemon's home.
pub(crate) fn add_home(home: &Path) {
    if let Some(telling) = current() {
        telling.artifacts().homes.push(home.to_owned());
    }
}

/// Records a directory. Returns whether it belongs to a story, with which it is removed.
pub(crate) fn add_directory(directory: &Path) -> bool {
    let telling = current();
    if let Some(telling) = &telling {
        telling.artifacts().directories.push(directory.to_owned());
    }
    telling.is_some()
}

/// Adds to the time that the story has waited for others.
pub(crate) fn add_wait(time: Duration) {
    if let Some(telling) = current() {
        telling.artifacts().waited += time;
    }
}
