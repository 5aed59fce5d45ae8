use crate::names::NameError;

/// Errors of reading or changing the catalogue.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The service does not exist.
    #[error("no service {name:?}")]
    UnknownService {
        /// Name that was requested.
        name: String,
        /// Services that exist.
        exists: Vec<String>,
    },
    /// The revision does not exist.
    #[error("service {service} has no revision {revision}")]
    UnknownRevision {
        /// Name of the service.
        service: String,
        /// Revision that was requested.
        revision: String,
        /// Revisions that exist.
        exists: Vec<String>,
    },
    /// The image or blob does not exist.
    #[error("no {what} in the image store")]
    UnknownImage {
        /// Image or blob that was requested.
        what: String,
    },
    /// The stub cannot be built.
    #[error("no stub of {service}: {reason}")]
    NoStub {
        /// Name of the service.
        service: String,
        /// Reason.
        reason: String,
    },
    /// Robots of the other ROS cannot use the service.
    #[error("no stub of {service} for the other ROS: {reason}")]
    NoTwins {
        /// Name of the service.
        service: String,
        /// The types that have no equivalent, with their fields.
        reason: package::Error,
    },
    /// The robot's program is not installed for this architecture.
    #[error("this server has no cloudroid-stub for {asked:?}")]
    UnknownArchitecture {
        /// Architecture that was requested.
        asked: String,
        /// Architectures that are installed.
        exists: Vec<String>,
    },
    /// Invalid name.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The content of an image cannot be read.
    #[error(transparent)]
    Inventory(package::Error),
    /// Error of the state database.
    #[error(transparent)]
    State(#[from] store::Error),
    /// Error of the image store.
    #[error("the image store: {0}")]
    Image(#[from] image::Error),
    /// A task of the daemon panicked.
    #[error("internal error of the daemon while {0}; see its log")]
    Internal(&'static str),
}
