//! The link of one node: processes what the robot sends, in order.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use budget::Permit;
use parking_lot::Mutex;
use tokio::sync::{Semaphore, mpsc, watch};
use tokio::time::timeout;
use tokio_util::task::AbortOnDropHandle;
use tracing::Instrument;

use super::inputs::InputChannels;
use super::lent_services::RobotServices;
use super::node_time;
use super::outputs::{ChannelListeners, Outputs};
use super::requests::{MeasuredRequest, RequestLog};
use super::state::{HeldRecord, HoldGuard, HoldQueue, Hub, NodeLink, NodeTime, QueuedOrder, RobotMachine, ServantView};
use super::unsent::UnsentCounter;
use super::{LinkStatus, mirror, node_endpoints};
use crate::FlowCounts;
use link::clock::ClockSample;
use link::control::{FromCloud, FromRobot, Hello, IncompatibleEndpoint};
use link::drops::{Cause, DropCounters, DropReporter, TopicDropCount};
use link::record::{Call, Record};
use link::session::{CloudSession, SessionHandler, SessionOptions};
use link::skew::Direction;
use ros::bus::{BusError, FailureReason};
use ros::ros2::names;
use translation::bus::TranslatedBus;

/// Maximum number of topics opened concurrently, so that a robot that opens many costs no more.
const OPENING: usize = 64;
/// Timeout for the result of a ROS 2 goal, which is requested when the goal begins and answered when it ends.
const GOAL: Duration = Duration::from_secs(24 * 3600);
/// Interval at which drops are checked.
const DROPS: Duration = Duration::from_secs(2);
/// Time without a line after which a node that has ended has printed its last one, and time for all of them.
const LAST_LINE: Duration = Duration::from_millis(100);
const LAST_LINES: Duration = Duration::from_secs(1);

impl NodeLink {
    pub(super) fn start(
        hub: &Arc<Hub>,
        hello: &Hello,
        view: Arc<ServantView>,
        options: SessionOptions,
        lines: mpsc::Receiver<(bool, String)>,
    ) -> Arc<Self> {
        let (orders, taken) = mpsc::unbounded_channel();
        let (signals, sent) = mpsc::unbounded_channel();
        let id = format!("{}-{:x}", hello.run, link::clock::now());
        let log_span = tracing::error_span!(parent: &hub.log_span, "node", node = hello.node.name);
        let link = Arc::new(Self {
            node: hello.node.name.clone(),
            view,
            run: hello.run.clone(),
            machine: RobotMachine::from_hello(hello),
            id,
            session: CloudSession::new(options).with_budget(&hub.options.budget),
            lease: tokio::sync::Mutex::default(),
            kick: watch::Sender::new(0),
            hub: Arc::downgrade(hub),
            inputs: InputChannels::default(),
            outputs: Outputs::default(),
            lent: RobotServices::new(hello.lends),
            services: Mutex::default(),
            listening: Mutex::default(),
            time: NodeTime::from_hello(hello),
            sla: hello.sla.clone(),
            requests: RequestLog::default(),
            unsent: UnsentCounter::default(),
            drops: DropCounters::default(),
            held: HoldQueue::default(),
            dropped: Mutex::default(),
            refused: Mutex::default(),
            orders,
            signals,
            tasks: Mutex::default(),
            log_span,
        });
        link.spawn(process_orders(Arc::clone(&link), Arc::clone(hub), taken));
        link.spawn(forward_signals(Arc::clone(&link), Arc::clone(hub), sent));
        // The nodes change the graph as often as they like.
        let budget = &hub.options.budget;
        link.spawn(budget.meter(mirror::follow(Arc::clone(&link), Arc::clone(hub))));
        link.spawn(budget.meter(node_time::follow(Arc::clone(&link), Arc::clone(hub))));
        link.spawn(forward_lines(Arc::clone(&link), Arc::clone(hub), lines));
        link.spawn(report_drops(Arc::clone(&link)));
        link
    }

    /// Spawns a task that ends with the link.
    fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) {
        let task = tokio::spawn(task.instrument(self.log_span.clone()));
        self.tasks.lock().push(task.abort_handle());
    }

    /// Stops everything done for the robot, without touching the node.
    pub(super) fn stop(&self) {
        self.kick.send_modify(|kicks| *kicks += 1);
        for task in self.tasks.lock().drain(..) {
            task.abort();
        }
        self.inputs.clear();
        self.outputs.clear();
        self.lent.fail_all();
    }

    /// Returns whether a connection carries the link and is not silent.
    pub(super) fn is_connected(&self) -> bool {
        // A new connection has exchanged nothing yet.
        let fresh = self.session.clock().is_none();
        self.lease.try_lock().is_err() && (fresh || self.session.is_up())
    }

    pub(super) fn listens_to(&self, topic: &str) -> bool {
        self.listening.lock().contains(topic)
    }

    /// Returns whether the node subscribes to, publishes or serves something of this name.
    pub(super) fn has(&self, name: &str) -> bool {
        let serves = || self.services.lock().values().any(|service| service.name == name);
        self.listens_to(name) || self.outputs.has(name) || serves() || self.lent.has(name)
    }

    pub(super) fn status(&self) -> LinkStatus {
        let milliseconds = |nanoseconds: i64| nanoseconds as f64 / 1e6;
        let (given, left_out) = self.outputs.skipped_inputs();
        // Cloned before the expression below, during which the locks would be held: `duplicates` accesses other links.
        let dropped = self.dropped.lock().clone();
        let refused = self.refused.lock().clone();
        let requests = self.requests.last();
        LinkStatus {
            session: self.id.clone(),
            node: self.node.clone(),
            up: self.session.is_up(),
            round_trip: self.session.round_trip().map(milliseconds),
            clock: self.session.clock().map(|sample| milliseconds(sample.offset)),
            throughput: self.session.throughput(),
            drops: self.local_drops(),
            dropped,
            sla: self.sla.clone(),
            requests,
            unsent: self.unsent.last_minute(),
            given,
            left_out,
            unfed: self.inputs_without_publisher(),
            unserved: self.missing_services(),
            refused,
            duplicates: self.duplicates(),
        }
    }

    pub(super) fn flow(&self) -> FlowCounts {
        let (inputs, outputs) = self.outputs.flow();
        FlowCounts { node: self.node.clone(), inputs, outputs }
    }

    fn duplicates(&self) -> Vec<String> {
        let hub = self.hub.upgrade();
        let duplicates = hub.map(|hub| hub.find_duplicates(self)).unwrap_or_default();
        let names = duplicates.iter().map(|duplicate| duplicate.machine.name().to_owned());
        let mut names: Vec<String> = names.collect();
        names.sort();
        names.dedup();
        names
    }

    fn local_drops(&self) -> Vec<TopicDropCount> {
        let mut all = self.session.drops();
        all.extend(self.drops.snapshot());
        let losses = self.view.translated_bus().map(TranslatedBus::losses).unwrap_or_default();
        let lost = losses.into_iter().filter(|loss| loss.untranslated > 0 && self.has(&loss.name));
        all.extend(lost.map(|loss| TopicDropCount {
            topic: loss.name,
            cause: Cause::Untranslated,
            count: loss.untranslated,
        }));
        all
    }

    fn missing_services(&self) -> Vec<String> {
        let graph = self.view.bus.graph();
        let graph = graph.borrow();
        let mut sought = node_endpoints::unmet_lookups(&graph, &self.node);
        sought.retain(|service| !self.lent.has(service));
        sought
    }

    /// Returns the subscribed topics without a publisher. The hub's own publisher counts for what the robot sends.
    fn inputs_without_publisher(&self) -> Vec<String> {
        let graph = self.view.bus.graph();
        let graph = graph.borrow();
        let fed = |topic: &&String| {
            // A topic that is not shown belongs to a ROS 2 action, whose missing server is reported instead.
            let ends = graph.topics.get(*topic);
            ends.is_none_or(|ends| !ends.publishers.is_empty())
        };
        let listening = self.listening.lock();
        listening.iter().filter(|topic| !fed(topic)).cloned().collect()
    }

    /// Calls a service of the node, for a call received at `taken`. It is charged to the robot until it is answered.
    fn call(self: &Arc<Self>, call: Call, held: Permit, taken: i64) {
        let Call { id, service, request } = call;
        let known = self.services.lock().get(&service).cloned();
        let (Some(service), Some(hub)) = (known, self.hub.upgrade()) else {
            let gone = format!("{} does not serve this any more", self.node);
            return self.session.answer(id, taken, Err(FailureReason::new(gone)));
        };
        let link = Arc::clone(self);
        // Not aborted with the link: the node answers a call that it has accepted, even if nobody receives the
        // response.
        tokio::spawn(async move {
            let _held = held;
            let patience = match names::action_part(&service.name) {
                Some((_, "get_result")) => GOAL,
                _ => hub.options.call_timeout,
            };
            service.sizes.record(&request);
            let request = link.shift_stamps(&hub, Direction::In, &service.request, request);
            let called = link.view.bus.call(&service.name, request, patience).await;
            let called = called.map(|response| link.shift_stamps(&hub, Direction::Out, &service.response, response));
            link.session.answer(
                id,
                taken,
                called.map_err(|error| match error {
                    BusError::CallFailed { reason, .. } => FailureReason::new(reason),
                    other => FailureReason::new(other.to_string()),
                }),
            );
        });
    }
}

impl SessionHandler<FromRobot> for NodeLink {
    fn on_undecodable(&self, channel: u32) {
        self.inputs.count_undecodable(&self.drops, channel);
    }

    fn on_record(&self, record: Record<FromRobot>, held: Permit, arrived: i64) {
        // The hub owns every link through an Arc; one that it has removed receives nothing more.
        let Some(hub) = self.hub.upgrade() else {
            return;
        };
        let link = hub.links.lock().get(&self.node).cloned();
        if let Some(link) = link.filter(|link| std::ptr::eq(&**link, self)) {
            self.dispatch_record(&link, record, held, arrived);
        }
    }

    fn on_clock_sample(&self, best: ClockSample) {
        if let Some(hub) = self.hub.upgrade() {
            hub.skew.on_clock_sample(best);
        }
    }
}

impl NodeLink {
    fn dispatch_record(&self, this: &Arc<Self>, record: Record<FromRobot>, held: Permit, arrived: i64) {
        match record {
            Record::Answer { id, response, .. } => self.lent.resolve_call(id, response),
            // A call that waits for it must not wait for other control messages.
            Record::Control(FromRobot::Lent { service, of }) => this.on_lent(service, of),
            Record::Control(FromRobot::Signal { signal }) => {
                let _ = self.signals.send(signal);
            }
            // A channel is closed after the messages before it.
            Record::Data(_) | Record::Call(_) | Record::Control(FromRobot::Close { .. }) => {
                let at = arrived;
                match self.held.try_hold(HeldRecord { record, held, at }) {
                    Some(arrival) => this.deliver_to_node(arrival),
                    // The queue may have become too long.
                    None => this.drain_held(),
                }
            }
            Record::Control(told) => {
                // Data may follow immediately.
                let hold = match &told {
                    FromRobot::Open(input) => {
                        if let Some(hub) = self.hub.upgrade() {
                            self.inputs.register(&hub, &self.view, input);
                        }
                        None
                    }
                    FromRobot::Listeners { channel, count, .. } => {
                        let begin = self.outputs.expect_listeners(*channel, *count);
                        begin.then(|| HoldGuard::new(this))
                    }
                    _ => None,
                };
                let _ = self.orders.send(QueuedOrder { told, hold, _held: held });
            }
        }
    }
}

impl NodeLink {
    /// Gives a message or a call to the node.
    fn deliver_to_node(self: &Arc<Self>, arrival: HeldRecord) {
        let HeldRecord { record, held, at } = arrival;
        match record {
            Record::Data(data) => {
                let Some(hub) = self.hub.upgrade() else {
                    return;
                };
                let channel = data.channel;
                let skew = self.skew(&hub);
                let taken = self.inputs.publish((skew, &self.drops), data, at);
                if let Some((mark, answered)) = taken {
                    self.outputs.record_input(channel, mark, answered);
                }
            }
            Record::Call(call) => self.call(call, held, at),
            Record::Control(told) => {
                let _ = self.orders.send(QueuedOrder { told, hold: None, _held: held });
            }
            Record::Answer { .. } => {}
        }
    }

    /// Gives queued records to the node that need not wait any longer.
    pub(super) fn drain_held(self: &Arc<Self>) {
        self.held.drain_ready(|arrival| self.deliver_to_node(arrival));
    }
}

/// Processes control messages of the robot one after the other.
async fn process_orders(link: Arc<NodeLink>, hub: Arc<Hub>, mut orders: mpsc::UnboundedReceiver<QueuedOrder>) {
    // A node that is slow to connect to one topic does not delay others.
    let mut opening: HashMap<u32, AbortOnDropHandle<()>> = HashMap::new();
    let turns = Arc::new(Semaphore::new(OPENING));
    while let Some(QueuedOrder { told, hold, _held }) = orders.recv().await {
        match told {
            FromRobot::Open(input) => {
                opening.retain(|_, task| !task.is_finished());
                let Ok(turn) = Arc::clone(&turns).acquire_owned().await else {
                    return;
                };
                let turns = (Arc::clone(&turns), turn);
                let (channel, link, hub) = (input.channel, Arc::clone(&link), Arc::clone(&hub));
                // A refused channel is retried as long as it is open, and its permit is held for so long.
                let open = async move {
                    let _held = _held;
                    link.inputs.open(&hub, &link, input, turns).await;
                };
                let open = open.in_current_span();
                opening.insert(channel, AbortOnDropHandle::new(tokio::spawn(open)));
            }
            FromRobot::Close { channel } => {
                // Earlier messages are given to the node first.
                let task = opening.remove(&channel);
                if let Some(task) = task.filter(|_| link.inputs.begin_close(channel)) {
                    let _ = task.await;
                }
                link.inputs.close(channel);
                link.session.on_peer_closed(channel);
            }
            FromRobot::Listeners { channel, count, latching } => {
                link.outputs.set_listeners(&link, &hub, ChannelListeners { channel, count, latching }, hold);
            }
            FromRobot::Parameters(changes) => link.view.parameters.apply_changes(&hub, changes).await,
            FromRobot::Requests(requests) => {
                let news = link.requests.record(requests, link.sla.max, Instant::now());
                for (request, update) in news {
                    hub.nodes.on_request_measured(&MeasuredRequest {
                        session: &link.id,
                        node: &link.node,
                        max: link.sla.max.map(|seconds| seconds * 1e3),
                        timing: &request,
                        update,
                    });
                }
            }
            FromRobot::Unsent { replaced, stale } => {
                link.unsent.record_total(replaced.saturating_add(stale));
            }
            FromRobot::Decided(decisions) => {
                for decision in &decisions {
                    hub.nodes.on_decision(&link.node, decision);
                }
            }
            FromRobot::Dropped(dropped) => *link.dropped.lock() = dropped,
            FromRobot::Refused(mut refused) => {
                refused.truncate(IncompatibleEndpoint::MAX_ENDPOINTS);
                *link.refused.lock() = refused;
            }
            other => tracing::debug!(?other, "not for the cloud"),
        }
    }
}

/// Forwards what the node prints, and then its exit status.
async fn forward_lines(link: Arc<NodeLink>, hub: Arc<Hub>, mut lines: mpsc::Receiver<(bool, String)>) {
    let send = |(error, text)| link.session.send_control(&FromCloud::Line { error, text });
    let mut ended = hub.nodes.wait_exit(&link.node);
    let exit = loop {
        tokio::select! {
            exit = &mut ended => break exit,
            Some(line) = lines.recv() => send(line),
        }
    };
    // Its last lines are on their way through its log. Processes that it has started may print on.
    let last = async {
        while let Ok(Some(line)) = timeout(LAST_LINE, lines.recv()).await {
            send(line);
        }
    };
    let _ = timeout(LAST_LINES, last).await;
    link.session.send_last(&FromCloud::Exited(exit));
}

/// Forwards signals from the robot to the node in order.
async fn forward_signals(link: Arc<NodeLink>, hub: Arc<Hub>, mut signals: mpsc::UnboundedReceiver<i32>) {
    while let Some(signal) = signals.recv().await {
        if let Err(error) = hub.nodes.signal(&link.node, signal).await {
            let reason = error.to_string();
            tracing::debug!(signal, reason, "a signal did not arrive");
        }
    }
}

/// Reports drops on this side in the daemon's log and in the robot's.
async fn report_drops(link: Arc<NodeLink>) {
    let mut reporter = DropReporter::default();
    loop {
        tokio::time::sleep(DROPS).await;
        for drop in reporter.take_new(&link.local_drops()) {
            tracing::info!("{drop}");
            link.session.send_control(&FromCloud::Notice {
                warning: !drop.cause.is_intended(),
                text: format!("in the cloud {drop}"),
            });
        }
    }
}
