//! Reading what strangers have written in files that only root may read: sources of a push, what a build has left, layers.

use std::thread::{self, Scope, ScopedJoinHandle};

use crate::confine::confine_to_reading;
use crate::engine::is_engines;

/// Does `work` on a thread of its own that may read every file and do nothing else: of all capabilities it has
/// CAP_DAC_READ_SEARCH alone, and it has the ids of the threads that have no rights. To be called on the engine's threads, which wait; on
/// others `work` is done where it is called.
///
/// # Panics
/// As `work` does; and where no such thread can be had, since no other may read that.
pub fn reading<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    if is_engines().is_none() {
        return work();
    }
    thread::scope(|scope| {
        let reader = reading_beside(scope, work);
        reader
            .join()
            .unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

/// Begins `work` on such a thread, beside the calling one. Where that is not the engine's, the new thread has the rights that it has.
///
/// # Panics
/// Where no thread can be had; the thread does where its rights cannot be taken from it.
pub fn reading_beside<'scope, T: Send + 'scope>(
    scope: &'scope Scope<'scope, '_>,
    work: impl FnOnce() -> T + Send + 'scope,
) -> ScopedJoinHandle<'scope, T> {
    let account = is_engines();
    let reader = thread::Builder::new().name("reader".into());
    let reader = reader.spawn_scoped(scope, move || {
        if let Some(account) = account {
            confine_to_reading(account).unwrap_or_else(|error| panic!("{error}"));
        }
        work()
    });
    reader.unwrap_or_else(|error| panic!("no thread can be started: {error}"))
}
