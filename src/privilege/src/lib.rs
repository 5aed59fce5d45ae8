//! Which threads of the daemon may do what. Linux keeps capabilities, user ids and groups per thread (capabilities(7),
//! credentials(7)); a thread that is started inherits those of the thread that starts it.
//!
//! ```text
//!   portal's threads: HTTP, WebSocket, bridge,       engine's threads: containers, image store,
//!   links, buses, choreographer, database            builds, files below the home
//!     no capability, a user of their own     ──run, blocking, now──▶   root, the capabilities in `KEPT`
//!                                                                       └─reading─▶ a reader: may read every file, no more
//! ```
//!
//! Code that needs root's files or a capability is handed to the engine's threads by [`run`], [`blocking`] or [`now`]. These have
//! files that strangers wrote read by a thread for that alone ([`reading`]). In
//! programs that have no engine's threads (tests, tools) all four do the work where they are called.

mod confine;
mod engine;
mod reading;

pub use confine::{Account, DEFAULT_USER, KEPT, confine, limit, only};
pub use engine::{Engine, Task, blocking, confined, now, run};
pub use reading::{reading, reading_beside};

/// Why a thread does not have the rights that it should have.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A capability could not be given up.
    #[error("cannot {action}: {source}")]
    Capabilities {
        /// What was being done.
        action: &'static str,
        /// What the kernel said.
        source: caps::errors::CapsError,
    },
    /// The user or the groups could not be taken on.
    #[error(
        "a thread cannot become user {user} and group {group}: {source}; name another with portal_user in the configuration"
    )]
    Account {
        /// The user's number.
        user: u32,
        /// The group's number.
        group: u32,
        /// What the kernel said.
        source: std::io::Error,
    },
    /// The kernel reports other rights than were asked for.
    #[error("a thread that was to have no rights has {left}")]
    Left {
        /// What it still has.
        left: String,
    },
    /// Not the number of an account that can be used.
    #[error(
        "portal_user = {written:?} is not a user of this machine, nor the number of one other than root"
    )]
    Unknown {
        /// As it is in the configuration.
        written: String,
    },
    /// Threads could not be started.
    #[error("cannot start the engine's threads: {0}")]
    Threads(std::io::Error),
}
