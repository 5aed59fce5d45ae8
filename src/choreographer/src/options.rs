use std::time::Duration;

use api::Limits;
use bridge::BridgeOptions;

use crate::memory::MemoryOptions;

/// What the operator decides of servants.
#[derive(Debug, Clone)]
pub struct Options {
    /// Limits of a servant where its push says nothing.
    pub limits: Limits,
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
    /// Most containers made ahead, without nodes.
    pub warm_pool: usize,
    /// Sessions of rosbridge before each servant.
    pub bridge: BridgeOptions,
    /// Memory held for clients and servants.
    pub memory: MemoryOptions,
}
