//! ROS 1: XML-RPC, Master, TCPROS and the bus made of them.

mod bus;
pub mod master;
pub mod names;
mod reply;
#[cfg(test)]
mod testing;
pub mod tcpros;
pub mod xmlrpc;

pub use bus::{Ros1Bus, Ros1Options};
