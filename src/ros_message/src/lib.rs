//! Messages of either ROS version: their definitions, the conversion between serialized messages and JSON or CBOR, and
//! the sizes of messages. It has no sockets, and knows nothing of topics and services.

mod cbor_head;
pub mod codec;
pub mod schema;
pub mod sizes;
mod version;

pub use version::RosVersion;
