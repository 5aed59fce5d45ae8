//! Starts servants. In: a [`spec::Spec`]. Out: a [`endpoint::Endpoint`] to reach its nodes by, and a watch
//! channel of states. Knows nothing of ROS and nothing of robots.
//!
//! ```text
//!   daemon                     shim (one per servant, outlives the daemon)        container
//!   LocalEngine --spawn-----> begin, fork --> creator: layers, libcontainer -----> init (pid 1, static)
//!   LocalServant <-shim.sock-> drive <------------- SEQPACKET ------------------->  |- node
//!   NetNs  ---------------- sockets opened in the servant's namespace ---------->   `- node
//! ```
//!
//! States of a container: `Creating -> Running -> Stopped | Failed`, or `Creating -> Failed`.

pub mod bundle;
pub mod cgroup;
pub mod endpoint;
pub mod engine;
mod error;
pub mod host;
pub mod idmap;
pub mod launch;
pub mod local;
pub mod logs;
pub mod netns;
pub mod process;
pub mod protocol;
pub mod rootfs;
pub mod seccomp;
pub mod shim;
pub mod spec;
mod sys;
pub mod uids;

pub use error::Error;
