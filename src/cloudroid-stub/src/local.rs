//! The local original: the package's own executable on the robot, run by the stub when the cloud is too slow.
//!
//! ```text
//!   application ─▶ Keeper ─┬─▶ cloud (link) ──────────────────────┐
//!        ▲         │       └─▶ Original: private system ─▶ process ┤
//!        └─────────┴──────────── first answer ◀───────────────────┘
//! ```
//! The process lives in a ROS system of its own, on loopback: a Master inside the stub with a copy of the robot's parameters
//! (ROS 1), or a domain that nobody else is in (ROS 2). So it keeps its names, remaps and namespace, none of its topics, tf or logs can reach the robot's
//! graph except through the [`Keeper`], and it is given no backlog. See docs/adr/015-a-master-for-the-local-original.md.

mod keeper;
mod latched;
mod lender;
mod original;
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

pub use keeper::{Answer, Application, Cloud, Keeper};
pub use lender::{limit, took_too_long};
pub use original::{Interface, Original, QUEUE, Setting};
#[cfg(test)]
pub use private_domain::PrivateDomain;
pub use private_system::Registered;
pub use process::Program;
pub use service_use::ServiceUse;
pub use stamp::is_stamped;
