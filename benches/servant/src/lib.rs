//! What benches of the whole running system share: a daemon with a home of its own, and pushes to it whose events are
//! timed as they arrive.

#![forbid(unsafe_code)]

mod daemon;
mod push;
mod space;

pub use daemon::{Daemon, binary};
pub use push::Pushed;
pub use space::space;

/// Whether there is time for the long form: `CLOUDROID_BENCH_FULL=1`.
pub fn full() -> bool {
    std::env::var_os("CLOUDROID_BENCH_FULL").is_some_and(|value| !value.is_empty() && value != "0")
}
