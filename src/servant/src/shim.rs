//! The process that a servant belongs to. The daemon starts one for each servant and may then die: the shim is the
//! parent of the container's init, keeps the log, restarts nodes, is the home of the servant's [`Resident`] (its ROS
//! Master) and records how it ended.
//!
//! ```text
//!   begin    one thread: session, standard streams, launch record, cgroup with limits read back, network namespace
//!     |      fork -> creator: layers, overlay, libcontainer; it exits and takes all their memory with it
//!   drive    one thread, one event loop; all privileges but CAP_KILL are gone,
//!     |      and all files but the servant's
//!     |      Creating -> Running -> (stop asked, required node ended, init gone) -> Stopped | Failed
//!   end      pid namespace killed, log drained, cgroup removed, exit.json written, connections told
//! ```
//!
//! What is kept after the container runs: uid 0 without capabilities, except CAP_KILL, because init has another uid and
//! must die when asked. The cgroup's files and the servant's directory belong to root, so that limits are changed,
//! the log written and the cgroup removed without further rights. No other files can be opened, no programs executed, and no
//! new privileges gained.
//!
//! Directories are not removed by the shim but by the engine ([`crate::engine::Servant::stop`] and
//! [`crate::engine::Engine::adopt`]): the log and `exit.json` are still to be read.

use std::future::Future;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::process::ExitCode;

mod begin;
mod clients;
mod create;
mod driver;
mod input;
mod link;
mod nodes;
mod privileges;
mod streams;

/// What a [`Resident`] is told.
#[derive(Debug, Clone)]
pub struct ResidentContext {
    /// The servant's id.
    pub id: String,
    /// [`crate::container::ContainerSpec::resident`], as it was given.
    pub config: serde_json::Value,
    /// The servant's state directory on the host.
    pub directory: PathBuf,
}

/// What [`Resident::start`] fails with.
pub type ResidentError = Box<dyn std::error::Error + Send + Sync>;

/// Lives in the shim for as long as the servant does: the ROS Master. It is composed by whoever provides the shim's
/// `main`, because this crate knows nothing of ROS.
pub trait Resident {
    /// Called once, on the shim's only thread, within a `LocalSet` (so `tokio::task::spawn_local` works), when the
    /// thread is in the servant's network namespace with `lo` up and before any node is started. Returns when it can
    /// be used; what it leaves running are its own local tasks.
    fn start<'a>(
        &'a mut self,
        context: &'a ResidentContext,
    ) -> Pin<Box<dyn Future<Output = Result<(), ResidentError>> + 'a>>;

    /// A process of the servant has ended (node, child or orphan); `pid` as seen inside.
    fn process_exited(&mut self, pid: i32);
}

/// Whether the kernel can keep shims to their servants' files (Landlock). Where it cannot, they could open what belongs to root.
pub fn can_keep_to_files() -> bool {
    privileges::can_keep_to_files()
}

/// Is the shim of the servant whose state directory this is. To be called by the command that
/// [`crate::local::LocalEngineConfig::shim_command`] names, with its last argument, before that process has a second
/// thread; the caller returns what it gets from `main`.
pub fn run(directory: &Path, resident: Box<dyn Resident>) -> ExitCode {
    match begin::begin(directory).and_then(|begun| driver::drive(begun, resident)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
