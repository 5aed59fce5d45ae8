//! Viewers (Foxglove, Lichtblick) on a servant's ROS: version 1 of Foxglove's WebSocket protocol, whose messages the crate `foxglove`
//! reads and writes. Messages of ROS 1 and of ROS 2 pass as the bytes that they are.
//!
//! ```text
//!   graph ──▶ catalogue ──advertise──▶ ┐                ┌──▶ publisher ──▶ bus
//!   bus ──▶ subscription ──▶ queue ──▶ ├─▶ viewer ─▶ what it asks ──▶ call ──▶ bus
//!           newest win       16        ┘                └──▶ parameters
//! ```

#![deny(unsafe_code)]

mod catalogue;
mod format;
mod line;
mod parameters;
mod session;

#[cfg(test)]
#[path = "../../../tests/support/memory_bus.rs"]
mod memory_bus;
#[cfg(test)]
mod tests;

pub use session::{DEPTH, PROTOCOLS, Servant, ViewerOptions, serve};
