//! One node's link: what the robot tells is done here, in order.

use std::collections::{BTreeSet, HashMap};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use budget::Permit;
use parking_lot::Mutex;
use tokio::sync::{Semaphore, mpsc, watch};
use tokio::task::AbortHandle;
use tokio_util::task::AbortOnDropHandle;

use super::duplicates::Machine;
use super::held::{Arrival, Held, Hold};
use super::inputs::Inputs;
use super::lent::RobotServices;
use super::node_time::{self, NodeTime};
use super::outputs::Outputs;
use super::requests::Requests;
use super::unsent::Unsent;
use super::{Hub, LinkStatus, mirror, seen};
use crate::Flow;
use link::clock::Sample;
use link::control::{FromCloud, FromRobot, Hello, Refused, Sla};
use link::drops::{Drop, Drops, Reporter};
use link::record::{Called, Record};
use link::session::{CloudSession, Handler, SessionOptions};
use link::skew::Direction;
use ros::codec::Stamps;
use ros::ros2::names;
use ros::sizes::Sizes;

/// Topics that are opened beside each other; more wait, so that a robot that opens many costs no more.
const OPENING: usize = 64;
/// For the result of a goal of ROS 2, which is asked for when the goal begins and comes when it ends.
const GOAL: Duration = Duration::from_secs(24 * 3600);
/// Between two looks at what was dropped.
const DROPS: Duration = Duration::from_secs(2);

/// A robot's node, as the cloud sees it.
pub(super) struct NodeLink {
    pub(super) node: String,
    pub(super) run: String,
    pub(super) machine: Machine,
    /// Names the session.
    pub(super) id: String,
    pub(super) session: CloudSession,
    /// Held by the connection that carries the session.
    pub(super) lease: tokio::sync::Mutex<()>,
    /// Grows when another connection, or nobody, is to carry it.
    pub(super) kick: watch::Sender<u64>,
    pub(super) hub: Weak<Hub>,
    pub(super) inputs: Inputs,
    pub(super) outputs: Outputs,
    pub(super) lent: RobotServices,
    pub(super) services: Mutex<HashMap<u32, Arc<Service>>>,
    pub(super) listening: Mutex<BTreeSet<String>>,
    pub(super) time: NodeTime,
    sla: Sla,
    pub(super) requests: Requests,
    unsent: Unsent,
    /// On this side, but for the session's own.
    pub(super) drops: Drops,
    /// On the robot's side, as it told.
    dropped: Mutex<Vec<Drop>>,
    /// With whom no messages pass there, as it told.
    refused: Mutex<Vec<Refused>>,
    /// What must wait for an output to be subscribed to.
    pub(super) held: Held,
    orders: mpsc::UnboundedSender<Order>,
    /// They wait for no order: a node that answers nobody is the one to be ended.
    signals: mpsc::UnboundedSender<i32>,
    tasks: Mutex<Vec<AbortHandle>>,
}

/// What the robot tells, until it is done.
struct Order {
    told: FromRobot,
    /// What must wait until it is done.
    hold: Option<Hold>,
    /// It counts as the robot's until then.
    _held: Permit,
}

/// What the node serves.
pub(super) struct Service {
    pub(super) name: String,
    pub(super) sizes: Arc<Sizes>,
    pub(super) request: Stamps,
    pub(super) response: Stamps,
}

impl NodeLink {
    pub(super) fn begin(
        hub: &Arc<Hub>,
        hello: &Hello,
        options: SessionOptions,
        mut lines: mpsc::Receiver<(bool, String)>,
    ) -> Arc<Self> {
        let (orders, taken) = mpsc::unbounded_channel();
        let (signals, sent) = mpsc::unbounded_channel();
        let id = format!("{}-{:x}", hello.run, link::clock::now());
        let link = Arc::new(Self {
            node: hello.node.name.clone(),
            run: hello.run.clone(),
            machine: Machine::of(hello),
            id,
            session: CloudSession::new(options).within(&hub.options.budget),
            lease: tokio::sync::Mutex::default(),
            kick: watch::Sender::new(0),
            hub: Arc::downgrade(hub),
            inputs: Inputs::default(),
            outputs: Outputs::default(),
            lent: RobotServices::new(hello.lends),
            services: Mutex::default(),
            listening: Mutex::default(),
            time: NodeTime::of(hello),
            sla: hello.sla.clone(),
            requests: Requests::default(),
            unsent: Unsent::default(),
            drops: Drops::default(),
            held: Held::default(),
            dropped: Mutex::default(),
            refused: Mutex::default(),
            orders,
            signals,
            tasks: Mutex::default(),
        });
        let mut tasks = vec![
            tokio::spawn(obey(Arc::clone(&link), Arc::clone(hub), taken)).abort_handle(),
            tokio::spawn(deliver(Arc::clone(&link), Arc::clone(hub), sent)).abort_handle(),
            tokio::spawn(mirror::follow(Arc::clone(&link), Arc::clone(hub))).abort_handle(),
            tokio::spawn(node_time::follow(Arc::clone(&link), Arc::clone(hub))).abort_handle(),
        ];
        let (watching, nodes) = (Arc::clone(&link), Arc::clone(&hub.nodes));
        tasks.push(
            tokio::spawn(async move {
                let exit = nodes.ended(&watching.node).await;
                watching.session.report(&FromCloud::Exited(exit));
            })
            .abort_handle(),
        );
        let printing = Arc::clone(&link);
        tasks.push(
            tokio::spawn(async move {
                while let Some((error, text)) = lines.recv().await {
                    printing.session.report(&FromCloud::Line { error, text });
                }
            })
            .abort_handle(),
        );
        tasks.push(tokio::spawn(report_drops(Arc::clone(&link))).abort_handle());
        link.tasks.lock().extend(tasks);
        link
    }

    /// Ends all that was done for the robot; the node is not touched.
    pub(super) fn end(&self) {
        self.kick.send_modify(|kicks| *kicks += 1);
        for task in self.tasks.lock().drain(..) {
            task.abort();
        }
        self.inputs.clear();
        self.outputs.clear();
        self.lent.end();
    }

    /// A connection carries it, and is not silent.
    pub(super) fn is_connected(&self) -> bool {
        // One that is new has exchanged nothing yet.
        let fresh = self.session.clock().is_none();
        self.lease.try_lock().is_err() && (fresh || self.session.is_up())
    }

    pub(super) fn listens_to(&self, topic: &str) -> bool {
        self.listening.lock().contains(topic)
    }

    pub(super) fn status(&self) -> LinkStatus {
        let milliseconds = |nanoseconds: i64| nanoseconds as f64 / 1e6;
        let (given, left_out) = self.outputs.left_out();
        // Before the expression below, to whose end they would stay locked: `duplicates` looks at other links.
        let dropped = self.dropped.lock().clone();
        let refused = self.refused.lock().clone();
        let requests = self.requests.last();
        LinkStatus {
            node: self.node.clone(),
            up: self.session.is_up(),
            round_trip: self.session.round_trip().map(milliseconds),
            clock: self
                .session
                .clock()
                .map(|sample| milliseconds(sample.offset)),
            throughput: self.session.throughput(),
            drops: self.drops_here(),
            dropped,
            sla: self.sla.clone(),
            requests,
            unsent: self.unsent.lately(),
            given,
            left_out,
            unfed: self.unfed(),
            unserved: self.unserved(),
            refused,
            duplicates: self.duplicates(),
        }
    }

    pub(super) fn flow(&self) -> Flow {
        let (inputs, outputs) = self.outputs.flow();
        Flow {
            node: self.node.clone(),
            inputs,
            outputs,
        }
    }

    fn duplicates(&self) -> Vec<String> {
        let hub = self.hub.upgrade();
        let duplicates = hub.map(|hub| hub.duplicates_of(self)).unwrap_or_default();
        let names = duplicates
            .iter()
            .map(|duplicate| duplicate.machine.name().to_owned());
        let mut names: Vec<String> = names.collect();
        names.sort();
        names.dedup();
        names
    }

    fn drops_here(&self) -> Vec<Drop> {
        let mut all = self.session.drops();
        all.extend(self.drops.all());
        all
    }

    fn unserved(&self) -> Vec<String> {
        let Some(hub) = self.hub.upgrade() else {
            return Vec::new();
        };
        let graph = hub.bus.graph();
        let graph = graph.borrow();
        let mut sought = seen::sought(&graph, &self.node);
        sought.retain(|service| !self.lent.has(service));
        sought
    }

    /// Our own end publishes what the robot sends.
    fn unfed(&self) -> Vec<String> {
        let Some(hub) = self.hub.upgrade() else {
            return Vec::new();
        };
        let graph = hub.bus.graph();
        let graph = graph.borrow();
        let fed = |topic: &&String| {
            // What is not shown is a part of an action of ROS 2, whose server is what is missing then.
            let ends = graph.topics.get(*topic);
            ends.is_none_or(|ends| !ends.publishers.is_empty())
        };
        let listening = self.listening.lock();
        listening
            .iter()
            .filter(|topic| !fed(topic))
            .cloned()
            .collect()
    }

    /// Calls a service of the node; the request counts as the robot's until it is answered.
    fn call(self: &Arc<Self>, call: Called) {
        let Called {
            id,
            service,
            request,
            held,
            taken,
        } = call;
        let known = self.services.lock().get(&service).cloned();
        let (Some(service), Some(hub)) = (known, self.hub.upgrade()) else {
            let gone = format!("{} does not serve this any more", self.node);
            return self.session.answer(id, taken, Err(gone));
        };
        let link = Arc::clone(self);
        // Not aborted with the link: whoever took the call answers it, even if nobody is there to hear.
        tokio::spawn(async move {
            let _held = held;
            let patience = match names::action_part(&service.name) {
                Some((_, "get_result")) => GOAL,
                _ => hub.options.call_timeout,
            };
            service.sizes.note(&request);
            let request = link.shift(&hub, Direction::In, &service.request, request);
            let called = hub.bus.call(&service.name, request, patience).await;
            let called = called
                .map(|response| link.shift(&hub, Direction::Out, &service.response, response));
            link.session.answer(
                id,
                taken,
                called.map_err(|error| match error {
                    ros::bus::BusError::CallFailed { reason, .. } => reason,
                    other => other.to_string(),
                }),
            );
        });
    }
}

impl Handler<FromRobot> for NodeLink {
    fn undecodable(&self, channel: u32) {
        self.inputs.undecodable(&self.drops, channel);
    }

    fn record(&self, record: Record<FromRobot>, held: Permit, arrived: i64) {
        // The hub holds every link by an Arc; one that it let go of hears no more.
        let Some(hub) = self.hub.upgrade() else {
            return;
        };
        let link = hub.links.lock().get(&self.node).cloned();
        if let Some(link) = link.filter(|link| std::ptr::eq(&**link, self)) {
            self.take(&link, record, held, arrived);
        }
    }

    fn clock(&self, best: Sample) {
        if let Some(hub) = self.hub.upgrade() {
            hub.skew.measured(best);
        }
    }
}

impl NodeLink {
    fn take(&self, this: &Arc<Self>, record: Record<FromRobot>, held: Permit, arrived: i64) {
        match record {
            Record::Answer { id, response, .. } => self.lent.answered(id, response),
            // A call that waits for it must not wait for other orders.
            Record::Control(FromRobot::Lent { service, of }) => this.lends(service, of),
            Record::Control(FromRobot::Signal { signal }) => {
                let _ = self.signals.send(signal);
            }
            // A channel is closed after the messages before it.
            Record::Data(_) | Record::Call { .. } | Record::Control(FromRobot::Close { .. }) => {
                let at = arrived;
                match self.held.take(Arrival { record, held, at }) {
                    Some(arrival) => this.give(arrival),
                    // There may be too much by now.
                    None => this.pass_held(),
                }
            }
            Record::Control(told) => {
                // Data may follow in the same breath.
                let hold = match &told {
                    FromRobot::Open(input) => {
                        if let Some(hub) = self.hub.upgrade() {
                            self.inputs.expect(&hub, input);
                        }
                        None
                    }
                    FromRobot::Listeners { channel, count } => {
                        let begin = self.outputs.expect(*channel, *count);
                        begin.then(|| Hold::new(this))
                    }
                    _ => None,
                };
                let _ = self.orders.send(Order {
                    told,
                    hold,
                    _held: held,
                });
            }
        }
    }
}

impl NodeLink {
    /// Gives a message or a call to the node.
    fn give(self: &Arc<Self>, arrival: Arrival) {
        let Arrival { record, held, at } = arrival;
        match record {
            Record::Data(data) => {
                let Some(hub) = self.hub.upgrade() else {
                    return;
                };
                let channel = data.channel;
                let skew = self.skew(&hub);
                let taken = self.inputs.take((skew, &self.drops), data, at);
                if let Some((mark, answered)) = taken {
                    self.outputs.note(channel, mark, answered);
                }
            }
            Record::Call {
                id,
                service,
                request,
            } => self.call(Called {
                id,
                service,
                request,
                held,
                taken: at,
            }),
            Record::Control(told) => {
                let _ = self.orders.send(Order {
                    told,
                    hold: None,
                    _held: held,
                });
            }
            Record::Answer { .. } => {}
        }
    }

    /// Gives it what has waited, if that need not wait any longer.
    pub(super) fn pass_held(self: &Arc<Self>) {
        self.held.pass(|arrival| self.give(arrival));
    }
}

/// Does what the robot tells, one thing after the other.
async fn obey(link: Arc<NodeLink>, hub: Arc<Hub>, mut orders: mpsc::UnboundedReceiver<Order>) {
    // A node that is slow to connect to one topic keeps nothing else waiting.
    let mut opening: HashMap<u32, AbortOnDropHandle<()>> = HashMap::new();
    let turns = Arc::new(Semaphore::new(OPENING));
    while let Some(Order { told, hold, _held }) = orders.recv().await {
        match told {
            FromRobot::Open(input) => {
                opening.retain(|_, task| !task.is_finished());
                let Ok(turn) = Arc::clone(&turns).acquire_owned().await else {
                    return;
                };
                let turns = (Arc::clone(&turns), turn);
                let (channel, link, hub) = (input.channel, Arc::clone(&link), Arc::clone(&hub));
                // One that is refused is tried again for as long as its channel is open, and is its robot's to pay for so long.
                let open = async move {
                    let _held = _held;
                    link.inputs.open(&hub, &link.drops, input, turns).await;
                };
                opening.insert(channel, AbortOnDropHandle::new(tokio::spawn(open)));
            }
            FromRobot::Close { channel } => {
                // What came before it is given to the node first.
                let task = opening.remove(&channel);
                if let Some(task) = task.filter(|_| link.inputs.closes(channel)) {
                    let _ = task.await;
                }
                link.inputs.close(channel);
                link.session.peer_closed(channel);
            }
            FromRobot::Listeners { channel, count } => {
                link.outputs.listeners(&link, &hub, (channel, count), hold);
            }
            FromRobot::Parameters(changes) => hub.parameters.change(&hub, changes).await,
            FromRobot::Requests(requests) => {
                let news = link.requests.note(requests, link.sla.max, Instant::now());
                for (request, new) in news {
                    hub.nodes.measured(&request, new);
                }
            }
            FromRobot::Unsent { replaced, stale } => {
                link.unsent.note(replaced.saturating_add(stale));
            }
            FromRobot::Decided(decisions) => {
                for decision in &decisions {
                    hub.nodes.decided(&link.node, decision);
                }
            }
            FromRobot::Dropped(dropped) => *link.dropped.lock() = dropped,
            FromRobot::Refused(mut refused) => {
                refused.truncate(Refused::MOST);
                *link.refused.lock() = refused;
            }
            other => tracing::debug!(node = link.node, ?other, "not for the cloud"),
        }
    }
}

/// Sends the node what signals the robot sends it, in their order.
async fn deliver(link: Arc<NodeLink>, hub: Arc<Hub>, mut signals: mpsc::UnboundedReceiver<i32>) {
    while let Some(signal) = signals.recv().await {
        if let Err(reason) = hub.nodes.signal(&link.node, signal).await {
            tracing::debug!(node = link.node, signal, reason, "a signal did not arrive");
        }
    }
}

/// Tells of messages that were dropped here, in the daemon's log and in the robot's.
async fn report_drops(link: Arc<NodeLink>) {
    let mut reporter = Reporter::default();
    loop {
        tokio::time::sleep(DROPS).await;
        for drop in reporter.news(&link.drops_here()) {
            tracing::info!(node = link.node, "{drop}");
            link.session.report(&FromCloud::Notice {
                warning: !drop.cause.is_meant(),
                text: format!("in the cloud {drop}"),
            });
        }
    }
}
