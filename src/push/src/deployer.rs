//! The principal that pushes.

use futures_util::future::BoxFuture;

use crate::Error;

/// Checks whether a service name may be published; fails with [`Error::NotAllowed`] if not.
type PublishCheck = dyn Fn(&str) -> Result<(), Error> + Send + Sync;

/// Future that resolves with the reason when the deployer's credentials are revoked.
type Revocation = dyn Fn() -> BoxFuture<'static, String> + Send + Sync;

/// Principal that pushes.
pub struct Deployer {
    /// Name of the principal.
    pub name: String,
    /// Owner of services that are published for the first time; `None` for operators.
    pub owner: Option<String>,
    /// Check of the services that it may publish.
    pub may: Box<PublishCheck>,
    /// Resolves with the reason when its credentials are no longer valid.
    pub over: Box<Revocation>,
}

impl Deployer {
    pub(super) fn check_may_publish(&self, name: &str) -> Result<(), Error> {
        (self.may)(name)
    }
}
