//! State of the mirror: what is registered here, and what the cloud knows of it.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64};
use std::sync::{Arc, OnceLock, Weak};
use std::time::Duration;

use budget::Permit;
use bytes::Bytes;
use link::control::{Exit, FromCloud, Graph, IncompatibleEndpoint, RequestedInput, ServiceChannel};
use link::drops::DropCounters;
use link::{Echoes, RobotSession};
use parking_lot::{Mutex, RwLock};
use qos::{Failure, RequestId};
use ros::bus::{Bus, Digest, NodeNames, PeerId, SerializedMessage, WireType};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::AbortHandle;

use super::outputs::Outputs;
use super::promise::Promise;

/// The node on the robot.
pub struct Mirror {
    /// Passed to the tasks that it starts.
    pub(super) this: Weak<Mirror>,
    pub(super) bus: Arc<dyn Bus>,
    /// Label by which stubs of one servant recognize each other.
    pub(super) label: String,
    pub(super) session: watch::Sender<Arc<RobotSession>>,
    pub(super) inputs: Inputs,
    pub(super) outputs: Outputs,
    pub(super) calls: Calls,
    pub(super) lent: LentServices,
    pub(super) parameters: Parameters,
    /// Messages dropped on this side, without the session's own.
    pub(super) drops: DropCounters,
    /// Endpoints with incompatible quality of service.
    pub(super) refusals: Arc<Refusals>,
    pub(super) promise: OnceLock<Promise>,
    /// Time limit for calls of the robot's services.
    pub(super) call_limit: Duration,
    /// The interface registered here; locked while it is changed.
    pub(super) applied: tokio::sync::Mutex<AppliedGraph>,
    /// Definitions by name and MD5 sum.
    pub(super) types: Mutex<HashMap<(String, String), KnownType>>,
    pub(super) siblings: RwLock<BTreeSet<String>>,
    pub(super) exit: watch::Sender<Option<Exit>>,
    pub(super) orders: mpsc::UnboundedSender<(FromCloud, Permit)>,
}

/// A type by name and MD5 sum, with its definition.
pub(super) struct KnownType {
    pub(super) of: WireType,
    /// Memory of a type sent by the server counts against the server's budget, since it may send any number of them.
    pub(super) _held: Option<Permit>,
}

/// The interface that the cloud has told the mirror to register.
#[derive(Default)]
pub(super) struct AppliedGraph {
    /// The session that sent it.
    pub(super) session: Weak<RobotSession>,
    /// The session has had time to list everything; what it does not list is removed.
    pub(super) settled: bool,
    /// The last one received, if any.
    pub(super) graph: Option<Graph>,
    /// Names that belong to each node, together with those retained from the last session.
    pub(super) nodes: BTreeMap<String, NodeNames>,
    /// Something was registered without the cloud's instruction.
    pub(super) stood_in: bool,
}

/// Services by name, and pending calls.
#[derive(Default)]
pub(super) struct Calls {
    pub(super) services: Mutex<HashMap<String, MirroredService>>,
    pub(super) waiting: Mutex<HashMap<u32, oneshot::Sender<Result<Bytes, Failure>>>>,
    /// Calls that the keeper has made: the link's id → the keeper's.
    pub(super) kept: Mutex<HashMap<u32, (RequestId, i64)>>,
    /// Calls of the keeper that wait for their service's channel.
    pub(super) early: Mutex<Vec<(RequestId, String, Bytes)>>,
}

/// A service that is served here for the cloud.
pub(super) struct MirroredService {
    /// The service as the cloud reported it.
    pub(super) told: ServiceChannel,
    /// Channel number in this session; `None` until the cloud has reported it.
    pub(super) channel: Arc<watch::Sender<Option<u32>>>,
    pub(super) _serving: Box<dyn Send + Sync>,
}

/// Services that were reported to the cloud.
#[derive(Default)]
pub(super) struct LentServices {
    pub(super) services: Mutex<HashMap<String, LentEntry>>,
    pub(super) next: AtomicU32,
}

/// A service of the robot that the cloud knows.
pub(super) struct LentEntry {
    pub(super) channel: u32,
    /// The node that serves it.
    pub(super) node: String,
    pub(super) digest: Digest,
}

/// Parameters set here on behalf of the cloud, which are not sent back.
#[derive(Default)]
pub(super) struct Parameters {
    pub(super) set: Echoes,
}

/// Incompatible endpoints by the numbers of the local ones.
#[derive(Default)]
pub(super) struct Refusals {
    pub(super) known: Mutex<BTreeMap<u64, Vec<IncompatibleEndpoint>>>,
    pub(super) next: AtomicU64,
}

/// Inputs by topic.
#[derive(Default)]
pub(super) struct Inputs {
    pub(super) topics: Mutex<HashMap<String, InputTopic>>,
    pub(super) channels: Mutex<HashMap<String, TopicChannels>>,
    pub(super) next: AtomicU32,
}

/// A topic that is subscribed to here.
pub(super) struct InputTopic {
    pub(super) wanted: RequestedInput,
    pub(super) feed: Arc<AtomicBool>,
    pub(super) reading: AbortHandle,
}

/// Channels of a topic: one shared by all publishers that do not latch, and one for each publisher that does, whose
/// last message is retained.
#[derive(Default)]
pub(super) struct TopicChannels {
    pub(super) by_publisher: HashMap<(Option<PeerId>, Digest), OpenChannel>,
    /// Last latched message of each publisher.
    pub(super) latched: HashMap<PeerId, SerializedMessage>,
    /// Latched messages that a new servant has not received yet.
    pub(super) to_send_again: HashMap<PeerId, SerializedMessage>,
    /// Types of the connected publishers that do not latch.
    pub(super) offered: HashMap<PeerId, Arc<WireType>>,
}

/// A channel that the cloud knows.
pub(super) struct OpenChannel {
    pub(super) number: u32,
    /// Publishers that have sent on this channel.
    pub(super) publishers: BTreeSet<PeerId>,
}
