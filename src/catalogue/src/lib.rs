//! What is published: the servant repository (images and the revisions made of them) and the stub repository (archives
//! that robots install in a package's place, composed of both).
//!
//! ```text
//!  push ──revision──▶ Catalogue ─┬─ state database: the revision, its plan, its interface
//!                                └─ image store: tags follow the database
//!  choreographer ◀── current revision, layers, message definitions
//!  portal        ◀── stubs, images, interfaces
//! ```

#![forbid(unsafe_code)]

mod definitions;
mod error;
mod fit;
pub mod names;
mod prefixes;
mod publish;
pub mod stubs;

use std::path::PathBuf;
use std::sync::Arc;

use ros::schema::Registry;
use store::{RevisionRecord, State};

pub use error::Error;
pub use fit::fits;
pub use prefixes::prefixes;
pub use publish::{RolledBack, Withdrawn};

use definitions::Definitions;

/// Services, their revisions, and what these are made of.
pub struct Catalogue {
    state: Arc<State>,
    images: Arc<image::Store>,
    definitions: Definitions,
}

impl Catalogue {
    /// What this database and this image store hold.
    pub fn new(state: Arc<State>, images: Arc<image::Store>) -> Catalogue {
        Catalogue {
            state,
            images,
            definitions: Definitions::default(),
        }
    }

    /// The database.
    pub fn state(&self) -> &Arc<State> {
        &self.state
    }

    /// The images.
    pub fn images(&self) -> &Arc<image::Store> {
        &self.images
    }

    /// The current revision of a service that exists.
    pub fn current(&self, service: &str) -> Result<Arc<RevisionRecord>, Error> {
        match self.state.current(service)? {
            Some(revision) => Ok(revision),
            None => Err(self.unknown(service)?),
        }
    }

    /// The refusal of a service that does not exist: it names those that do.
    pub fn unknown(&self, service: &str) -> Result<Error, Error> {
        Ok(Error::UnknownService {
            name: service.to_owned(),
            exists: self.state.service_names()?,
        })
    }

    /// The extracted layers of a revision's image, lowest first.
    pub async fn layers(&self, revision: &RevisionRecord) -> Result<Vec<PathBuf>, Error> {
        let (images, digest) = (Arc::clone(&self.images), revision.image.clone());
        blocking("extracting layers", move || {
            definitions::layers(&images, &digest)
        })
        .await
    }

    /// All message definitions that a servant of `revision` knows: its interface's, and those in its image.
    pub async fn registry(&self, revision: &RevisionRecord) -> Arc<Registry> {
        self.definitions.registry(&self.images, revision).await
    }

    /// Reads the definitions of everything published, so that no robot waits for that.
    pub async fn read_definitions(&self) -> Result<(), Error> {
        for service in self.state.service_names()? {
            if let Some(revision) = self.state.current(&service)? {
                self.definitions.read(&self.images, &revision.image).await;
            }
        }
        Ok(())
    }
}

/// Runs `work`, which blocks, beside the runtime's threads; `what` names it where it breaks.
async fn blocking<T: Send + 'static>(
    what: &'static str,
    work: impl FnOnce() -> Result<T, Error> + Send + 'static,
) -> Result<T, Error> {
    tokio::task::spawn_blocking(work)
        .await
        .map_err(|_| Error::Internal(what))?
}
