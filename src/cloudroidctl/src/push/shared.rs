//! Flags of a service whose servants robots share.

use api::Shared;

/// Settings for sharing the servants of a service.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct SharedFlags {
    /// Robots share the service's servants: each call and goal goes to the servant with the fewest. Only for packages
    /// with services and actions that keep no state between requests; others are refused.
    #[arg(long, conflicts_with = "stateful")]
    shared: bool,
    /// Smallest number of servants while a robot uses the service (default: 1).
    #[arg(long, value_name = "N", requires = "shared")]
    min: Option<u32>,
    /// Largest number of servants (default: 4).
    #[arg(long, value_name = "M", requires = "shared")]
    max: Option<u32>,
    /// Requests may be executed twice: a request whose servant was lost is repeated on another.
    #[arg(long, requires = "shared")]
    idempotent: bool,
    /// Number of servants that execute each call, of which the first answer is used; implies --idempotent, and --min of
    /// at least N.
    #[arg(long, value_name = "N", requires = "shared")]
    replicas: Option<u32>,
    /// Largest number of concurrent calls per servant (default: 8); further calls wait for the first free servant.
    #[arg(long, value_name = "N", requires = "shared")]
    calls: Option<u32>,
}

impl SharedFlags {
    /// Returns the settings, if `--shared` is given.
    pub fn shared_settings(&self) -> Option<Shared> {
        let fine = Shared::default();
        let replicas = self.replicas.unwrap_or(fine.replicas);
        let min = self.min.unwrap_or(fine.min.max(replicas));
        self.shared.then(|| Shared {
            min,
            max: self.max.unwrap_or(fine.max.max(min)),
            idempotent: self.idempotent || replicas > 1,
            replicas,
            calls: self.calls.unwrap_or(fine.calls),
        })
    }
}
