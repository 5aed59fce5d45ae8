//! The local original: the package's own executable on the robot, run by the stub when the cloud is too slow.
//!
//! ```text
//!   application ─▶ Keeper ─┬─▶ cloud (link) ──────────────────────┐
//!        ▲         │       └─▶ Original: private Master ─▶ process ┤
//!        └─────────┴──────────── first answer ◀───────────────────┘
//! ```
//! The process lives in a ROS system of its own: a Master inside the stub, on loopback, with a copy of the robot's
//! parameters. So it keeps its names, remaps and namespace, none of its topics, tf or logs can reach the robot's
//! graph except through the [`Keeper`], and it is given no backlog. See docs/adr/015-a-master-for-the-local-original.md.

mod keeper;
mod latched;
mod lender;
mod original;
mod private_master;
mod process;
mod stamp;
#[cfg(test)]
pub mod tests;

pub use keeper::{Application, Cloud, Keeper};
pub use lender::took_too_long;
pub use original::{Interface, Original, Setting};
pub use private_master::Registered;
pub use process::Program;
pub use stamp::is_stamped;
