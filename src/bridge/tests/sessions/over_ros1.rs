//! Sessions over ROS 1.

#[path = "actions.rs"]
mod actions;
#[path = "actions_by_topics.rs"]
mod actions_by_topics;
#[path = "bad_input.rs"]
mod bad_input;
#[path = "definitions.rs"]
mod definitions;
#[path = "granted.rs"]
mod granted;
#[path = "manners.rs"]
mod manners;
#[path = "memory.rs"]
mod memory;
#[path = "parameters.rs"]
mod parameters;
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
#[path = "transforms_by_topics.rs"]
mod transforms_by_topics;
#[path = "waiting.rs"]
mod waiting;

mod support {
    pub use crate::support::*;

    pub type World = crate::support::World<Ros1>;
}
