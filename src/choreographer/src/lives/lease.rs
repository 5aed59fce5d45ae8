//! Leases: the right to use a servant. A servant with a lease is not idle.

use std::sync::Arc;

use api::{Phase, Stated};
use reach::Reach;
use tracing::{Instrument, Span};

use crate::Error;
use crate::lives::ChoreographerInner;
use crate::lives::handle::{Handle, Life};

/// The right to use a servant; a servant with a lease is not idle.
pub struct Lease {
    handle: Arc<Handle>,
    who: String,
    /// Statement to be applied before an existing servant is used.
    anew: Option<NewStatement>,
}

/// A client's statement to an existing servant.
pub(crate) struct NewStatement {
    pub(crate) inner: Arc<ChoreographerInner>,
    pub(crate) stated: Stated,
}

impl Lease {
    /// Adds a connection of this client of the robot. Only under the choreographer's lock.
    pub(crate) fn new(handle: Arc<Handle>, who: &str) -> Lease {
        handle.add_connection(who);
        let (who, anew) = (who.to_owned(), None);
        Lease { handle, who, anew }
    }

    /// Adds the client's statement to an existing servant.
    pub(crate) fn with_statement(mut self, anew: NewStatement) -> Lease {
        self.anew = (!anew.stated.is_empty()).then_some(anew);
        self
    }

    /// Returns the handle of the servant.
    pub fn handle(&self) -> &Arc<Handle> {
        &self.handle
    }

    /// Waits until the servant is admitted. If it existed before and the client states something new, it is resized in
    /// place; an error says what would fit, and the servant keeps its limits.
    pub async fn wait_admitted(&self) -> Result<(), Error> {
        self.wait_phase(Phase::Admitted).await?;
        let Some(NewStatement { inner, stated }) = &self.anew else {
            return Ok(());
        };
        // Before that phase its limits are those that it starts with.
        self.wait_phase(Phase::Created).await?;
        let (inner, handle) = (Arc::clone(inner), Arc::clone(&self.handle));
        let (who, stated) = (self.who.clone(), stated.clone());
        let span = handle.span(Span::current().id());
        let agreed = async move { inner.agree_terms(&handle, &who, &stated).await };
        // The client may go away meanwhile; a change in progress is completed.
        tokio::spawn(agreed.instrument(span)).await.map_err(|_| Error::Internal("changing a servant's limits"))?
    }

    /// Waits until the servant's interface is registered.
    pub async fn wait_ready(&self) -> Result<Arc<dyn Reach>, Error> {
        self.wait_admitted().await?;
        self.wait_phase(Phase::Ready).await?;
        self.handle.reach().ok_or(Error::Internal("reaching a ready servant"))
    }

    /// Waits until the servant has failed or is ended; returns the reason.
    pub(crate) async fn wait_over(&self) -> Error {
        let mut life = self.handle.watch();
        match life.wait_for(Life::is_over).await {
            Ok(life) => self.handle.error(&life),
            Err(_) => Error::Internal("waiting for a servant to end"),
        }
    }

    async fn wait_phase(&self, phase: Phase) -> Result<(), Error> {
        let mut life = self.handle.watch();
        let Ok(life) = life.wait_for(|life| life.is_over() || life.phase >= phase).await else {
            return Err(Error::Internal("waiting for a servant"));
        };
        if life.is_over() { Err(self.handle.error(&life)) } else { Ok(()) }
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.handle.remove_connection(&self.who);
    }
}
