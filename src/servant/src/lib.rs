//! Starts servants. In: a [`spec::Spec`]. Out: a [`endpoint::Endpoint`] to reach its nodes by, and a watch
//! channel of states. Knows nothing of ROS and nothing of robots.

pub mod endpoint;
pub mod engine;
mod error;
pub mod local;
pub mod netns;
pub mod shim;
pub mod spec;

pub use error::Error;
