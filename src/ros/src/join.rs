//! How to join a ROS system.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use budget::Budget;

use crate::network::Network;
use crate::succession::Succession;

/// A message longer than this ends its connection, unless set otherwise.
pub const MAX_MESSAGE: usize = 256 << 20;
/// A message that was begun and is not whole after this time ends its connection, unless set otherwise.
pub const UNFINISHED: Duration = Duration::from_secs(300);

/// How to join a ROS system.
#[derive(Debug, Clone)]
pub struct JoinOptions {
    /// Where the Master listens, as seen from the sockets' place (ROS 1).
    pub master: SocketAddr,
    /// `ROS_DOMAIN_ID` (ROS 2): 0 to 232.
    pub domain: u16,
    /// What `$ROS_DISTRO` stands for (ROS 2, which does not tell it); may be empty.
    pub distribution: String,
    /// Where other nodes are (ROS 2).
    pub network: Network,
    /// The node's absolute name.
    pub node: String,
    /// The host that other nodes reach this one under; the address used towards the Master where `None`.
    pub host: Option<String>,
    /// A message longer than this ends its connection.
    pub max_message: usize,
    /// Where what is read from nodes counts until it is whole; what does not fit ends its connection.
    pub budget: Budget,
    /// A message that was begun and is not whole after this time ends its connection.
    pub unfinished: Duration,
    /// In whose place it comes (ROS 2); in nobody's where there is none.
    pub succession: Option<Arc<dyn Succession>>,
}

impl JoinOptions {
    /// A node of this name at this Master (ROS 1), in domain 0 (ROS 2).
    pub fn new(master: SocketAddr, node: &str) -> Self {
        Self {
            master,
            domain: 0,
            network: Network::default(),
            distribution: String::new(),
            node: node.to_owned(),
            host: None,
            max_message: MAX_MESSAGE,
            budget: Budget::unlimited(),
            unfinished: UNFINISHED,
            succession: None,
        }
    }

    /// A node of this name in this domain (ROS 2).
    pub fn in_domain(domain: u16, node: &str) -> Self {
        Self {
            domain,
            ..Self::new(SocketAddr::from(([0, 0, 0, 0], 0)), node)
        }
    }
}
