//! ROS 2: the bus over DDS, which is provided by the crate `rtps`.
//!
//! What ROS defines above its middleware does not name `rtps`: actions, parameters, lifecycles, composition, command
//! lines. It is built on [`Bus`](ros_bus::Bus) and the modules `calls`, `services` and `raw`. The other modules carry
//! ROS 2 over DDS.

pub mod actions;
pub mod arguments;
mod bus;
mod calls;
mod client;
pub mod composition;
mod ends;
mod entities;
mod graph;
pub mod interfaces;
mod lending;
pub mod lifecycle;
pub mod middleware;
pub mod names;
mod node_ends;
mod other_types;
pub mod parameters;
mod place;
pub mod process;
mod publications;
mod quality;
mod raw;
mod replies;
mod request_header;
mod seen;
mod services;
mod show;
mod state;
mod subscriptions;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
mod topic_in;
mod topic_type;
mod type_hash;
mod watcher;

pub use bus::Ros2Bus;
