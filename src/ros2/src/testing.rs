//! Helpers for the tests of this module.

use std::sync::Arc;

use ros_bus::JoinOptions;
use ros_bus::net::HostSockets;

use super::Ros2Bus;

/// Returns a domain of this process for the test with this number; other tests may run on this machine.
pub(crate) fn domain(number: u16) -> u16 {
    let offset = std::process::id().wrapping_mul(37);
    // Beyond domain 101 the ports are in the ephemeral range.
    (offset.wrapping_add(u32::from(number)) % 102) as u16
}

/// Creates a node of this name in the domain with this number.
pub(crate) async fn join(number: u16, node: &str) -> Arc<Ros2Bus> {
    let options = JoinOptions::in_domain(domain(number), node);
    let joined = Ros2Bus::connect(Arc::new(HostSockets), options).await;
    joined.expect("a domain can be joined")
}
