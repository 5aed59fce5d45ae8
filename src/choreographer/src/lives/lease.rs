//! Leases: the right to use a servant. While a servant has one it is not idle.

use std::sync::Arc;

use api::{Phase, Stated};
use reach::Reach;

use crate::Error;
use crate::lives::Inner;
use crate::lives::handle::{Handle, Life};

/// The right to use a servant; while one lives the servant is not idle.
pub struct Lease {
    handle: Arc<Handle>,
    who: String,
    /// Terms that are to be agreed upon before it is used: those of a servant that was there.
    anew: Option<Anew>,
}

/// What a client states to a servant that was there.
pub(crate) struct Anew {
    pub(crate) inner: Arc<Inner>,
    pub(crate) stated: Stated,
}

impl Lease {
    /// Counts one more connection in, of this one of the robot's clients. Only under the choreographer's lock.
    pub(crate) fn new(handle: Arc<Handle>, who: &str) -> Lease {
        handle.enters(who);
        let (who, anew) = (who.to_owned(), None);
        Lease { handle, who, anew }
    }

    /// With what its client states to a servant that was there.
    pub(crate) fn stating(mut self, anew: Anew) -> Lease {
        self.anew = (!anew.stated.is_empty()).then_some(anew);
        self
    }

    /// The servant.
    pub fn handle(&self) -> &Arc<Handle> {
        &self.handle
    }

    /// Waits until there is room for the servant. Where one was there and the client states something else than before,
    /// it is resized in place; an error says what would fit, and the servant keeps what it had.
    pub async fn admitted(&self) -> Result<(), Error> {
        self.reached(Phase::Admitted).await?;
        let Some(Anew { inner, stated }) = &self.anew else {
            return Ok(());
        };
        // Until then its limits are those that it begins with.
        self.reached(Phase::Created).await?;
        let (inner, handle) = (Arc::clone(inner), Arc::clone(&self.handle));
        let (who, stated) = (self.who.clone(), stated.clone());
        // Its client may go away meanwhile; what is begun is done.
        let agreed = tokio::spawn(async move { inner.agree(&handle, &who, &stated).await });
        agreed
            .await
            .map_err(|_| Error::Internal("changing a servant's limits"))?
    }

    /// Waits until the servant's interface is there.
    pub async fn ready(&self) -> Result<Arc<dyn Reach>, Error> {
        self.admitted().await?;
        self.reached(Phase::Ready).await?;
        self.handle
            .reach()
            .ok_or(Error::Internal("reaching a ready servant"))
    }

    /// Comes back when the servant has failed or is ended, with the reason.
    pub(crate) async fn over(&self) -> Error {
        let mut life = self.handle.watch();
        match life.wait_for(Life::is_over).await {
            Ok(life) => self.handle.error(&life),
            Err(_) => Error::Internal("waiting for a servant's end"),
        }
    }

    async fn reached(&self, phase: Phase) -> Result<(), Error> {
        let mut life = self.handle.watch();
        let Ok(life) = life
            .wait_for(|life| life.is_over() || life.phase >= phase)
            .await
        else {
            return Err(Error::Internal("waiting for a servant"));
        };
        if life.is_over() {
            Err(self.handle.error(&life))
        } else {
            Ok(())
        }
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.handle.leaves(&self.who);
    }
}
