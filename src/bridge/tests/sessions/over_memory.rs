//! Sessions over an in-memory bus of ROS 2.

#[path = "actions.rs"]
mod actions;
#[path = "bad_input.rs"]
mod bad_input;
#[path = "granted.rs"]
mod granted;
#[path = "headers.rs"]
mod headers;
#[path = "manners.rs"]
mod manners;
#[path = "memory.rs"]
mod memory;
#[path = "node_parameters.rs"]
mod node_parameters;
#[path = "publishing.rs"]
mod publishing;
#[path = "qualities.rs"]
mod qualities;
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
#[path = "without_definitions.rs"]
mod without_definitions;

mod support {
    pub use crate::support::*;

    pub type World = crate::support::World<std::sync::Arc<crate::memory_bus::MemorySystem>>;
}
