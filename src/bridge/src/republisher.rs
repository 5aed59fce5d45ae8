//! State of the republisher of transforms.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock, Weak};

use parking_lot::Mutex;
use ros::codec::Time;
use tokio_util::sync::DropGuard;

use crate::fanout::ListenerGuard;
use crate::tf::Transform;

/// The republisher of a bridge.
#[derive(Default)]
pub(crate) struct Republisher {
    pub(crate) buffer: SharedBuffer,
    pub(crate) topics: Mutex<HashMap<String, DropGuard>>,
    pub(crate) goals: Mutex<HashMap<String, DropGuard>>,
    /// Set when a client first uses the action.
    pub(crate) listening: OnceLock<[ListenerGuard; 2]>,
}

/// The buffer of a bridge, shared for as long as it is used.
#[derive(Default)]
pub(crate) struct SharedBuffer(Mutex<Weak<TransformBuffer>>);

impl SharedBuffer {
    pub(crate) fn get(&self, make: impl FnOnce() -> TransformBuffer) -> Arc<TransformBuffer> {
        let mut buffer = self.0.lock();
        buffer.upgrade().unwrap_or_else(|| {
            let made = Arc::new(make());
            *buffer = Arc::downgrade(&made);
            made
        })
    }
}

/// The known transforms; subscribed for as long as it lives.
pub(crate) struct TransformBuffer {
    pub(crate) frames: Arc<Frames>,
    pub(crate) _listening: [ListenerGuard; 2],
}

/// The known frames.
#[derive(Default)]
pub(crate) struct Frames {
    /// Links by child frame.
    pub(crate) links: Mutex<HashMap<String, FrameLink>>,
}

/// Pose of a frame in its parent.
pub(crate) struct FrameLink {
    pub(crate) parent: String,
    pub(crate) transform: Transform,
    /// Time of the transform; `None` for static ones.
    pub(crate) time: Option<Time>,
}
