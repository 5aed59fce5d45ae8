//! How a link is doing.

use link::control::{Refused, Request, Sla};
use link::drops::Drop;

/// How a link is doing, for whoever explains.
#[derive(Debug, Clone)]
pub struct LinkStatus {
    /// The node.
    pub node: String,
    /// Its connection is there and not silent.
    pub up: bool,
    /// Last round trip, milliseconds.
    pub round_trip: Option<f64>,
    /// The robot's clock minus ours, milliseconds.
    pub clock: Option<f64>,
    /// Bytes per second downwards, when it had to hurry.
    pub throughput: Option<f64>,
    /// Messages that were dropped in the cloud.
    pub drops: Vec<Drop>,
    /// Messages dropped on the robot, as its stub reported.
    pub dropped: Vec<Drop>,
    /// What the robot asked for.
    pub sla: Sla,
    /// Its last requests, as it told them, oldest first.
    pub requests: Vec<Request>,
    /// Messages that the robot did not send in the last minute, since newer ones had come or they were too old.
    pub unsent: u64,
    /// The number of the last inputs that the node was given and that have a stamp.
    pub given: usize,
    /// Of these, the inputs that it has left out: it answered later ones first.
    pub left_out: usize,
    /// Topics that the node listens to and nobody on the robot, and no other node of the servant, publishes.
    pub unfed: Vec<String>,
    /// Services that the node has looked for in vain, and that are not known to be there now.
    pub unserved: Vec<String>,
    /// Ends on the robot with which no messages pass, as its stub reported.
    pub refused: Vec<Refused>,
    /// Other machines that are connected as the same robot.
    pub duplicates: Vec<String>,
}
