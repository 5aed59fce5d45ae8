//! The process that owns a servant. The daemon starts one for each servant and may then exit: the shim is the parent of
//! the container's init, keeps the log, restarts nodes, hosts the servant's [`Resident`] (its ROS Master) and records
//! how the servant ended.
//!
//! ```text
//!   begin    one thread: session, standard streams, launch record, cgroup with limits read back, network namespace
//!     |      fork -> creator: layers, overlay, libcontainer; it exits and takes all their memory with it
//!   drive    one thread, one event loop; all privileges but CAP_KILL are gone,
//!     |      and all files but the servant's
//!     |      Creating -> Running -> (stop requested, required node ended, init gone) -> Stopped | Failed
//!   end      pid namespace killed, log drained, cgroup removed, exit.json written, connections notified
//! ```
//!
//! Once the container runs, the shim keeps uid 0 without capabilities, except CAP_KILL, because init has another uid
//! and must be killed on request. The cgroup's files and the servant's directory belong to root, so that limits can be
//! changed, the log written and the cgroup removed without further privileges. No other files can be opened, no
//! programs executed, and no new privileges gained.
//!
//! Directories are removed not by the shim but by the engine ([`crate::engine::ServantHandle::stop`] and
//! [`crate::engine::Engine::sweep`]): the log and `exit.json` are still to be read.

use std::future::Future;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::process::ExitCode;

mod begin;
mod clients;
mod command_error;
mod create;
mod driver;
mod execs;
mod input;
mod link;
mod nodes;
mod privileges;
mod streams;

/// Context passed to a [`Resident`].
#[derive(Debug, Clone)]
pub struct ResidentContext {
    /// Id of the servant.
    pub id: String,
    /// Configuration, unchanged from [`crate::container::ContainerSpec::resident`].
    pub config: serde_json::Value,
    /// State directory of the servant on the host.
    pub directory: PathBuf,
}

/// Error of [`Resident::start`].
pub type ResidentError = Box<dyn std::error::Error + Send + Sync>;

/// A component that lives in the shim for as long as the servant does: the ROS Master. It is supplied by the shim's
/// `main`, because this crate is independent of ROS.
pub trait Resident {
    /// Starts the resident. Called once, on the shim's only thread, within a `LocalSet` (so `tokio::task::spawn_local`
    /// works), when the thread is in the servant's network namespace with `lo` up and before any node is started.
    /// Returns when the resident is ready; it continues in local tasks.
    fn start<'a>(
        &'a mut self,
        context: &'a ResidentContext,
    ) -> Pin<Box<dyn Future<Output = Result<(), ResidentError>> + 'a>>;

    /// Called when a process of the servant has ended (node, child or orphan); `pid` is that in the container.
    fn process_exited(&mut self, pid: i32);
}

/// Returns whether the kernel supports restricting shims to their servants' files (Landlock). Without it a shim could
/// open root's files.
pub fn can_restrict_files() -> bool {
    privileges::can_restrict_files()
}

/// Runs the shim of the servant with this state directory. Must be called by the command that
/// [`crate::local::LocalEngineConfig::shim_command`] names, with its last argument, before that process has a second
/// thread; the caller returns the exit code from `main`.
pub fn run(directory: &Path, resident: Box<dyn Resident>) -> ExitCode {
    match begin::begin(directory).and_then(|begun| driver::drive(begun, resident)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
