//! The principal that pushes.

use futures_util::future::BoxFuture;

use crate::Error;

/// Checks whether a service name may be published; fails with [`Error::NotAllowed`] if not.
type PublishCheck = dyn Fn(&str) -> Result<(), Error> + Send + Sync;

/// Returns whether a service may be seen.
type SightCheck = dyn Fn(&str) -> bool + Send + Sync;

/// Checks whether an underlay of this name, and with this owner if it exists, may be used so.
type UnderlayCheck = dyn Fn(UnderlayUse, &str, Option<Option<&str>>) -> Result<(), Error> + Send + Sync;

/// Use of an underlay by a principal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnderlayUse {
    /// Builds upon it, or sees it in a list: what seeing a service of its name takes.
    StandOn,
    /// Publishes or removes it: what publishing a service of its name takes.
    Publish,
}

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
    /// Returns whether it may see a service.
    pub may_see: Box<SightCheck>,
    /// Check of the use of underlays.
    pub may_use_underlay: Box<UnderlayCheck>,
    /// Resolves with the reason when its credentials are no longer valid.
    pub over: Box<Revocation>,
}

impl Deployer {
    pub(super) fn check_may_publish(&self, name: &str) -> Result<(), Error> {
        (self.may)(name)
    }
}
