//! Cancels blocking work.
//!
//! Packing, hashing and extracting run for minutes on threads of their own, several calls deep. Whoever starts such a
//! thread runs the work under a [`Cancel`]; the loops in it call [`check`], which reads the `Cancel` of the current thread.

use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

thread_local! {
    static CURRENT: RefCell<Option<Cancel>> = const { RefCell::new(None) };
}

/// A flag that cancels work. Clones share the flag.
#[derive(Debug, Clone, Default)]
pub struct Cancel(Arc<AtomicBool>);

/// Cancels when it is dropped.
#[derive(Debug)]
#[must_use = "dropping it cancels"]
pub struct CancelOnDrop(Cancel);

/// The error of cancelled work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("it was cancelled")]
pub struct Cancelled;

impl From<Cancelled> for std::io::Error {
    fn from(cancelled: Cancelled) -> Self {
        // Not `Interrupted`: that is tried again.
        std::io::Error::other(cancelled)
    }
}

impl Cancel {
    /// From now on [`check`] fails in all work under it.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether it was cancelled.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// A guard that cancels when it is dropped.
    pub fn on_drop(&self) -> CancelOnDrop {
        CancelOnDrop(self.clone())
    }

    /// Does `work` on this thread, under this flag. Afterwards the thread has the flag that it had before.
    pub fn during<T>(&self, work: impl FnOnce() -> T) -> T {
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

/// The flag that the current thread works under, for threads that it starts to work under it, too.
pub fn current() -> Option<Cancel> {
    CURRENT.with_borrow(Option::clone)
}

/// Fails if the work of the current thread was cancelled.
pub fn check() -> Result<(), Cancelled> {
    let cancelled =
        CURRENT.with_borrow(|current| current.as_ref().is_some_and(Cancel::is_cancelled));
    if cancelled { Err(Cancelled) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_hears_of_its_own_cancellation_only() {
        let (outer, inner) = (Cancel::default(), Cancel::default());
        outer.during(|| {
            let gone = inner.on_drop();
            inner.during(|| {
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
