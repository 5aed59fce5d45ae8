//! What the tests of this module share.

use std::sync::Arc;

use super::Ros2Bus;
use crate::JoinOptions;
use crate::net::HostSockets;

/// A domain of this process, for the test that has this number; others may be testing on this machine.
pub(crate) fn domain(number: u16) -> u16 {
    let offset = std::process::id().wrapping_mul(37);
    // Beyond 101 the ports of a domain are among those that the kernel gives away.
    (offset.wrapping_add(u32::from(number)) % 102) as u16
}

/// A node of this name in the domain with this number.
pub(crate) async fn join(number: u16, node: &str) -> Arc<Ros2Bus> {
    let options = JoinOptions::in_domain(domain(number), node);
    let joined = Ros2Bus::connect(Arc::new(HostSockets), options).await;
    joined.expect("a domain can be joined")
}
