//! The seams of the daemon, in memory: an [`Engine`](servant::engine::Engine) whose servants are tasks of this process, and an
//! [`Opener`](reach::Opener) that reaches them. What a node does is told by a closure, by the name of its program. With them
//! the stories of whoever uses an engine can be told without a container; that containers do the same is told by the tests of
//! the engine of this host.

#![forbid(unsafe_code)]

mod engine;
#[path = "../../memory_bus.rs"]
mod memory_bus;
mod process;
mod reached;
mod servants;

pub use engine::MemoryEngine;
pub use process::Process;
pub use servants::MemoryServant;
