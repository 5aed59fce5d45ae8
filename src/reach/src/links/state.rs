//! State of a hub and of its links.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, OnceLock, Weak};
use std::time::Duration;

use budget::{Budget, Permit};
use link::Echoes;
use link::control::{FromRobot, IncompatibleEndpoint, SlaTargets};
use link::drops::{DropCounters, TopicDropCount};
use link::record::Record;
use link::session::CloudSession;
use link::skew::Skew;
use parking_lot::Mutex;
use ros::bus::{Bus, ParamValue};
use ros::codec::Stamps;
use ros::ring::Ring;
use ros::schema::Registry;
use ros::sizes::{InputSizes, SizeCounters};
use tokio::sync::{OnceCell, mpsc, watch};
use tokio::task::AbortHandle;
use tracing::Span;
use translation::TranslationRules;

use super::attempts::Attempts;
use super::inputs::InputChannels;
use super::lent_services::RobotServices;
use super::nodes::NodeController;
use super::outputs::Outputs;
use super::requests::RequestLog;
use super::turns::NodeTurns;
use super::types::TypeDefinitions;
use super::unsent::UnsentCounter;

/// Options of a hub.
#[derive(Debug, Clone)]
pub struct HubOptions {
    /// Time for which a link outlives its connection.
    pub grace: Duration,
    /// Timeout of service calls.
    pub call_timeout: Duration,
    /// Time for which first messages wait until the node connects to their topic.
    pub warm_up: Duration,
    /// Budget for incomplete frames and records of robots; one that does not fit ends its connection.
    pub budget: Budget,
    /// Time after which an incomplete frame ends its connection.
    pub unfinished: Duration,
    /// Rules for types whose counterparts in the other ROS are not obvious.
    pub rules: Arc<TranslationRules>,
}

/// The links of one servant.
pub struct Hub {
    pub(super) servant: String,
    /// The servant's own bus; links use their robot's [`ServantView`].
    pub(super) bus: Arc<dyn Bus>,
    pub(super) registry: Arc<Registry>,
    /// View of robots with the servant's ROS.
    pub(super) own_view: Arc<ServantView>,
    /// View of robots with the other ROS, once there was one.
    pub(super) other_view: OnceLock<Arc<ServantView>>,
    pub(super) nodes: Arc<dyn NodeController>,
    pub(super) options: HubOptions,
    /// Span of the log about the servant, in which the hub was created.
    pub(super) log_span: Span,
    pub(super) links: Mutex<BTreeMap<String, Arc<NodeLink>>>,
    /// Incremented when links are added or removed or change their subscriptions.
    pub(super) changes: watch::Sender<u64>,
    /// Serializes the start and end of links per node.
    pub(super) turns: NodeTurns,
    /// Set once services of the robot are being lent.
    pub(super) lends: OnceCell<()>,
    /// Difference between the robot's clock and ours.
    pub(super) skew: Skew,
    pub(super) attempts: Attempts,
    /// Pairs of machines that were warned of each other.
    pub(super) duplicates: Mutex<BTreeSet<(String, String)>>,
    /// Sizes of what robots send to nodes.
    pub(super) inputs: InputSizes,
    pub(super) closed: watch::Sender<Option<String>>,
}

/// The servant as robots of one ROS version see it.
pub(super) struct ServantView {
    pub(super) bus: Arc<dyn Bus>,
    pub(super) types: TypeDefinitions,
    pub(super) parameters: Arc<ParameterMirror>,
}

/// A robot's node as seen by the cloud.
pub(super) struct NodeLink {
    pub(super) node: String,
    /// The servant in the terms of the robot's ROS.
    pub(super) view: Arc<ServantView>,
    pub(super) run: String,
    pub(super) machine: RobotMachine,
    /// Session id.
    pub(super) id: String,
    pub(super) session: CloudSession,
    /// Held by the connection that carries the session.
    pub(super) lease: tokio::sync::Mutex<()>,
    /// Incremented when another connection, or none, is to carry it.
    pub(super) kick: watch::Sender<u64>,
    pub(super) hub: Weak<Hub>,
    pub(super) inputs: InputChannels,
    pub(super) outputs: Outputs,
    pub(super) lent: RobotServices,
    pub(super) services: Mutex<HashMap<u32, Arc<NodeService>>>,
    pub(super) listening: Mutex<BTreeSet<String>>,
    pub(super) time: NodeTime,
    pub(super) sla: SlaTargets,
    pub(super) requests: RequestLog,
    pub(super) unsent: UnsentCounter,
    /// Drops on this side except those of the session.
    pub(super) drops: DropCounters,
    /// Drops on the robot's side as reported.
    pub(super) dropped: Mutex<Vec<TopicDropCount>>,
    /// Incompatible endpoints on the robot as reported.
    pub(super) refused: Mutex<Vec<IncompatibleEndpoint>>,
    /// Records that wait for an output to be subscribed to.
    pub(super) held: HoldQueue,
    pub(super) orders: mpsc::UnboundedSender<QueuedOrder>,
    /// Signals do not wait for control messages: a node that does not respond is the one to be ended.
    pub(super) signals: mpsc::UnboundedSender<i32>,
    pub(super) tasks: Mutex<Vec<AbortHandle>>,
    /// Span of the log about the node, whichever connection carries its link.
    pub(super) log_span: Span,
}

/// A control message from the robot, until it is processed.
pub(super) struct QueuedOrder {
    pub(super) told: FromRobot,
    /// Holds back other records until it is processed.
    pub(super) hold: Option<HoldGuard>,
    /// Memory permit charged to the robot until then.
    pub(super) _held: Permit,
}

/// A service of the node.
pub(super) struct NodeService {
    pub(super) name: String,
    pub(super) sizes: Arc<SizeCounters>,
    pub(super) request: Stamps,
    pub(super) response: Stamps,
}

/// Records held back, and the holds for which they wait.
#[derive(Default)]
pub(super) struct HoldQueue {
    pub(super) state: Mutex<HoldState>,
}

/// The active holds, and what waits for them.
#[derive(Default)]
pub(super) struct HoldState {
    /// Active holds by number.
    pub(super) holds: BTreeSet<u64>,
    pub(super) next: u64,
    /// Nothing is dropped: if there is too much, the oldest are passed on.
    pub(super) records: Ring<HeldRecord>,
    /// A task is draining the queue, so other records queue up behind.
    pub(super) passing: bool,
}

/// A received record.
pub(super) struct HeldRecord {
    pub(super) record: Record<FromRobot>,
    /// Memory permit charged to the robot until this is dropped, for a control message or call.
    pub(super) held: Permit,
    /// Time at which it was received (nanoseconds since the Unix epoch).
    pub(super) at: i64,
}

/// Holds back messages and calls of the link while it lives, but no longer than first messages of a topic wait.
pub(super) struct HoldGuard {
    pub(super) link: Arc<NodeLink>,
    pub(super) number: u64,
}

/// Time source of a node.
pub(super) struct NodeTime {
    /// The robot wants stamps unchanged.
    pub(super) kept: bool,
    pub(super) simulated: AtomicBool,
}

/// The machine on which a stub runs.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct RobotMachine {
    pub(super) id: String,
    pub(super) host: String,
    pub(super) roscore: String,
}

/// Synchronization of the parameters that all nodes share.
pub(super) struct ParameterMirror {
    /// The bus of the view.
    pub(super) bus: Arc<dyn Bus>,
    pub(super) set: Echoes,
    /// Changes by nodes before there was a link to report them.
    pub(super) untold: Mutex<BTreeMap<String, PendingChange>>,
    pub(super) watching: OnceCell<AbortHandle>,
}

/// A change that was not reported to any robot. Its memory is charged to the servant.
pub(super) struct PendingChange {
    pub(super) value: Option<ParamValue>,
    pub(super) _held: Permit,
}
