//! The bus of ROS 2 with nodes of rclpy and Fast DDS, and with Cyclone DDS, in a network namespace as a servant has it.

mod actions;
mod cyclone;
mod lab;
mod lifecycle;
mod parameters;
mod services;
mod topics;
