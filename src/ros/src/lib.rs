//! The ROS side of Cloudroid, without anything about containers: message schemas, codecs between serialized messages
//! and JSON or CBOR, and the buses that carry them.
//!
//! In: definitions (`.msg`, `.srv`, `.action` texts) and sockets from a [`net::Sockets`]. Out: a [`bus::Bus`] on which
//! serialized messages are published, received and answered.

pub mod bag;
pub mod bus;
mod cbor_head;
pub mod codec;
mod connect;
pub mod flavour;
mod identity;
mod join;
pub mod net;
mod network;
pub mod plumbing;
pub mod remaps;
pub mod ring;
pub mod ros1;
pub mod ros2;
pub mod schema;
pub mod sizes;
mod succession;
pub mod turns;

pub use connect::connect;
pub use join::JoinOptions;
pub use network::{DiscoveryNetwork, DiscoveryServer, InterfaceAddress, InterfaceSelection};
pub use succession::{ParticipantPrefix, Succession};
