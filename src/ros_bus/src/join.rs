//! Options for joining a ROS system.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use budget::Budget;

use crate::network::DiscoveryNetwork;
use crate::succession::Succession;

/// Default size limit of a message, in bytes; a longer one ends its connection.
pub const MAX_MESSAGE: usize = 256 << 20;
/// Default time limit for receiving a message once it has begun; exceeding it ends the connection.
pub const MESSAGE_TIMEOUT: Duration = Duration::from_secs(300);

/// Options for joining a ROS system.
#[derive(Debug, Clone)]
pub struct JoinOptions {
    /// Address of the Master, as seen from where the sockets are opened (ROS 1).
    pub master: SocketAddr,
    /// `ROS_DOMAIN_ID` (ROS 2): 0 to 232.
    pub domain: u16,
    /// Value of `$ROS_DISTRO`, which ROS 2 does not announce; may be empty.
    pub distribution: String,
    /// Discovery of other nodes (ROS 2).
    pub network: DiscoveryNetwork,
    /// Absolute name of the node.
    pub node: String,
    /// Host under which other nodes reach this one; `None` for the address used to connect to the Master.
    pub host: Option<String>,
    /// Size limit of a message, in bytes; a longer one ends its connection.
    pub max_message: usize,
    /// Budget for messages until they are complete; one that does not fit ends its connection.
    pub budget: Budget,
    /// Time limit for receiving a message once it has begun; exceeding it ends the connection.
    pub unfinished: Duration,
    /// Record of the participants that this one succeeds (ROS 2), if any.
    pub succession: Option<Arc<dyn Succession>>,
}

impl JoinOptions {
    /// Creates options for a node of this name, with this Master (ROS 1) or in domain 0 (ROS 2).
    pub fn new(master: SocketAddr, node: &str) -> Self {
        Self {
            master,
            domain: 0,
            network: DiscoveryNetwork::default(),
            distribution: String::new(),
            node: node.to_owned(),
            host: None,
            max_message: MAX_MESSAGE,
            budget: Budget::without_limit(),
            unfinished: MESSAGE_TIMEOUT,
            succession: None,
        }
    }

    /// Creates options for a node of this name in this domain (ROS 2).
    pub fn in_domain(domain: u16, node: &str) -> Self {
        Self { domain, ..Self::new(SocketAddr::from(([0, 0, 0, 0], 0)), node) }
    }
}
