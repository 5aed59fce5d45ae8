//! Creation of a bus for a ROS version.

use std::sync::Arc;

use crate::JoinOptions;
use crate::bus::{Bus, BusError, RosVersion};
use crate::net::Sockets;
use crate::ros1::Ros1Bus;
use crate::ros2::Ros2Bus;

/// Joins a ROS system of this version.
pub async fn connect(
    version: RosVersion,
    sockets: Arc<dyn Sockets>,
    options: JoinOptions,
) -> Result<Arc<dyn Bus>, BusError> {
    match version {
        RosVersion::One => Ok(Ros1Bus::connect_with(sockets, options).await?),
        RosVersion::Two => Ok(Ros2Bus::connect(sockets, options).await?),
    }
}
