//! Reading of untrusted content in files that only root may read: pushed sources, build output, layers.

use std::thread::{self, Scope, ScopedJoinHandle};

use crate::confine::confine_to_reading;
use crate::engine::account_on_engine;

/// Runs `work` on a dedicated thread that may read every file and do nothing else: its only capability is
/// CAP_DAC_READ_SEARCH, and its ids are those of the confined threads. Must be called on the engine's threads, which
/// wait; on other threads `work` runs where it is called.
///
/// # Panics
/// Panics if `work` does, and if no such thread can be started, since no other may read the content.
pub fn run_as_reader<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    if account_on_engine().is_none() {
        return work();
    }
    thread::scope(|scope| {
        let reader = spawn_reader(scope, work);
        reader.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

/// Starts `work` on such a thread, beside the calling one. If the calling thread is not the engine's, the new thread
/// has the privileges of the caller.
///
/// # Panics
/// Panics if no thread can be started; the new thread panics if its privileges cannot be dropped.
pub fn spawn_reader<'scope, T: Send + 'scope>(
    scope: &'scope Scope<'scope, '_>,
    work: impl FnOnce() -> T + Send + 'scope,
) -> ScopedJoinHandle<'scope, T> {
    let account = account_on_engine();
    let reader = thread::Builder::new().name("reader".into());
    let reader = reader.spawn_scoped(scope, move || {
        if let Some(account) = account {
            confine_to_reading(account).unwrap_or_else(|error| panic!("{error}"));
        }
        work()
    });
    reader.unwrap_or_else(|error| panic!("no thread can be started: {error}"))
}
