/// Errors of pushing, rolling back and removing services.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The name belongs to a service of another package.
    #[error("the service name {name} is taken: its package is {package}, not {newcomer}")]
    NameTaken {
        /// Name of the service.
        name: String,
        /// Package of the existing service.
        package: String,
        /// Package that was pushed.
        newcomer: String,
    },
    /// The deployer is not allowed to publish the service.
    #[error("{0}")]
    NotAllowed(String),
    /// Invalid options.
    #[error("{0}")]
    Options(String),
    /// The push failed.
    #[error("{message}")]
    Failed {
        /// Description of the failure.
        message: String,
        /// Suggested next step.
        next: Option<String>,
        /// Log lines that explain the failure.
        log: Vec<String>,
    },
    /// The archive is too large.
    #[error("the archive is larger than {limit}")]
    TooLarge {
        /// Maximum size.
        limit: api::Size,
    },
    /// The daemon is shutting down.
    #[error("the daemon is shutting down")]
    Ending,
    /// Error of the choreographer.
    #[error(transparent)]
    Choreographer(#[from] choreographer::Error),
    /// Error of the catalogue.
    #[error(transparent)]
    Catalogue(#[from] catalogue::Error),
    /// Error of the state database.
    #[error(transparent)]
    State(#[from] store::Error),
    /// Error of the image store.
    #[error("the image store: {0}")]
    Image(#[from] image::Error),
    /// Error of the container engine.
    #[error(transparent)]
    Engine(#[from] servant::Error),
    /// A task of the daemon panicked.
    #[error("internal error of the daemon while {0}; see its log")]
    Internal(&'static str),
}

#[cfg(test)]
impl Error {
    /// Returns the message and the advice of a failed push.
    pub(crate) fn message_and_advice(self) -> String {
        let Error::Failed { message, next, .. } = self else {
            panic!("{self} is not a failed push");
        };
        format!("{message}; {}", next.unwrap_or_default())
    }
}
