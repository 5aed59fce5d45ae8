//! Cancellation of blocking work.
//!
//! Packing, hashing and extracting run for minutes on their own threads, several calls deep. The caller that starts
//! such a thread runs the work with [`Cancel::run`]; its loops call [`check`], which reads the `Cancel` of the current
//! thread.

use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

thread_local! {
    static CURRENT: RefCell<Option<Cancel>> = const { RefCell::new(None) };
}

/// A cancellation flag. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct Cancel(Arc<AtomicBool>);

/// Guard that cancels the work when it is dropped.
#[derive(Debug)]
#[must_use = "dropping it cancels"]
pub struct CancelOnDrop(Cancel);

/// Error of work that was cancelled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("it was cancelled")]
pub struct Cancelled;

impl From<Cancelled> for std::io::Error {
    fn from(cancelled: Cancelled) -> Self {
        // Not `Interrupted`, since callers retry that.
        std::io::Error::other(cancelled)
    }
}

impl Cancel {
    /// Cancels: from now on [`check`] fails in all work that runs with this flag.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Returns whether it was cancelled.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// Returns a guard that cancels when it is dropped.
    pub fn drop_guard(&self) -> CancelOnDrop {
        CancelOnDrop(self.clone())
    }

    /// Runs `work` on this thread with this flag, and restores the thread's previous flag afterwards.
    pub fn run<T>(&self, work: impl FnOnce() -> T) -> T {
        struct Restore(Option<Cancel>);
        impl Drop for Restore {
            fn drop(&mut self) {
                CURRENT.replace(self.0.take());
            }
        }
        let _restore = Restore(CURRENT.replace(Some(self.clone())));
        work()
    }
}

impl Drop for CancelOnDrop {
    fn drop(&mut self) {
        self.0.cancel();
    }
}

/// Returns the flag of the current thread, to be passed on to threads that it starts.
pub fn current() -> Option<Cancel> {
    CURRENT.with_borrow(Option::clone)
}

/// Fails if the current thread's work was cancelled.
pub fn check() -> Result<(), Cancelled> {
    let cancelled = CURRENT.with_borrow(|current| current.as_ref().is_some_and(Cancel::is_cancelled));
    if cancelled { Err(Cancelled) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_hears_of_its_own_cancellation_only() {
        let (outer, inner) = (Cancel::default(), Cancel::default());
        outer.run(|| {
            let gone = inner.drop_guard();
            inner.run(|| {
                assert_eq!(check(), Ok(()));
                let current = current().expect("this one");
                drop(gone);
                assert_eq!(check(), Err(Cancelled));
                assert!(current.is_cancelled());
            });
            assert_eq!(check(), Ok(()));
        });
        inner.cancel();
        assert_eq!(check(), Ok(()));
    }
}
