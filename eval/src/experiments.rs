//! The experiments, one file each: how they are measured, and their sections of the report.

pub mod codecs;
pub mod cores;
pub mod crowd;
pub mod failover;
pub mod map;
pub mod memory;
pub mod neighbours;
pub mod outsourcing;
pub mod overhead;
pub mod scale;
pub mod transparency;
