//! Status of a link.

use link::control::{IncompatibleEndpoint, RequestTiming, SlaTargets};
use link::drops::TopicDropCount;

/// Status of a link, for explanations.
#[derive(Debug, Clone)]
pub struct LinkStatus {
    /// Session id.
    pub session: String,
    /// Name of the node.
    pub node: String,
    /// A connection exists and is not silent.
    pub up: bool,
    /// Last round-trip time in milliseconds.
    pub round_trip: Option<f64>,
    /// The robot's clock minus ours in milliseconds.
    pub clock: Option<f64>,
    /// Downlink throughput in bytes per second, measured while the link was busy.
    pub throughput: Option<f64>,
    /// Messages dropped in the cloud.
    pub drops: Vec<TopicDropCount>,
    /// Messages dropped on the robot, as reported by its stub.
    pub dropped: Vec<TopicDropCount>,
    /// Service-level objectives requested by the robot.
    pub sla: SlaTargets,
    /// Last requests as reported by the robot, oldest first.
    pub requests: Vec<RequestTiming>,
    /// Number of messages that the robot did not send in the last minute because newer ones had arrived or they were
    /// too old.
    pub unsent: u64,
    /// Number of recent inputs with a stamp that were given to the node.
    pub given: usize,
    /// Number of those that the node has skipped by answering later ones first.
    pub left_out: usize,
    /// Topics to which the node subscribes and that nobody on the robot and no other node of the servant publishes.
    pub unfed: Vec<String>,
    /// Services that the node has looked up in vain and that are not known to exist now.
    pub unserved: Vec<String>,
    /// Incompatible endpoints on the robot, as reported by its stub.
    pub refused: Vec<IncompatibleEndpoint>,
    /// Other machines connected as the same robot.
    pub duplicates: Vec<String>,
}
