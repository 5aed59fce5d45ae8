//! Sessions over a bus whose actions are its own, and that has no global parameters.

#[path = "actions.rs"]
mod actions;
#[path = "bad_input.rs"]
mod bad_input;
#[path = "granted.rs"]
mod granted;
#[path = "manners.rs"]
mod manners;
#[path = "memory.rs"]
mod memory;
#[path = "publishing.rs"]
mod publishing;
#[path = "requests.rs"]
mod requests;
#[path = "resuming.rs"]
mod resuming;
#[path = "rosapi.rs"]
mod rosapi;
#[path = "services.rs"]
mod services;
#[path = "subscribing.rs"]
mod subscribing;
#[path = "transforms.rs"]
mod transforms;
#[path = "waiting.rs"]
mod waiting;
#[path = "without_parameters.rs"]
mod without_parameters;

mod support {
    pub use crate::support::*;

    pub type World = crate::support::World<std::sync::Arc<crate::memory_bus::MemorySystem>>;
}
