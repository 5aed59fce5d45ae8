//! The catalogue of published services: the servant repository (images and the revisions built from them) and the stub
//! repository (archives that robots install in place of a package, composed from both).
//!
//! ```text
//!  push ──revision──▶ Catalogue ─┬─ state database: the revision, its plan, interface, and image inventory
//!                                └─ image store: tags follow the database
//!  choreographer ◀── current revision, layers, programs, message definitions
//!  portal        ◀── stubs, images, interfaces
//! ```

#![forbid(unsafe_code)]

mod disk_usage;
mod error;
mod fit;
mod inventory;
pub mod names;
mod publish;
pub mod stubs;
mod twins;
mod unchanged;
mod underlays;

use std::path::PathBuf;
use std::sync::Arc;

use store::{RevisionRecord, State};
use translation::TranslationRules;

pub use error::Error;
pub use fit::StubError;
pub use inventory::RevisionContents;
pub use publish::{RollbackResult, WithdrawnService};

use inventory::ContentsCache;

/// Published services and their revisions, backed by the state database and the image store.
pub struct Catalogue {
    state: Arc<State>,
    images: Arc<image::Store>,
    in_use: ContentsCache,
    rules: Arc<TranslationRules>,
}

impl Catalogue {
    /// Creates a catalogue on a state database and an image store.
    pub fn new(state: Arc<State>, images: Arc<image::Store>) -> Catalogue {
        Catalogue { state, images, in_use: ContentsCache::default(), rules: Arc::default() }
    }

    /// Sets the rules by which types have counterparts in the other ROS (default: the built-in ones).
    pub fn with_translation_rules(self, rules: TranslationRules) -> Catalogue {
        Catalogue { rules: Arc::new(rules), ..self }
    }

    /// Returns the rules by which types have counterparts in the other ROS.
    pub fn translation_rules(&self) -> &Arc<TranslationRules> {
        &self.rules
    }

    /// Returns which types of a revision have no counterpart in the other ROS, with their fields, if there are any.
    pub fn find_types_without_twins(&self, revision: &RevisionRecord) -> Option<package::Error> {
        let robots = revision.flavour.ros.ros_version().other();
        twins::interface_for_robots(revision, robots, &self.rules).err()
    }

    /// Returns the image store.
    pub fn images(&self) -> &Arc<image::Store> {
        &self.images
    }

    /// Returns the current revision of a service.
    pub fn current_revision(&self, service: &str) -> Result<Arc<RevisionRecord>, Error> {
        match self.state.current_revision(service)? {
            Some(revision) => Ok(revision),
            None => Err(self.unknown_service(service)?),
        }
    }

    /// Returns a revision of a service.
    ///
    /// # Errors
    /// [`Error::UnknownRevision`] with the revisions that exist.
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

    /// Returns the ROS package that a service was first built from.
    pub fn service_package(&self, service: &str) -> Result<Option<String>, Error> {
        Ok(self.state.service_package(service)?)
    }

    /// Writes the rows of a service's dictionary if it is empty; returns whether it was.
    pub fn initialize_dictionary(&self, service: &str, rows: &api::dictionary::NewRows) -> Result<bool, Error> {
        if !self.state.dictionary(service)?.is_empty() {
            return Ok(false);
        }
        let revision = self.current_revision(service)?.number;
        self.state.write_dictionary(service, revision, rows)?;
        Ok(true)
    }

    /// Checks whether a stub built from revision `made_of`, with this image, is compatible with `now`. Otherwise
    /// returns the incompatible differences and the next step.
    pub fn check_stub_compatibility(
        &self,
        now: &RevisionRecord,
        made_of: Option<u64>,
        image: &str,
    ) -> Result<(), StubError> {
        fit::check_stub_compatibility(&self.state, now, made_of, image)
    }

    /// Returns the error for a service that does not exist, naming those that do.
    pub fn unknown_service(&self, service: &str) -> Result<Error, Error> {
        Ok(Error::UnknownService { name: service.to_owned(), exists: self.state.service_names()? })
    }

    /// Returns the extracted layers of an image, lowest first.
    pub async fn layers(&self, image: &str) -> Result<Vec<PathBuf>, Error> {
        let (images, digest) = (Arc::clone(&self.images), image.to_owned());
        blocking("extracting layers", move || inventory::layers(&images, &digest)).await
    }
}

/// Runs blocking `work` with access to the files of the image store; `what` names it in the error if it panics.
async fn blocking<T: Send + 'static>(
    what: &'static str,
    work: impl FnOnce() -> Result<T, Error> + Send + 'static,
) -> Result<T, Error> {
    privilege::spawn_blocking(work).await.map_err(|_| Error::Internal(what))?
}
