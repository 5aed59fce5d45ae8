use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use api::{Caps, Limits, Sla};
use bridge::BridgeOptions;

use crate::decide::quota::Quota;
use crate::memory::MemoryOptions;
use crate::tracer::RequestTracer;

/// Reaction to nodes that receive inputs and answer none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum HungPolicy {
    /// Hung nodes are ignored, without an event.
    Ignore,
    /// An event is reported.
    #[default]
    Report,
    /// An event is reported, and the nodes are restarted.
    Restart,
}

/// The operator's options for servants.
#[derive(Debug, Clone)]
pub struct Options {
    /// Limits of servants whose push states none.
    pub limits: Limits,
    /// Classes that robots may name, by name. [`DEFAULT_CLASS`] applies to robots that name none.
    pub classes: BTreeMap<String, ClassOptions>,
    /// Cores available to servants, whatever is promised of them.
    pub cores: f64,
    /// Move cores between running servants.
    pub controller: bool,
    /// Cores promised to a servant whose push requested none.
    pub reserve_cpus: f64,
    /// Bytes of memory promised to a servant whose push requested none.
    pub reserve_memory: u64,
    /// Maximum time that a robot waits for capacity.
    pub deadline: Duration,
    /// Maximum time from a servant's request until it is ready.
    pub start: Duration,
    /// Time for which a robot's servant is kept after its last connection.
    pub grace: Duration,
    /// Grace time of connections without a robot's name.
    pub anonymous_grace: Duration,
    /// Maximum number of services with containers made in advance.
    pub warm_pool: usize,
    /// Maximum memory of all those containers, in bytes.
    pub warm_memory: u64,
    /// Maximum number of them with running nodes.
    pub warm_nodes: usize,
    /// Reaction to hung nodes.
    pub hung: HungPolicy,
    /// Multiple of T_max without an answer after which nodes count as hung.
    pub hung_after: f64,
    /// Options of the rosbridge sessions of each servant.
    pub bridge: BridgeOptions,
    /// Limits on the memory held for clients and servants.
    pub memory: MemoryOptions,
    /// Limits on the logs of ended servants.
    pub kept_logs: KeptLogOptions,
    /// Makes traces of robots' requests.
    pub tracer: Option<Arc<dyn RequestTracer>>,
}

/// Limits on the logs of ended servants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct KeptLogOptions {
    /// Time for which a log is kept after the end of its servant; zero keeps none.
    pub age: Duration,
    /// Largest number and size of all logs together.
    pub quota: Quota,
}

/// Name of the class of robots that name none, if it is configured.
pub const DEFAULT_CLASS: &str = "default";

/// A class of robots.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ClassOptions {
    /// Priority: greater ones are served first (0 without a class).
    pub priority: i32,
    /// Caps on what its robots may request.
    pub caps: Caps,
    /// SLA of robots that state neither an SLA nor resources.
    pub sla: Sla,
    /// Limits if neither the robot nor the push states any.
    pub limits: Limits,
}
