//! Sessions as seen by clients and nodes of a bridge, with clients that use another WebSocket implementation than the
//! bridge: over ROS 1 (a real Master, a real node on its own bus, real TCPROS on loopback), and over an in-memory bus
//! that behaves like ROS 2, with its messages. Sessions over ROS 2 itself, with nodes of rclpy, are in
//! `src/reach/tests/ros2/rosbridge.rs`.

// The same tests, for both versions of ROS.
#![allow(clippy::duplicate_mod)]

#[path = "../../../../tests/support/memory_bus.rs"]
mod memory_bus;
mod over_memory;
mod over_ros1;
mod support;
