//! In-memory implementations of the daemon's interfaces: an [`Engine`](servant::engine::Engine) whose servants are
//! tasks of this process, and an [`Opener`](reach::Opener) that reaches them. A closure, selected by the name of the
//! program, implements a node. With them the users of an engine can be tested without containers; the tests of the
//! host's engine check that containers behave in the same way.

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
