//! The story that a thread tells: what it has made, so that this can be kept when it fails, and how long it waited for others.

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// One telling of a story.
#[derive(Debug)]
pub struct Telling {
    /// The story's name.
    pub name: &'static str,
    /// Where the evidence of a failure is kept.
    pub evidence: PathBuf,
    /// Counted from 1.
    pub attempt: usize,
    made: Mutex<Made>,
}

#[derive(Debug, Default)]
struct Made {
    homes: Vec<PathBuf>,
    directories: Vec<PathBuf>,
    waited: Duration,
}

thread_local! {
    static CURRENT: RefCell<Option<Arc<Telling>>> = const { RefCell::new(None) };
}

impl Telling {
    /// A telling whose evidence is kept in the directory `evidence`.
    pub fn new(name: &'static str, attempt: usize, evidence: PathBuf) -> Arc<Telling> {
        Arc::new(Telling {
            name,
            evidence,
            attempt,
            made: Mutex::default(),
        })
    }

    /// Homes of the daemons that the story started.
    pub fn homes(&self) -> Vec<PathBuf> {
        self.made().homes.clone()
    }

    /// Directories that the story made.
    pub fn directories(&self) -> Vec<PathBuf> {
        self.made().directories.clone()
    }

    /// How long the story waited for cores that others' work took up.
    pub fn waited(&self) -> Duration {
        self.made().waited
    }

    fn made(&self) -> std::sync::MutexGuard<'_, Made> {
        self.made.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Makes this thread the one that tells a story.
pub fn begin(telling: Arc<Telling>) {
    CURRENT.set(Some(telling));
}

/// The story that this thread tells; none in a thread that a story has started itself.
pub fn current() -> Option<Arc<Telling>> {
    CURRENT.with_borrow(Clone::clone)
}

/// Tells if this thread tells a story that has failed once.
pub(crate) fn is_told_again() -> bool {
    current().is_some_and(|telling| telling.attempt > 1)
}

/// Notes a daemon's home.
pub(crate) fn add_home(home: &Path) {
    if let Some(telling) = current() {
        telling.made().homes.push(home.to_owned());
    }
}

/// Notes a directory. Returns if it is a story's, which is removed with it.
pub(crate) fn add_directory(directory: &Path) -> bool {
    let telling = current();
    if let Some(telling) = &telling {
        telling.made().directories.push(directory.to_owned());
    }
    telling.is_some()
}

/// Adds to the time that the story has waited for others.
pub(crate) fn add_wait(time: Duration) {
    if let Some(telling) = current() {
        telling.made().waited += time;
    }
}
