use crate::names::NameError;

/// Why something of the catalogue cannot be had or changed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No such service.
    #[error("there is no service {name:?}")]
    UnknownService {
        /// Asked for.
        name: String,
        /// Names that exist.
        exists: Vec<String>,
    },
    /// No such revision.
    #[error("service {service} has no revision {revision}")]
    UnknownRevision {
        /// The service.
        service: String,
        /// Asked for.
        revision: String,
        /// Names that exist.
        exists: Vec<String>,
    },
    /// No such image or blob.
    #[error("there is no {what} in the image store")]
    UnknownImage {
        /// Asked for.
        what: String,
    },
    /// No stub can be made of it.
    #[error("there is no stub of {service}: {reason}")]
    NoStub {
        /// The service.
        service: String,
        /// The reason.
        reason: String,
    },
    /// The robot's program is not held for an architecture.
    #[error("this server holds no cloudroid-stub for {asked:?}")]
    UnknownArchitecture {
        /// Asked for.
        asked: String,
        /// Names that exist.
        exists: Vec<String>,
    },
    /// A name that cannot be given.
    #[error(transparent)]
    Name(#[from] NameError),
    /// What an image holds cannot be read.
    #[error(transparent)]
    Inventory(package::Error),
    /// The state database.
    #[error(transparent)]
    State(#[from] store::Error),
    /// The image store.
    #[error("the image store: {0}")]
    Image(#[from] image::Error),
    /// A task of the daemon broke.
    #[error("the daemon failed at {0}; its log says more")]
    Internal(&'static str),
}
