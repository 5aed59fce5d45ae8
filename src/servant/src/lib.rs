//! Starts servants. The interface is [`engine`]: an engine gets a [`spec::Spec`] and returns a
//! [`engine::ServantHandle`], whose state, nodes and log can be watched. All other modules belong to the engine of this
//! host ([`local::LocalEngine`]); its additional features (pids, network namespaces, [`sandbox`]es for builds) are on
//! its own types. Independent of ROS and of robots.
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
pub mod container;
pub mod engine;
mod error;
pub mod exec;
mod grant_error;
pub mod host;
pub mod idmap;
pub mod launch;
pub mod local;
pub mod logs;
pub mod netns;
pub mod process;
pub mod protocol;
pub mod quotas;
pub mod rootfs;
pub mod sandbox;
pub mod seccomp;
pub mod shim;
pub mod spec;
mod sys;
pub mod uids;

pub use error::Error;
