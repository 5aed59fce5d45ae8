//! What a client may do, as its operator says now.

use std::sync::Arc;

use access::{Grants, Operation, Standing};
use tokio::sync::watch;

/// What a client may do to topics, services and actions, and why its connection ends when that is so. It changes while the
/// client is connected; then what it has and may not have any more is taken back.
#[derive(Debug, Clone)]
pub struct Granted(watch::Receiver<Standing>);

impl Default for Granted {
    /// Everything, for good.
    fn default() -> Self {
        Granted::always(Grants::everything())
    }
}

impl Granted {
    /// What this says, as it changes.
    pub fn by(standing: watch::Receiver<Standing>) -> Granted {
        Granted(standing)
    }

    /// These grants, for good.
    pub fn always(grants: Grants) -> Granted {
        let (_, standing) = watch::channel(Standing::Granted(Arc::new(grants)));
        Granted(standing)
    }

    /// What is granted now.
    pub(crate) fn grants(&self) -> Arc<Grants> {
        match &*self.0.borrow() {
            Standing::Granted(grants) => Arc::clone(grants),
            Standing::Ended(_) => Arc::default(),
        }
    }

    /// Refuses, in words, what is not granted.
    pub(crate) fn check(&self, operation: Operation, name: &str) -> Result<(), String> {
        let grants = self.grants();
        if grants.permits(operation, name) {
            return Ok(());
        }
        Err(format!(
            "{}:{name} is not granted to this client (granted: {grants}); the operator can, with cloudroidctl policy allow",
            operation.name()
        ))
    }

    /// Why the connection is to end, if it is.
    pub(crate) fn ended(&self) -> Option<String> {
        match &*self.0.borrow() {
            Standing::Granted(_) => None,
            Standing::Ended(reason) => Some(reason.clone()),
        }
    }

    /// Comes back when it has changed since this was made or last asked; never, where nobody can change it.
    pub(crate) async fn changed(&mut self) {
        if self.0.changed().await.is_err() {
            std::future::pending().await
        }
    }
}
