//! What a client may do, as its operator says now.

use std::fmt;
use std::sync::Arc;

use access::{Grants, Operation, Standing};
use tokio::sync::watch;

/// What a client may do to topics, services and actions, and why its connection ends when that is so. It changes while the
/// client is connected; then what it has and may not have any more is taken back.
#[derive(Clone)]
pub struct Granted {
    standing: watch::Receiver<Standing>,
    refused: Option<Arc<Told>>,
    used: Option<Arc<Told>>,
}

/// Hears of an operation, such as `publish:/cmd_vel`.
type Told = dyn Fn(&str) + Send + Sync;

impl fmt::Debug for Granted {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_tuple("Granted").field(&self.standing).finish()
    }
}

impl Default for Granted {
    /// Everything, for good.
    fn default() -> Self {
        Granted::always(Grants::everything())
    }
}

impl Granted {
    /// What this says, as it changes.
    pub fn by(standing: watch::Receiver<Standing>) -> Granted {
        Granted {
            standing,
            refused: None,
            used: None,
        }
    }

    /// The same; `hears` is told of each operation that is carried out and does more than listen.
    pub fn noting(self, hears: impl Fn(&str) + Send + Sync + 'static) -> Granted {
        Granted {
            used: Some(Arc::new(hears)),
            ..self
        }
    }

    /// The same; `hears` is told of each operation that is refused.
    pub fn telling(self, hears: impl Fn(&str) + Send + Sync + 'static) -> Granted {
        Granted {
            refused: Some(Arc::new(hears)),
            ..self
        }
    }

    /// These grants, for good.
    pub fn always(grants: Grants) -> Granted {
        let (_, standing) = watch::channel(Standing::Granted(Arc::new(grants)));
        Granted::by(standing)
    }

    /// What is granted now.
    pub fn grants(&self) -> Arc<Grants> {
        match &*self.standing.borrow() {
            Standing::Granted(grants) => Arc::clone(grants),
            Standing::Ended(_) => Arc::default(),
        }
    }

    /// Refuses, in words, what is not granted.
    pub fn check(&self, operation: Operation, name: &str) -> Result<(), String> {
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
        Err(format!(
            "{asked} is not granted to this client (granted: {grants}); the operator can, with cloudroidctl policy allow"
        ))
    }

    /// Why the connection is to end, if it is.
    pub fn ended(&self) -> Option<String> {
        match &*self.standing.borrow() {
            Standing::Granted(_) => None,
            Standing::Ended(reason) => Some(reason.clone()),
        }
    }

    /// Comes back when it has changed since this was made or last asked; never, where nobody can change it.
    pub async fn changed(&mut self) {
        if self.standing.changed().await.is_err() {
            std::future::pending().await
        }
    }
}
