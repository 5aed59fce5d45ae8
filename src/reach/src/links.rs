//! The cloud's end of links: one [`Hub`] per servant, one link per node for which a robot's stub stands.
//!
//! ```text
//!  stub ═ WebSocket ═ Session ─┬─ inputs ──▶ Bus.advertise, publish ──▶ the real node
//!                              ├─ outputs ◀── Bus.subscribe ◀────────── (only while the robot has a listener)
//!                              ├─ calls ───▶ Bus.call ────────────────▶
//!                              ├─ lent ◀──── Bus.lend ◀──────────────── (services of the robot, when looked up)
//!                              ├─ parameters ◀─▶ the servant's parameter server
//!                              └─ Graph ◀── what the node has registered, as it changes
//! ```
//! A link outlives its connections for a grace period. If several nodes of the servant subscribe to an input, one link
//! feeds it; what nodes of one servant publish for each other stays inside.
//!
//! Robots of the other ROS see the servant's bus translated (`views`); everything else is the same for them.

mod attempts;
mod carried_interface;
mod duplicates;
mod given_inputs;
mod held_records;
mod inputs;
mod launches;
mod lent_services;
mod mirror;
mod node_endpoints;
mod node_link;
mod node_time;
mod nodes;
mod outputs;
mod parameters;
mod requests;
mod runs;
mod setup;
mod state;
mod status;
mod turns;
mod types;
mod unsent;
mod views;

use std::collections::BTreeSet;
use std::pin::pin;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use budget::Budget;
use parking_lot::Mutex;
use qos::Span;
use ros::bus::{Bus, Graph, ParamValue, RosVersion};
use ros::schema::Registry;
use ros::sizes::{InputSizes, SizeSummary};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::runtime::Handle;
use tokio::sync::{OnceCell, watch};
use tokio::time::timeout;
use tracing::Instrument;
use translation::TranslationRules;
use ws::WebSocket;

use link::control::{FromCloud, Hello, SlaTargets, Welcome};
use link::packing::supported_codecs;
use link::session::{DisconnectReason, SessionOptions, receive_open, send_open};
use link::skew::Skew;
use link::{LinkLimits, MAX_CONTROL, MAX_FRAME, MAX_RECORD, MAX_TOLD};

use crate::FlowCounts;
use attempts::Attempts;
pub use nodes::{NodeController, NodeError};
pub use requests::{MeasuredRequest, RequestUpdate};
pub use setup::StubSetup;
pub use state::{Hub, HubOptions};
use state::{NodeLink, RobotMachine, ServantView};
pub use status::LinkStatus;
use turns::NodeTurns;

/// Name of the memory for hellos in errors.
const GREETING: &str = "a robot's hello";
/// Timeout for the robot's hello.
const HELLO: Duration = Duration::from_secs(10);
/// Signals for stopping a node of an earlier run, with the time after each.
const STOP: [(i32, Duration); 3] =
    [(2, Duration::from_secs(5)), (15, Duration::from_secs(2)), (9, Duration::from_secs(5))];

impl Default for HubOptions {
    fn default() -> Self {
        Self {
            grace: Duration::from_secs(30),
            call_timeout: Duration::from_secs(300),
            warm_up: Duration::from_secs(1),
            budget: Budget::without_limit(),
            unfinished: Duration::from_secs(300),
            rules: Arc::new(TranslationRules::default()),
        }
    }
}

impl Hub {
    /// Creates a hub on a servant's bus.
    pub fn new(
        servant: &str,
        bus: Arc<dyn Bus>,
        registry: Arc<Registry>,
        nodes: Arc<dyn NodeController>,
        options: HubOptions,
    ) -> Arc<Self> {
        Arc::new(Self {
            servant: servant.to_owned(),
            own_view: ServantView::own(&bus, &registry),
            other_view: OnceLock::new(),
            bus,
            registry,
            nodes,
            options,
            log_span: tracing::Span::current(),
            links: Mutex::default(),
            changes: watch::Sender::new(0),
            turns: NodeTurns::default(),
            lends: OnceCell::new(),
            skew: Skew::default(),
            attempts: Attempts::default(),
            duplicates: Mutex::default(),
            inputs: InputSizes::default(),
            closed: watch::Sender::new(None),
        })
    }

    /// Returns the status of all links by node.
    pub fn status(&self) -> Vec<LinkStatus> {
        let links: Vec<_> = self.links.lock().values().cloned().collect();
        links.iter().map(|link| link.status()).collect()
    }

    /// Returns the counts of messages and calls of each link.
    pub fn flows(&self) -> Vec<FlowCounts> {
        let links = self.links.lock();
        links.values().map(|link| link.flow()).collect()
    }

    /// Sends a warning to the stub of a node, if there is one.
    pub fn warn(&self, node: &str, what: &str) {
        let link = self.links.lock().get(node).cloned();
        if let Some(link) = link {
            link.session.send_control(&FromCloud::Notice { warning: true, text: what.to_owned() });
        }
    }

    /// Returns the sizes of messages and requests from robots by topic and service.
    pub fn inputs(&self) -> Vec<(String, SizeSummary)> {
        self.inputs.summaries()
    }

    /// Ends all links and closes every connection with this reason, once what is queued for its robot was sent (within
    /// seconds).
    pub fn close(&self, reason: &str) {
        self.closed.send_replace(Some(reason.to_owned()));
        for link in std::mem::take(&mut *self.links.lock()).into_values() {
            link.session.close(1012, reason);
            link.stop();
        }
    }

    /// Serves one connection after its WebSocket upgrade until it ends, or is to `end`: then its robot is told the
    /// reason.
    pub async fn serve_until<S>(
        self: &Arc<Self>,
        io: S,
        read_ahead: &[u8],
        end: impl Future<Output = String> + Send,
    ) -> DisconnectReason
    where
        S: AsyncRead + AsyncWrite + Unpin + Send,
    {
        let mut socket = WebSocket::new(io, read_ahead, MAX_FRAME, MAX_RECORD)
            .with_budget(&self.options.budget, self.options.unfinished);
        let reason = tokio::select! {
            lost = self.serve(&mut socket) => return lost,
            reason = end => reason,
        };
        close(&mut socket, 1008, &reason).await;
        DisconnectReason::Closed { code: 1008, reason }
    }

    async fn serve<S>(self: &Arc<Self>, socket: &mut WebSocket<S>) -> DisconnectReason
    where
        S: AsyncRead + AsyncWrite + Unpin + Send,
    {
        let mut held = self.options.budget.child(GREETING, MAX_TOLD).permit();
        let opening = receive_open(socket, "hello", &mut held);
        let mut hello: Hello = match timeout(HELLO, opening).await {
            Ok(Ok(hello)) => hello,
            Ok(Err(lost)) => return send_refusal(socket, lost).await,
            Err(_) => return DisconnectReason::Silent(HELLO),
        };
        let own = hello.own_bytes();
        if own > MAX_CONTROL {
            let error = link::Error::TooMuch {
                what: "a hello without parameters",
                bytes: own as u64,
                limit: MAX_CONTROL as u64,
            };
            return send_refusal(socket, DisconnectReason::Protocol(error)).await;
        }
        let ignored = launches::adapt_node(&mut hello, self.bus.version());
        let (link, resumed, turn) = match self.attach(&hello, &ignored).await {
            Ok(attached) => attached,
            Err(refusal) => {
                tracing::info!("a link was refused: {}", refusal.reason);
                let welcome = Welcome::Refused { reason: refusal.reason.clone(), again: refusal.again };
                let _ = send_open(socket, &welcome).await;
                close(socket, 1008, "refused").await;
                return DisconnectReason::Closed { code: 1008, reason: refusal.reason };
            }
        };
        let mut carrying = ConnectionGuard { hub: self, link: &link, turn, is_ended: false };
        // They have been set in the servant, so little of a hello is kept.
        hello.parameters.clear();
        drop(held);
        // A later connection replaces this one, even while it waits for the lease.
        let mut kicked = link.kick.subscribe();
        let replaced = kicked.wait_for(|kicks| *kicks != turn);
        let _seat = tokio::select! {
            biased;
            _ = replaced => return replaced_disconnect(),
            lease = link.lease.lock() => lease,
        };
        self.report_duplicates(&link);
        let (received, ahead, next) = link.session.position();
        let welcome = Welcome::Accepted {
            session: link.id.clone(),
            resumed,
            received,
            ahead,
            next,
            codecs: supported_codecs(|codec| hello.codecs.iter().any(|name| name == codec.name())),
            limits: LinkLimits::default(),
            servant: self.servant.clone(),
        };
        let (theirs, theirs_ahead) = hello
            .resume
            .as_ref()
            .filter(|_| resumed)
            .map_or((0, &[][..]), |resume| (resume.received, &resume.ahead[..]));
        link.session.set_peer_codecs(&hello.codecs, hello.quality);
        link.session.set_peer_limits(hello.limits);
        link.session.reconnect(theirs, theirs_ahead, hello.next);
        link.requests.on_connected(Instant::now());
        if let Err(lost) = send_open(socket, &welcome).await {
            return lost;
        }
        tracing::info!(resumed, "a robot's node is linked");
        let lost = {
            let mut running = pin!(link.session.run(socket, &*link));
            let replaced = async { kicked.wait_for(|kicks| *kicks != turn).await.is_ok() };
            let lost = tokio::select! {
                lost = &mut running => Some(lost),
                _ = replaced => None,
            };
            match (lost, self.check_open()) {
                (Some(lost), _) => lost,
                // The robot is told the reason.
                (None, Err(_)) => running.await,
                (None, Ok(())) => return replaced_disconnect(),
            }
        };
        let is_over = matches!(
            lost,
            DisconnectReason::Closed { code: 1000, .. }
                | DisconnectReason::Ended
                | DisconnectReason::Protocol(_)
                | DisconnectReason::Full(_)
        );
        if matches!(lost, DisconnectReason::Closed { code: 1000, .. }) {
            self.attempts.mark_ended(&hello.run);
        }
        if is_over {
            self.end_link(&link, turn).await;
            // If this future is dropped here, the link still expires.
            carrying.is_ended = true;
        }
        lost
    }

    /// Finds or starts the link for a hello; the servant's ROS cannot express the arguments in `ignored`. Returns
    /// whether it was resumed, and the turn of this connection.
    async fn attach(
        self: &Arc<Self>,
        hello: &Hello,
        ignored: &[String],
    ) -> Result<(Arc<NodeLink>, bool, u64), LinkRefusal> {
        let node = &hello.node.name;
        let robot = self.check_ros(hello.ros)?;
        for ros in [robot, self.bus.version()] {
            let is_global = match ros {
                RosVersion::One => ros::ros1::names::is_global,
                RosVersion::Two => ros::ros2::names::is_global,
            };
            if !is_global(node) {
                let ros = ros.number();
                let reason = format!("{node:?} is not an absolute node name of ROS {ros}: give the node another name");
                return Err(LinkRefusal::permanent(reason));
            }
        }
        let _turn = self.turns.acquire(node).await;
        self.check_open()?;
        if !self.attempts.is_newest(&hello.run, hello.attempt) {
            return Err(LinkRefusal { reason: format!("{node} has connected again since, or has ended"), again: true });
        }
        let machine = RobotMachine::from_hello(hello);
        let earlier = self.links.lock().get(node).cloned();
        if let Some(link) = earlier {
            let same = link.run == hello.run;
            let asked = hello.resume.as_ref().map(|resume| resume.session.as_str());
            if same && asked == Some(&link.id) {
                link.kick.send_modify(|kicks| *kicks += 1);
                let turn = *link.kick.borrow();
                return Ok((link, true, turn));
            }
            let alive = link.is_connected();
            if !same && alive && machine.is_other_robot(&link.machine) {
                return Err(LinkRefusal::permanent(format!(
                    "another machine{} is connected as this robot and runs {node}; {}",
                    link.machine.host_suffix(),
                    duplicates::NEXT
                )));
            }
            link.kick.send_modify(|kicks| *kicks += 1);
            self.remove_link(&link);
        }
        let view = self.view_for(robot);
        self.check_carried(&view)?;
        view.parameters.watch(self).await;
        lent_services::start_lending(self).await;
        let running = self.nodes.is_running(node).await;
        let ours = running && self.is_of_run(node, &hello.run).await;
        if running && !ours {
            self.stop_node(node).await;
        }
        view.parameters.copy_from_hello(self, hello).await;
        if robot == RosVersion::Two && view.translated_bus().is_some() {
            let copied = self.copy_simulated_time(hello).await;
            copied.map_err(|error| LinkRefusal { reason: error.to_string(), again: true })?;
        }
        let lines = self.nodes.output_lines(node);
        let mut not_given = None;
        if !ours {
            self.record_run(node, &hello.run).await;
            let (launch, left_out) = self.prepare_launch(&view, &hello.node).await;
            not_given = left_out;
            self.nodes.start(&launch, &hello.run).await.map_err(|error| LinkRefusal::permanent(error.to_string()))?;
        }
        let link = NodeLink::start(self, hello, Arc::clone(&view), session_options(&hello.sla), lines);
        self.links.lock().insert(node.clone(), Arc::clone(&link));
        // Closed while the node was starting: nobody else would end this link.
        if let Err(refusal) = self.check_open() {
            self.remove_link(&link);
            return Err(refusal);
        }
        let untold = view.parameters.take_pending();
        if !untold.is_empty() {
            link.session.send_control(&FromCloud::Parameters(untold));
        }
        if let Some(text) = self.nodes.describe_unused_settings(hello) {
            let warning = true;
            link.session.send_control(&FromCloud::Notice { warning, text });
        }
        if let Some(text) = not_given {
            link.session.send_control(&FromCloud::Notice { warning: true, text });
        }
        if !ignored.is_empty() {
            let (servant, words) = (self.bus.version().number(), ignored.join(", "));
            let text =
                format!("the service uses ROS {servant}, which has no such arguments; they are ignored: {words}");
            link.session.send_control(&FromCloud::Notice { warning: true, text });
        }
        // Parameters that the node has set before there was a link.
        if let Ok(ParamValue::Map(set)) = view.bus.parameter(node).await {
            let set = set.into_iter().map(|(key, value)| (format!("{node}/{key}"), Some(value)));
            link.session.send_control(&FromCloud::Parameters(set.collect()));
        }
        self.notify_changed();
        let turn = *link.kick.borrow();
        Ok((link, false, turn))
    }

    /// Returns the robot's ROS version. Earlier stubs do not announce it; they use ROS 1.
    fn check_ros(&self, robot: u8) -> Result<RosVersion, LinkRefusal> {
        match robot {
            0 | 1 => Ok(RosVersion::One),
            2 => Ok(RosVersion::Two),
            other => Err(LinkRefusal::permanent(format!(
                "this robot uses ROS {other}, which this server does not know: update the server"
            ))),
        }
    }

    /// Checks that a robot of the other ROS can use anything of the service.
    fn check_carried(&self, view: &ServantView) -> Result<(), LinkRefusal> {
        let Some((bus, interface)) = view.translated_bus().zip(self.nodes.interface()) else {
            return Ok(());
        };
        let Some(reason) = carried_interface::find_refusal(bus, interface) else {
            return Ok(());
        };
        let (ours, robot) = (self.bus.version().number(), bus.version().number());
        let service = match self.nodes.service() {
            "" => format!("servant {}", self.servant),
            service => format!("service {service}"),
        };
        Err(LinkRefusal::permanent(format!(
            "{service} uses ROS {ours} and this robot ROS {robot}, and {reason}; push the package for ROS {robot}, or \
                add a rule for its types"
        )))
    }

    fn check_open(&self) -> Result<(), LinkRefusal> {
        match &*self.closed.borrow() {
            Some(reason) => Err(LinkRefusal { reason: reason.clone(), again: true }),
            None => Ok(()),
        }
    }

    fn notify_changed(&self) {
        self.changes.send_modify(|changes| *changes += 1);
    }

    /// Returns the node whose link sends inputs of this topic: the first one that subscribes to it.
    fn feeder(&self, topic: &str) -> Option<String> {
        let links = self.links.lock();
        let mut listening = links.values().filter(|link| link.listens_to(topic));
        let first = listening.clone().find(|link| link.session.is_up());
        first.or_else(|| listening.next()).map(|link| link.node.clone())
    }

    /// Returns the nodes of other links, with all nodes of their processes.
    fn siblings(&self, graph: &Graph, node: &str) -> Vec<String> {
        let links = self.links.lock();
        let others = links.keys().filter(|name| *name != node);
        let nodes: BTreeSet<String> = others.flat_map(|name| graph.process_nodes(name)).collect();
        nodes.into_iter().collect()
    }

    /// Removes the link from the hub.
    fn remove_link(&self, link: &Arc<NodeLink>) {
        let mut links = self.links.lock();
        if links.get(&link.node).is_some_and(|known| Arc::ptr_eq(known, link)) {
            links.remove(&link.node);
        }
        drop(links);
        link.stop();
        self.notify_changed();
    }

    /// Ends the link and its node, unless another connection has resumed the link since this turn.
    async fn end_link(&self, link: &Arc<NodeLink>, turn: u64) {
        let _turn = self.turns.acquire(&link.node).await;
        let known = self.links.lock().get(&link.node).cloned();
        let current = known.is_some_and(|known| Arc::ptr_eq(&known, link));
        if current && *link.kick.borrow() == turn {
            self.remove_link(link);
            self.stop_node(&link.node).await;
        }
    }

    /// Ends the link unless its robot reconnects within the grace period.
    fn expire_later(self: &Arc<Self>, link: &Arc<NodeLink>, turn: u64) {
        let (hub, link) = (Arc::clone(self), Arc::clone(link));
        let mut kicked = link.kick.subscribe();
        let span = link.log_span.clone();
        let expiring = async move {
            let back = kicked.wait_for(|kicks| *kicks != turn);
            if timeout(hub.options.grace, back).await.is_err() {
                hub.end_link(&link, turn).await;
            }
        };
        tokio::spawn(expiring.instrument(span));
    }

    async fn stop_node(&self, node: &str) {
        for (signal, patience) in STOP {
            if !self.nodes.is_running(node).await || self.nodes.signal(node, signal).await.is_err() {
                return;
            }
            if timeout(patience, self.nodes.wait_exit(node)).await.is_ok() {
                return;
            }
        }
    }
}

/// A connection that carries a link. However it ends, even if the future is dropped, the link expires, unless it was
/// ended explicitly.
struct ConnectionGuard<'a> {
    hub: &'a Arc<Hub>,
    link: &'a Arc<NodeLink>,
    turn: u64,
    is_ended: bool,
}

impl Drop for ConnectionGuard<'_> {
    fn drop(&mut self) {
        // When the daemon ends there is no runtime to wait.
        if !self.is_ended && Handle::try_current().is_ok() {
            self.hub.expire_later(self.link, self.turn);
        }
    }
}

struct LinkRefusal {
    reason: String,
    again: bool,
}

impl LinkRefusal {
    fn permanent(reason: impl Into<String>) -> Self {
        Self { reason: reason.into(), again: false }
    }
}

/// Closes the connection with the reason why its hello is not accepted.
async fn send_refusal<S>(socket: &mut WebSocket<S>, lost: DisconnectReason) -> DisconnectReason
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    if let Some((code, reason)) = lost.close_frame() {
        close(socket, code, &reason).await;
    }
    lost
}

/// Tells the robot why its connection ends.
async fn close<S>(socket: &mut WebSocket<S>, code: u16, reason: &str)
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    socket.queue_close(code, reason);
    let _ = timeout(Duration::from_secs(1), socket.shutdown(true)).await;
}

fn replaced_disconnect() -> DisconnectReason {
    DisconnectReason::Closed { code: 1012, reason: "the robot came back on another connection".into() }
}

/// Returns the options with which the cloud supervises a link: the robot pings often, so the cloud need not.
fn session_options(sla: &SlaTargets) -> SessionOptions {
    SessionOptions {
        ping: Duration::from_secs(5),
        silent: Duration::from_secs(7),
        lost: Duration::from_secs(20),
        // A robot may send any number; if it is out of range, nothing is promised.
        max_age: sla.max.and_then(Span::from_seconds).map(Span::duration),
    }
}

#[cfg(test)]
mod tests;
