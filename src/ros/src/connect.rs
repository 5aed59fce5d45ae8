//! The one place where a bus is made.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use budget::Budget;

use crate::bus::{Bus, BusError, RosVersion};
use crate::net::Sockets;
use crate::ros1::{Ros1Bus, tcpros};

/// How to join a ROS system.
#[derive(Debug, Clone)]
pub struct JoinOptions {
    /// Where the Master listens, as seen from the sockets' place (ROS 1).
    pub master: SocketAddr,
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
}

impl JoinOptions {
    /// A node of this name at this Master.
    pub fn new(master: SocketAddr, node: &str) -> Self {
        Self {
            master,
            node: node.to_owned(),
            host: None,
            max_message: tcpros::MAX_MESSAGE,
            budget: Budget::unlimited(),
            unfinished: tcpros::UNFINISHED,
        }
    }
}

/// Joins a ROS system of this version.
pub async fn connect(
    version: RosVersion,
    sockets: Arc<dyn Sockets>,
    options: JoinOptions,
) -> Result<Arc<dyn Bus>, BusError> {
    match version {
        RosVersion::One => Ok(Ros1Bus::connect_with(sockets, options).await?),
        RosVersion::Two => Err(BusError::NoSuchRos(version.number())),
    }
}
