//! Reading what strangers have written in files that only root may read: sources of a push, what a build has left, layers.

use std::thread;

use crate::confine::confine_to_reading;
use crate::engine::is_engines;

/// Does `work` on a thread of its own that may read every file and do nothing else: of all capabilities it has
/// CAP_DAC_READ_SEARCH alone, and it has the ids of the threads that have no rights. To be called on the engine's threads, which wait; on others `work` is done where it is called.
///
/// # Panics
/// As `work` does; and where no such thread can be had, since no other may read that.
pub fn reading<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    let Some(account) = is_engines() else {
        return work();
    };
    let done = thread::scope(|scope| {
        let reader = thread::Builder::new().name("reader".into());
        let reader = reader.spawn_scoped(scope, || confine_to_reading(account).map(|()| work()));
        let reader = reader.unwrap_or_else(|error| panic!("no thread can be started: {error}"));
        reader
            .join()
            .unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    });
    done.unwrap_or_else(|error| panic!("{error}"))
}
