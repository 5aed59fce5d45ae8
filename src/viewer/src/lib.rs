//! Serves viewers (Foxglove, Lichtblick) on a servant's ROS, over version 1 of Foxglove's WebSocket protocol. The
//! crate `foxglove` parses and writes the protocol's messages; ROS 1 and ROS 2 payloads pass through unchanged.
//!
//! ```text
//!   graph ──▶ catalogue ──advertise──▶ ┐                ┌──▶ publisher ──▶ bus
//!   bus ──▶ subscription ──▶ queue ──▶ ├─▶ viewer ─▶ its requests ──▶ call ──▶ bus
//!          keeps newest      16        ┘                └──▶ parameters
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

pub use session::{DEPTH, PROTOCOLS, ViewedServant, ViewerOptions, serve};
