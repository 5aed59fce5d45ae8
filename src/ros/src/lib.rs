//! The ROS side of Cloudroid, without anything about containers: one name for the crates below it, and what is decided
//! by the ROS version.
//!
//! In: definitions (`.msg`, `.srv`, `.action` texts) and sockets from a [`net::Sockets`]. Out: a [`bus::Bus`] on which
//! serialized messages are published, received and answered.
//!
//! ```text
//!                    ros      connect, flavour, remaps, spelling, plumbing, bag
//!                   ╱   ╲
//!               ros1     ros2      protocols: Master and TCPROS; DDS by the crate rtps
//!                   ╲   ╱
//!                  ros_bus         the interface of a bus, queues, sockets
//!                     │
//!                ros_message       definitions, codecs, sizes
//! ```

pub mod bag;
mod connect;
pub mod flavour;
pub mod plumbing;
pub mod remaps;
pub mod spelling;

pub use connect::connect;
pub use ros_bus as bus;
pub use ros_bus::{
    DiscoveryNetwork, DiscoveryServer, InterfaceAddress, InterfaceSelection, JoinOptions, ParticipantPrefix,
    Succession, net, ring, turns,
};
pub use ros_message::{codec, schema, sizes};
pub use ros1;
pub use ros2;
