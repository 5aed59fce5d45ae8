//! The ROS 2 bus with nodes of rclpy on Fast DDS, and with Cyclone DDS, in a network namespace like a servant's.

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
mod suite;
mod topics;
