//! Network namespaces made ahead: making one and bringing its `lo` up takes 3 to 14 ms, more than the rest of what the
//! engine itself does for a start.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use crate::Error;
use crate::netns::NetNs;

/// Kept ready. Each costs the kernel some 100 kB.
const READY: usize = 3;

#[derive(Debug, Default)]
pub(super) struct Networks {
    inner: Arc<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    ready: Mutex<Vec<NetNs>>,
    refilling: AtomicBool,
}

impl Networks {
    /// One that nobody else has.
    pub(super) fn take(&self) -> Result<NetNs, Error> {
        let ready = self
            .inner
            .ready
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .pop();
        self.refill();
        ready.map_or_else(NetNs::create, Ok)
    }

    /// Makes what is missing, on a thread of its own.
    pub(super) fn refill(&self) {
        if self.inner.refilling.swap(true, Ordering::AcqRel) {
            return;
        }
        let inner = self.inner.clone();
        let work = move || {
            while inner
                .ready
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .len()
                < READY
            {
                // Whoever needs one makes it and sees the error.
                let Ok(network) = NetNs::create() else { break };
                inner
                    .ready
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner)
                    .push(network);
            }
            inner.refilling.store(false, Ordering::Release);
        };
        if std::thread::Builder::new()
            .name("netns-pool".into())
            .stack_size(256 * 1024)
            .spawn(work)
            .is_err()
        {
            self.inner.refilling.store(false, Ordering::Release);
        }
    }
}
