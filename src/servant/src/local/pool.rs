//! Network namespaces created in advance: creating one and bringing up its `lo` takes 3 to 14 ms, more than all other
//! work of the engine for a start.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use crate::Error;
use crate::netns::NetNs;

/// Number of namespaces kept ready. Each costs about 100 kB of kernel memory.
const READY: usize = 3;

#[derive(Debug, Default)]
pub(super) struct NetworkPool {
    inner: Arc<NetworkPoolState>,
}

#[derive(Debug, Default)]
struct NetworkPoolState {
    ready: Mutex<Vec<NetNs>>,
    refilling: AtomicBool,
}

impl NetworkPool {
    /// Takes a namespace that nobody else has.
    pub(super) fn take(&self) -> Result<NetNs, Error> {
        let ready = self.inner.ready.lock().unwrap_or_else(PoisonError::into_inner).pop();
        self.refill();
        ready.map_or_else(NetNs::create, Ok)
    }

    /// Creates the missing namespaces on a separate thread.
    pub(super) fn refill(&self) {
        if self.inner.refilling.swap(true, Ordering::AcqRel) {
            return;
        }
        let inner = self.inner.clone();
        let work = move || {
            while inner.ready.lock().unwrap_or_else(PoisonError::into_inner).len() < READY {
                // The caller that needs one creates it itself and gets the error.
                let Ok(network) = NetNs::create() else { break };
                inner.ready.lock().unwrap_or_else(PoisonError::into_inner).push(network);
            }
            inner.refilling.store(false, Ordering::Release);
        };
        if std::thread::Builder::new().name("netns-pool".into()).stack_size(256 * 1024).spawn(work).is_err() {
            self.inner.refilling.store(false, Ordering::Release);
        }
    }
}
