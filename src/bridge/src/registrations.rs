//! Serializes registrations of a service: a client that advertises anew replaces its earlier handler, and the bus must
//! have released the old one before it takes the new one.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;
use tokio::sync::OwnedMutexGuard;

/// Locks by service.
#[derive(Default)]
pub(crate) struct Registrations {
    held: Mutex<HashMap<String, Arc<tokio::sync::Mutex<()>>>>,
}

impl Registrations {
    /// Waits until nobody else registers or holds this name.
    pub(crate) async fn acquire(&self, name: &str) -> OwnedMutexGuard<()> {
        let lock = {
            let mut held = self.held.lock();
            held.retain(|_, lock| Arc::strong_count(lock) > 1);
            held.entry(name.to_owned()).or_default().clone()
        };
        lock.lock_owned().await
    }
}
