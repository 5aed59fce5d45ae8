//! The process that a servant belongs to.

use std::future::Future;
use std::path::PathBuf;
use std::pin::Pin;

/// What a [`Resident`] is told.
#[derive(Debug, Clone)]
pub struct ResidentContext {
    /// The servant's id.
    pub id: String,
    /// [`crate::spec::Spec::resident`], as it was given.
    pub config: serde_json::Value,
    /// The servant's state directory on the host.
    pub directory: PathBuf,
}

/// What [`Resident::start`] fails with.
pub type ResidentError = Box<dyn std::error::Error + Send + Sync>;

/// Lives in the shim for as long as the servant does: the ROS Master. It is composed by whoever provides the shim's
/// `main`, because this crate knows nothing of ROS.
pub trait Resident {
    /// Called once, on the shim's only thread, within a `LocalSet` (so `tokio::task::spawn_local` works), when
    /// the thread is in the servant's network namespace with `lo` up and before any node is started. Returns when it can be
    /// used; what it leaves running are its own local tasks.
    fn start<'a>(
        &'a mut self,
        context: &'a ResidentContext,
    ) -> Pin<Box<dyn Future<Output = Result<(), ResidentError>> + 'a>>;

    /// A process of the servant has ended (node, child or orphan); `pid` as seen inside.
    fn process_exited(&mut self, pid: i32);
}

/// No resident: for builds.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoResident;

impl Resident for NoResident {
    fn start<'a>(
        &'a mut self,
        _context: &'a ResidentContext,
    ) -> Pin<Box<dyn Future<Output = Result<(), ResidentError>> + 'a>> {
        Box::pin(async { Ok(()) })
    }

    fn process_exited(&mut self, _pid: i32) {}
}
