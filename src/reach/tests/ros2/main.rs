//! The bus of ROS 2 with nodes of rclpy and Fast DDS, and with Cyclone DDS, in a network namespace as a servant has it.

mod actions;
mod cyclone;
mod killed;
mod lab;
mod lifecycle;
mod links;
mod network;
mod network_pictures;
mod parameters;
mod pictures;
mod processes;
mod robot;
mod rosbridge;
mod servers;
mod services;
mod succession;
mod topics;
