//! Parts of the pusher, which the steps of a push share.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use catalogue::Catalogue;
use choreographer::Choreographer;
use reach::Opener;
use rootfs_builder::Builder;
use servant::engine::Engine;
use store::{Journal, State};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use crate::Options;
use crate::disks::Disks;
use crate::places::PushQueue;
use crate::registry::PushRegistry;

/// Capacity of a queue of events, which the task of the push empties.
pub(super) const EVENTS_AHEAD: usize = 256;
/// Home directory of nodes in the container, a tmpfs.
pub(super) const HOME_INSIDE: &str = "/root";

/// Dependencies of a [`Pusher`].
pub struct PusherParts {
    /// Builds images.
    pub builder: Arc<Builder>,
    /// Publishes revisions.
    pub catalogue: Arc<Catalogue>,
    /// Runs the container in which the interface is probed.
    pub engine: Arc<dyn Engine>,
    /// Connects to the ROS graph of that container.
    pub opener: Arc<dyn Opener>,
    /// Admits that container, and stops the servants of removed services.
    pub choreographer: Choreographer,
    /// Records the outcome for the operator.
    pub journal: Journal,
    /// Database, which keeps the pushes of late.
    pub state: Arc<State>,
}

/// Publishes, rolls back and removes services.
pub struct Pusher {
    pub(super) options: Options,
    pub(super) home: PathBuf,
    pub(super) catalogue: Arc<Catalogue>,
    pub(super) engine: Arc<dyn Engine>,
    pub(super) opener: Arc<dyn Opener>,
    pub(super) choreographer: Choreographer,
    pub(super) builder: Arc<Builder>,
    pub(super) journal: Journal,
    pub(super) places: PushQueue,
    pub(super) registry: PushRegistry,
    pub(super) disks: Disks,
    pub(super) published: AtomicU64,
    pub(super) failed: AtomicU64,
    pub(super) cancel: CancellationToken,
    pub(super) tasks: TaskTracker,
}

impl Pusher {
    /// Creates a pusher with build directories below `home`, the state directory.
    pub fn new(options: Options, home: PathBuf, parts: PusherParts) -> Pusher {
        let PusherParts { builder, catalogue, engine, opener, choreographer, journal, state } = parts;
        Pusher {
            places: PushQueue::new(&options),
            registry: PushRegistry::new(state),
            disks: Disks::new(&home, builder.cache_dir(), options.free),
            options,
            home,
            journal,
            catalogue,
            engine,
            opener,
            choreographer,
            builder,
            published: AtomicU64::new(0),
            failed: AtomicU64::new(0),
            cancel: CancellationToken::new(),
            tasks: TaskTracker::new(),
        }
    }

    /// Returns the numbers of successful and failed pushes since the start.
    pub fn counts(&self) -> (u64, u64) {
        (self.published.load(Ordering::Relaxed), self.failed.load(Ordering::Relaxed))
    }

    /// Cancels all pushes and waits up to `patience` until they have cleaned up; what is left is removed at the next
    /// start.
    pub async fn cancel_all(&self, patience: Duration) {
        self.cancel.cancel();
        self.builder.stop_packing();
        self.tasks.close();
        if tokio::time::timeout(patience, self.tasks.wait()).await.is_err() {
            tracing::warn!("leftovers of cancelled pushes are removed at the next start");
        }
    }
}
