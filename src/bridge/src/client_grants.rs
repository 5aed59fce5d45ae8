//! Grants of a client, as set by its operator.

use std::fmt;
use std::sync::Arc;

use access::{ConnectionAccess, Grants, Operation};
use tokio::sync::watch;

/// Permissions of a client for topics, services and actions, or the reason for ending its connection. They can change
/// while the client is connected; then what it no longer may use is revoked.
#[derive(Clone)]
pub struct ClientGrants {
    standing: watch::Receiver<ConnectionAccess>,
    refused: Option<Arc<OperationObserver>>,
    used: Option<Arc<OperationObserver>>,
}

/// An operation that is not granted to a client.
#[derive(Debug, Clone, thiserror::Error)]
#[error(
    "{asked} is not granted to this client (granted: {granted}); the operator can grant it with cloudroidctl policy \
        allow"
)]
pub struct NotGrantedError {
    /// The operation and the name: `publish:/cmd_vel`.
    pub asked: String,
    /// All grants of the client.
    pub granted: Arc<Grants>,
}

/// Callback for an operation, such as `publish:/cmd_vel`.
type OperationObserver = dyn Fn(&str) + Send + Sync;

impl fmt::Debug for ClientGrants {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_tuple("Granted").field(&self.standing).finish()
    }
}

impl Default for ClientGrants {
    /// Grants everything, permanently.
    fn default() -> Self {
        ClientGrants::from_fixed(Grants::everything())
    }
}

impl ClientGrants {
    /// Follows `standing` as it changes.
    pub fn from_standing(standing: watch::Receiver<ConnectionAccess>) -> ClientGrants {
        ClientGrants { standing, refused: None, used: None }
    }

    /// Sets a callback for each permitted operation, except subscriptions.
    pub fn with_use_observer(self, hears: impl Fn(&str) + Send + Sync + 'static) -> ClientGrants {
        ClientGrants { used: Some(Arc::new(hears)), ..self }
    }

    /// Sets a callback for each refused operation.
    pub fn with_refusal_observer(self, hears: impl Fn(&str) + Send + Sync + 'static) -> ClientGrants {
        ClientGrants { refused: Some(Arc::new(hears)), ..self }
    }

    /// Grants `grants` permanently.
    pub fn from_fixed(grants: Grants) -> ClientGrants {
        let (_, standing) = watch::channel(ConnectionAccess::Granted(Arc::new(grants)));
        ClientGrants::from_standing(standing)
    }

    /// Returns the current grants.
    pub fn grants(&self) -> Arc<Grants> {
        match &*self.standing.borrow() {
            ConnectionAccess::Granted(grants) => Arc::clone(grants),
            ConnectionAccess::Ended(_) => Arc::default(),
        }
    }

    /// Refuses what is not granted.
    ///
    /// # Errors
    /// Fails, with an explanation for the client, if the operation on this name is not granted.
    pub fn check(&self, operation: Operation, name: &str) -> Result<(), NotGrantedError> {
        let grants = self.grants();
        let asked = || format!("{}:{name}", operation.name());
        if grants.permits(operation, name) {
            if let Some(hears) = &self.used
                && operation != Operation::Subscribe
            {
                hears(&asked());
            }
            return Ok(());
        }
        let asked = asked();
        if let Some(hears) = &self.refused {
            hears(&asked);
        }
        Err(NotGrantedError { asked, granted: grants })
    }

    /// Returns the reason why the connection must end, if it must.
    pub fn end_reason(&self) -> Option<String> {
        match &*self.standing.borrow() {
            ConnectionAccess::Granted(_) => None,
            ConnectionAccess::Ended(reason) => Some(reason.clone()),
        }
    }

    /// Returns when the grants have changed since this was created or last called; never if nobody can change them.
    pub async fn wait_changed(&mut self) {
        if self.standing.changed().await.is_err() {
            std::future::pending().await
        }
    }
}
