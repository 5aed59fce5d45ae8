//! ROS 1: XML-RPC, the Master, TCPROS, and the bus built on them.

pub mod actions;
mod bus;
pub mod master;
pub mod names;
pub mod own_parameters;
pub mod process;
mod reply;
pub mod tcpros;
#[cfg(test)]
mod testing;
pub mod xmlrpc;

pub use bus::Ros1Bus;
