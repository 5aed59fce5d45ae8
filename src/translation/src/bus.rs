//! The bus of a servant in the terms of the other ROS.

#[cfg(test)]
#[path = "../../../tests/support/memory_bus.rs"]
mod memory_bus;
pub mod parameters;
