//! Flags of a service that robots share.

use api::Shared;

/// How robots share a service.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct SharedFlags {
    /// Robots share the service's servants: each call and each goal goes to the one with the fewest. For packages that
    /// answer services and actions and keep nothing of what they are asked; others are refused.
    #[arg(long, conflicts_with = "stateful")]
    shared: bool,
    /// Servants that there are at least while a robot uses the service; 1 by default.
    #[arg(long, value_name = "N", requires = "shared")]
    min: Option<u32>,
    /// Servants that there are at most; 4 by default.
    #[arg(long, value_name = "M", requires = "shared")]
    max: Option<u32>,
    /// A request may be carried out twice: one whose servant was lost is asked again at another.
    #[arg(long, requires = "shared")]
    idempotent: bool,
    /// So many servants work at the same call, and the first answer is taken; implies --idempotent, and --min as many.
    #[arg(long, value_name = "N", requires = "shared")]
    replicas: Option<u32>,
    /// Calls that one servant has under way at most, 8 by default; the rest wait for whichever is free first.
    #[arg(long, value_name = "N", requires = "shared")]
    calls: Option<u32>,
}

impl SharedFlags {
    /// What they ask for, if anything.
    pub fn asked(&self) -> Option<Shared> {
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
