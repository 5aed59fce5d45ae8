//! Separation of the daemon's threads by privilege. Linux keeps capabilities, user ids and groups per thread
//! (capabilities(7), credentials(7)); a thread inherits those of the thread that starts it.
//!
//! ```text
//!   portal's threads: HTTP, WebSocket, bridge,       engine's threads: containers, image store,
//!   links, buses, choreographer, database            builds, files below the home
//!     no capability, a user of their own     ──run, spawn_blocking, run_sync──▶ root, `KEPT_CAPABILITIES`
//!                                                                   └─run_as_reader─▶ a reader: reads every file
//! ```
//!
//! Code that needs root's files or a capability is handed to the engine's threads by [`run`], [`spawn_blocking`] or
//! [`run_sync`]. These have untrusted files read by a thread that can do nothing else ([`run_as_reader`]). In programs
//! without engine threads (tests, tools) all four do the work where they are called.

mod confine;
mod engine;
mod reading;

pub use confine::{Account, DEFAULT_USER, KEPT_CAPABILITIES, confine, limit_capabilities, retain_capabilities};
pub use engine::{Engine, Task, confined_account, run, run_sync, spawn_blocking};
pub use reading::{run_as_reader, spawn_reader};

/// A failure to give a thread its intended privileges.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A capability could not be dropped.
    #[error("cannot {action}: {source}")]
    Capabilities {
        /// Operation that failed.
        action: &'static str,
        /// Error of the kernel.
        source: caps::errors::CapsError,
    },
    /// The user or the groups could not be changed.
    #[error(
        "a thread cannot become user {user} and group {group}: {source}; name another with portal_user in the \
         configuration"
    )]
    Account {
        /// User id.
        user: u32,
        /// Group id.
        group: u32,
        /// Error of the kernel.
        source: std::io::Error,
    },
    /// The kernel reports privileges beyond those asked for.
    #[error("a thread that was to have no rights has {left}")]
    Left {
        /// Description of the remaining privileges.
        left: String,
    },
    /// No such user exists, or it cannot be used.
    #[error("portal_user = {written:?} is not a user of this machine, nor the number of one other than root")]
    Unknown {
        /// Value in the configuration.
        written: String,
    },
    /// The threads could not be started.
    #[error("cannot start the engine's threads: {0}")]
    Threads(std::io::Error),
}
