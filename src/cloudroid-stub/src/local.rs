//! The local original: the package's own executable on the robot, run by the stub when the cloud is too slow.
//!
//! ```text
//!   application ─▶ Keeper ─┬─▶ cloud (link) ──────────────────────┐
//!        ▲         │       └─▶ Original: private system ─▶ process ┤
//!        └─────────┴──────────── first answer ◀───────────────────┘
//! ```
//!
//! The process lives in a private ROS system on loopback: a Master inside the stub with a copy of the robot's
//! parameters (ROS 1), or a domain that no other node is in (ROS 2). So it keeps its names, remaps and namespace, none
//! of its topics, tf or logs can reach the robot's graph except through the [`Keeper`], and it receives no backlog. See
//! docs/adr/015-a-master-for-the-local-original.md.

mod expected;
mod keeper;
mod latched;
mod lender;
mod original;
mod pending_answer;
mod private_domain;
mod private_master;
mod private_system;
mod process;
mod reconfigured;
mod remembered;
mod service_use;
mod stamp;
#[cfg(test)]
pub mod tests;

pub use expected::ExpectedInterface;
pub use keeper::{Application, Cloud, Keeper, OutputTiming};
pub use lender::{call_limit_for, describe_failure};
pub use original::{Original, OriginalSetup, QUEUE};
pub use pending_answer::PendingAnswer;
#[cfg(test)]
pub use private_domain::PrivateDomain;
pub use private_system::RegisteredInterface;
pub use process::OriginalProgram;
pub use service_use::ServiceUse;
pub use stamp::is_stamped;
