//! What is published: the servant repository (images and the revisions made of them) and the stub repository (archives
//! that robots install in a package's place, composed of both).
//!
//! ```text
//!  push ──revision──▶ Catalogue ─┬─ state database: the revision, its plan, its interface, what its image holds
//!                                └─ image store: tags follow the database
//!  choreographer ◀── current revision, layers, programs, message definitions
//!  portal        ◀── stubs, images, interfaces
//! ```

#![forbid(unsafe_code)]

mod error;
mod fit;
mod inventory;
pub mod names;
mod owned;
mod publish;
pub mod stubs;

use std::path::PathBuf;
use std::sync::Arc;

use store::{RevisionRecord, State};

pub use error::Error;
pub use inventory::Known;
pub use publish::{RolledBack, Withdrawn};

use inventory::InUse;

/// Services, their revisions, and what these are made of.
pub struct Catalogue {
    state: Arc<State>,
    images: Arc<image::Store>,
    in_use: InUse,
}

impl Catalogue {
    /// What this database and this image store hold.
    pub fn new(state: Arc<State>, images: Arc<image::Store>) -> Catalogue {
        Catalogue {
            state,
            images,
            in_use: InUse::default(),
        }
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

    /// One revision of a service.
    ///
    /// # Errors
    /// [`Error::UnknownRevision`] with those that there are.
    pub fn revision(&self, service: &str, number: u64) -> Result<Arc<RevisionRecord>, Error> {
        match self.state.revision(service, number)? {
            Some(revision) => Ok(revision),
            None => {
                let exists = self.state.revisions(service)?.into_iter();
                Err(Error::UnknownRevision {
                    service: service.to_owned(),
                    revision: number.to_string(),
                    exists: exists.map(|line| line.number.to_string()).collect(),
                })
            }
        }
    }

    /// The ROS package that a service was first made of.
    pub fn package(&self, service: &str) -> Result<Option<String>, Error> {
        Ok(self.state.service_package(service)?)
    }

    /// Writes rows of a service's dictionary where it has none; whether it had none.
    pub fn take_over_rows(
        &self,
        service: &str,
        rows: &api::dictionary::NewRows,
    ) -> Result<bool, Error> {
        if !self.state.dictionary(service)?.is_empty() {
            return Ok(false);
        }
        let revision = self.current(service)?.number;
        self.state.write_dictionary(service, revision, rows)?;
        Ok(true)
    }

    /// Whether a stub that was made of revision `made_of`, with this image, can use `now`; or why not and what to do.
    pub fn fits(
        &self,
        now: &RevisionRecord,
        made_of: Option<u64>,
        image: &str,
    ) -> Result<(), String> {
        fit::fits(&self.state, now, made_of, image)
    }

    /// The refusal of a service that does not exist: it names those that do.
    pub fn unknown(&self, service: &str) -> Result<Error, Error> {
        Ok(Error::UnknownService {
            name: service.to_owned(),
            exists: self.state.service_names()?,
        })
    }

    /// The extracted layers of an image, lowest first.
    pub async fn layers(&self, image: &str) -> Result<Vec<PathBuf>, Error> {
        let (images, digest) = (Arc::clone(&self.images), image.to_owned());
        blocking("extracting layers", move || {
            inventory::layers(&images, &digest)
        })
        .await
    }
}

/// Runs `work`, which blocks and needs files of the image store, where it may have them; `what` names it where it breaks.
async fn blocking<T: Send + 'static>(
    what: &'static str,
    work: impl FnOnce() -> Result<T, Error> + Send + 'static,
) -> Result<T, Error> {
    privilege::blocking(work)
        .await
        .map_err(|_| Error::Internal(what))?
}
