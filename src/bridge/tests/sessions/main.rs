//! What clients and nodes see of a bridge, with clients that speak WebSocket by another implementation than the bridge's:
//! over ROS 1 (a real Master, a real node on its own bus, real TCPROS on loopback), and over a bus in memory that behaves as
//! ROS 2 does, with its messages. Sessions over ROS 2 itself, with nodes of rclpy, are in `src/reach/tests/ros2/rosbridge.rs`.

// The same tests, for two ROSes.
#![allow(clippy::duplicate_mod)]

#[path = "../../../../tests/support/memory_bus.rs"]
mod memory_bus;
mod over_memory;
mod over_ros1;
mod support;
