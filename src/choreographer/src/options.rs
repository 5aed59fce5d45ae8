use std::collections::BTreeMap;
use std::time::Duration;

use api::{Caps, Limits, Sla};
use bridge::BridgeOptions;

use crate::memory::MemoryOptions;

/// What is done about nodes that are given inputs and answer none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Hung {
    /// Hung nodes are left alone, and no event says so.
    Ignore,
    /// An event says so.
    #[default]
    Report,
    /// An event says so, and the nodes are started again.
    Restart,
}

/// What the operator decides of servants.
#[derive(Debug, Clone)]
pub struct Options {
    /// Limits of a servant where its push says nothing.
    pub limits: Limits,
    /// Classes that robots may name, by name. [`DEFAULT_CLASS`] is that of robots that name none.
    pub classes: BTreeMap<String, Class>,
    /// Cores that there are for servants, whatever is promised of them.
    pub cores: f64,
    /// Cores are moved between servants while they work.
    pub controller: bool,
    /// Cores promised to a servant whose push asked for none.
    pub reserve_cpus: f64,
    /// Bytes of memory promised to a servant whose push asked for none.
    pub reserve_memory: u64,
    /// How long a robot may wait for room.
    pub deadline: Duration,
    /// How long a servant may take from its request to ready.
    pub start: Duration,
    /// How long a robot's servant is kept after its last connection.
    pub grace: Duration,
    /// The same for connections that named no robot.
    pub anonymous_grace: Duration,
    /// Most services that have containers made ahead.
    pub warm_pool: usize,
    /// Bytes that all those containers may take.
    pub warm_memory: u64,
    /// Most of them in which the nodes run.
    pub warm_nodes: usize,
    /// What is done about nodes that hang.
    pub hung: Hung,
    /// They hang that answer nothing for so many times T_max.
    pub hung_after: f64,
    /// Sessions of rosbridge before each servant.
    pub bridge: BridgeOptions,
    /// Memory held for clients and servants.
    pub memory: MemoryOptions,
}

/// The class of robots that name none, where it is configured.
pub const DEFAULT_CLASS: &str = "default";

/// A class of robots.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Class {
    /// Who has the greater one is served first; 0 without a class.
    pub priority: i32,
    /// What its robots may ask for.
    pub caps: Caps,
    /// The SLA of robots that state neither one nor resources.
    pub sla: Sla,
    /// Limits where neither the robot nor the push says anything.
    pub limits: Limits,
}
