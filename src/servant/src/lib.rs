//! Starts servants. In: a [`spec::Spec`]. Out: a [`endpoint::Endpoint`] to reach its nodes by, and a watch
//! channel of states. Knows nothing of ROS and nothing of robots.

pub mod endpoint;
pub mod engine;
pub mod spec;
