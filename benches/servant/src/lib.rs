//! Common parts of benchmarks of the whole system: a daemon with a home of its own, and pushes to it with timed events.

#![forbid(unsafe_code)]

mod daemon;
mod push;
mod space;

pub use daemon::{Daemon, binary};
pub use push::TimedPush;
pub use space::write_install_space;

/// Returns whether longer measurements are requested (`CLOUDROID_BENCH_FULL=1`).
pub fn is_full_run() -> bool {
    std::env::var_os("CLOUDROID_BENCH_FULL").is_some_and(|value| !value.is_empty() && value != "0")
}
