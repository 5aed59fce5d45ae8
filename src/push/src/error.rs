/// Why something is not pushed, set back or removed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The name is that of a service of another package.
    #[error(
        "the service name {name} is taken: it was made of the package {package}, and this one is {newcomer}"
    )]
    NameTaken {
        /// The name.
        name: String,
        /// The package.
        package: String,
        /// Who wants it.
        newcomer: String,
    },
    /// Whoever pushes may not publish it.
    #[error("{0}")]
    NotAllowed(String),
    /// Something in the options is not what it should be.
    #[error("{0}")]
    Options(String),
    /// A push that failed.
    #[error("{message}")]
    Failed {
        /// What failed.
        message: String,
        /// The next step.
        next: Option<String>,
        /// What explains it.
        log: Vec<String>,
    },
    /// The archive is too big.
    #[error("the archive is bigger than {limit}")]
    TooLarge {
        /// What is allowed.
        limit: api::Size,
    },
    /// The daemon is ending.
    #[error("the daemon is ending")]
    Ending,
    /// Servants.
    #[error(transparent)]
    Choreographer(#[from] choreographer::Error),
    /// What is published.
    #[error(transparent)]
    Catalogue(#[from] catalogue::Error),
    /// The state database.
    #[error(transparent)]
    State(#[from] store::Error),
    /// The image store.
    #[error("the image store: {0}")]
    Image(#[from] image::Error),
    /// The engine.
    #[error(transparent)]
    Engine(#[from] servant::Error),
    /// A task of the daemon broke.
    #[error("the daemon failed at {0}; its log says more")]
    Internal(&'static str),
}

#[cfg(test)]
impl Error {
    /// Message and advice of a push that failed.
    pub(crate) fn words(self) -> String {
        let Error::Failed { message, next, .. } = self else {
            panic!("{self} is no failed push");
        };
        format!("{message}; {}", next.unwrap_or_default())
    }
}
