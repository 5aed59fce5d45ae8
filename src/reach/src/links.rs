//! The cloud's end of links: one [`Hub`] before each servant, one link for each node that a robot's stub stands for.
//!
//! ```text
//!  stub ═ WebSocket ═ Session ─┬─ inputs ──▶ Bus.advertise, publish ──▶ the real node
//!                              ├─ outputs ◀── Bus.subscribe ◀────────── (only while the robot has a listener)
//!                              ├─ calls ───▶ Bus.call ────────────────▶
//!                              ├─ lent ◀──── Bus.lend ◀──────────────── (services of the robot, when one looks for them)
//!                              ├─ parameters ◀─▶ the servant's parameter server
//!                              └─ Graph ◀── what the node has registered, as it changes
//! ```
//! A link outlives its connections for a grace time. Of an input that several nodes of the servant listen to, one
//! link is the feeder; what nodes of one servant publish for each other stays inside.

mod attempts;
mod duplicates;
mod given;
mod held;
mod inputs;
mod inquiries;
mod lent;
mod mirror;
mod node_link;
mod node_time;
mod nodes;
mod outputs;
mod parameters;
mod requests;
mod retry;
mod runs;
mod seen;
mod status;
mod turns;
mod types;
mod unsent;

use std::collections::{BTreeMap, BTreeSet};
use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use budget::Budget;
use parking_lot::Mutex;
use qos::Span;
use ros::bus::{Bus, Graph, ParamValue, RosVersion};
use ros::schema::Registry;
use ros::sizes::{Inputs, Seen};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::runtime::Handle;
use tokio::sync::{OnceCell, watch};
use tokio::time::timeout;
use ws::WebSocket;

use link::control::{FromCloud, Hello, Sla, Welcome};
use link::packing::decoded_here;
use link::session::{Lost, SessionOptions, receive_open, send_open};
use link::skew::Skew;
use link::{Limits, MAX_CONTROL, MAX_FRAME, MAX_RECORD, MAX_TOLD};

use crate::Flow;
use attempts::Attempts;
use duplicates::Machine;
use node_link::NodeLink;
pub use nodes::Nodes;
pub use requests::RequestNews;
pub use status::LinkStatus;
use turns::Turns;

/// What errors call the memory for hellos.
const GREETING: &str = "a robot's hello";
/// For the robot's hello.
const HELLO: Duration = Duration::from_secs(10);
/// For a node of an earlier run to end, before it is killed, and after that.
const STOP: [(i32, Duration); 3] = [
    (2, Duration::from_secs(5)),
    (15, Duration::from_secs(2)),
    (9, Duration::from_secs(5)),
];

/// Habits of a hub.
#[derive(Debug, Clone)]
pub struct HubOptions {
    /// How long a link outlives its connection.
    pub grace: Duration,
    /// How long a service may take.
    pub call_timeout: Duration,
    /// How long first messages wait for the node to connect to their topic.
    pub warm_up: Duration,
    /// Budget for unfinished frames and records of robots; one that does not fit ends its connection.
    pub budget: Budget,
    /// A frame that was begun and is not complete after this time ends its connection.
    pub unfinished: Duration,
}

impl Default for HubOptions {
    fn default() -> Self {
        Self {
            grace: Duration::from_secs(30),
            call_timeout: Duration::from_secs(300),
            warm_up: Duration::from_secs(1),
            budget: Budget::unlimited(),
            unfinished: Duration::from_secs(300),
        }
    }
}

/// The links of one servant.
pub struct Hub {
    servant: String,
    bus: Arc<dyn Bus>,
    registry: Arc<Registry>,
    nodes: Arc<dyn Nodes>,
    options: HubOptions,
    links: Mutex<BTreeMap<String, Arc<NodeLink>>>,
    /// Grows when links come, go, or change what they listen to.
    changes: watch::Sender<u64>,
    /// Serialises beginnings and ends of links, node by node.
    turns: Turns,
    parameters: parameters::Known,
    /// Services of the robot are lent already.
    lends: OnceCell<()>,
    /// The robot's clock against ours.
    skew: Skew,
    attempts: Attempts,
    /// Machines that were told of each other.
    duplicates: Mutex<BTreeSet<(String, String)>>,
    /// How large what robots send to nodes is.
    inputs: Inputs,
    closed: watch::Sender<Option<String>>,
}

impl Hub {
    /// A hub before a servant's ROS.
    pub fn new(
        servant: &str,
        bus: Arc<dyn Bus>,
        registry: Arc<Registry>,
        nodes: Arc<dyn Nodes>,
        options: HubOptions,
    ) -> Arc<Self> {
        Arc::new(Self {
            servant: servant.to_owned(),
            bus,
            registry,
            nodes,
            options,
            links: Mutex::default(),
            changes: watch::Sender::new(0),
            turns: Turns::default(),
            parameters: parameters::Known::default(),
            lends: OnceCell::new(),
            skew: Skew::default(),
            attempts: Attempts::default(),
            duplicates: Mutex::default(),
            inputs: Inputs::default(),
            closed: watch::Sender::new(None),
        })
    }

    /// All links, by node.
    pub fn status(&self) -> Vec<LinkStatus> {
        let links: Vec<_> = self.links.lock().values().cloned().collect();
        links.iter().map(|link| link.status()).collect()
    }

    /// What went to the nodes of links and came from them.
    pub fn flows(&self) -> Vec<Flow> {
        let links = self.links.lock();
        links.values().map(|link| link.flow()).collect()
    }

    /// Warns the stub of a node, if there is one.
    pub fn warn(&self, node: &str, what: &str) {
        let link = self.links.lock().get(node).cloned();
        if let Some(link) = link {
            link.session.report(&FromCloud::Notice {
                warning: true,
                text: what.to_owned(),
            });
        }
    }

    /// How large the messages and requests of each topic and service are that robots send to nodes.
    pub fn inputs(&self) -> Vec<(String, Seen)> {
        self.inputs.seen()
    }

    /// Ends every connection with these words, once what waits for its robot was sent (within seconds), and all links.
    pub fn close(&self, reason: &str) {
        self.closed.send_replace(Some(reason.to_owned()));
        for link in std::mem::take(&mut *self.links.lock()).into_values() {
            link.session.end(1012, reason);
            link.end();
        }
    }

    /// Serves one connection behind its WebSocket upgrade, until it ends.
    pub async fn serve<S>(self: &Arc<Self>, io: S, read_ahead: &[u8]) -> Lost
    where
        S: AsyncRead + AsyncWrite + Unpin + Send,
    {
        let mut socket = WebSocket::new(io, read_ahead, MAX_FRAME, MAX_RECORD)
            .within(&self.options.budget, self.options.unfinished);
        let mut held = self.options.budget.within(GREETING, MAX_TOLD).permit();
        let opening = receive_open(&mut socket, "hello", &mut held);
        let mut hello: Hello = match timeout(HELLO, opening).await {
            Ok(Ok(hello)) => hello,
            Ok(Err(lost)) => return refused(&mut socket, lost).await,
            Err(_) => return Lost::Silent(HELLO),
        };
        if hello.own_bytes() > MAX_CONTROL {
            let error = link::Error::TooMuch {
                what: "a hello without parameters",
                bytes: hello.own_bytes() as u64,
                limit: MAX_CONTROL as u64,
            };
            return refused(&mut socket, Lost::Protocol(error)).await;
        }
        let name = hello.node.name.clone();
        let (link, resumed, turn) = match self.attach(&hello).await {
            Ok(attached) => attached,
            Err(refusal) => {
                tracing::info!(
                    servant = self.servant,
                    node = name,
                    "a link was refused: {}",
                    refusal.reason
                );
                let welcome = Welcome::Refused {
                    reason: refusal.reason.clone(),
                    again: refusal.again,
                };
                let _ = send_open(&mut socket, &welcome).await;
                socket.queue_close(1008, "refused");
                let _ = timeout(Duration::from_secs(1), socket.leave(true)).await;
                return Lost::Closed {
                    code: 1008,
                    reason: refusal.reason,
                };
            }
        };
        let mut carrying = Carrying {
            hub: self,
            link: &link,
            turn,
            is_ended: false,
        };
        // They have been set in the servant: what is kept of a hello is small.
        hello.parameters.clear();
        drop(held);
        // Whoever comes later than this one takes its place, while it waits for the lease, too.
        let mut kicked = link.kick.subscribe();
        let replaced = kicked.wait_for(|kicks| *kicks != turn);
        let _seat = tokio::select! {
            biased;
            _ = replaced => return replaced_by_another(),
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
            codecs: decoded_here(|codec| hello.codecs.iter().any(|name| name == codec.name())),
            limits: Limits::default(),
            servant: self.servant.clone(),
        };
        let (theirs, theirs_ahead) = hello
            .resume
            .as_ref()
            .filter(|_| resumed)
            .map_or((0, &[][..]), |resume| (resume.received, &resume.ahead[..]));
        link.session.set_quality(hello.quality);
        link.session.peer_decodes(&hello.codecs);
        link.session.peer_takes(hello.limits);
        link.session.reconnect(theirs, theirs_ahead, hello.next);
        link.requests.connected(Instant::now());
        if let Err(lost) = send_open(&mut socket, &welcome).await {
            return lost;
        }
        tracing::info!(
            servant = self.servant,
            node = name,
            resumed,
            "a robot's node is linked"
        );
        let lost = {
            let mut running = pin!(link.session.run(&mut socket, &*link));
            let replaced = async { kicked.wait_for(|kicks| *kicks != turn).await.is_ok() };
            let lost = tokio::select! {
                lost = &mut running => Some(lost),
                _ = replaced => None,
            };
            match (lost, self.check_open()) {
                (Some(lost), _) => lost,
                // The robot is told why.
                (None, Err(_)) => running.await,
                (None, Ok(())) => return replaced_by_another(),
            }
        };
        let is_over = matches!(
            lost,
            Lost::Closed { code: 1000, .. } | Lost::Ended | Lost::Protocol(_) | Lost::Full(_)
        );
        if matches!(lost, Lost::Closed { code: 1000, .. }) {
            self.attempts.ended(&hello.run);
        }
        if is_over {
            self.end(&link, turn).await;
            // Whoever drops this meanwhile has the link expire all the same.
            carrying.is_ended = true;
        }
        lost
    }

    /// The link that the hello means, begun if need be; whether it goes on; and the turn of this connection.
    async fn attach(
        self: &Arc<Self>,
        hello: &Hello,
    ) -> Result<(Arc<NodeLink>, bool, u64), Refusal> {
        let node = &hello.node.name;
        self.check_ros(hello.ros)?;
        let is_global = match self.bus.version() {
            RosVersion::One => ros::ros1::names::is_global,
            RosVersion::Two => ros::ros2::names::is_global,
        };
        if !is_global(node) {
            return Err(Refusal::final_(format!(
                "{node:?} is not an absolute node name"
            )));
        }
        let _turn = self.turns.of(node).await;
        self.check_open()?;
        if !self.attempts.is_newest(&hello.run, hello.attempt) {
            return Err(Refusal {
                reason: format!("{node} has tried again since, or has ended"),
                again: true,
            });
        }
        let machine = Machine::of(hello);
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
            if !same && alive && machine.is_of_another_robot(&link.machine) {
                return Err(Refusal::final_(format!(
                    "another machine{} is connected as this robot and runs {node}; {}",
                    link.machine.named(),
                    duplicates::NEXT
                )));
            }
            link.kick.send_modify(|kicks| *kicks += 1);
            self.forget(&link);
        }
        self.parameters.watch(self).await;
        lent::begin(self).await;
        let running = self.nodes.is_running(node).await;
        let ours = running && self.is_of_run(node, &hello.run).await;
        if running && !ours {
            self.stop(node).await;
        }
        self.parameters.take(self, hello).await;
        let lines = self.nodes.lines(node);
        if !ours {
            self.note_run(node, &hello.run).await;
            self.nodes
                .start(&hello.node, &hello.run)
                .await
                .map_err(Refusal::final_)?;
        }
        let link = NodeLink::begin(self, hello, session_options(&hello.sla), lines);
        self.links.lock().insert(node.clone(), Arc::clone(&link));
        // Closed while the node was started: nobody else would end this link.
        if let Err(refusal) = self.check_open() {
            self.forget(&link);
            return Err(refusal);
        }
        let untold = self.parameters.untold();
        if !untold.is_empty() {
            link.session.report(&FromCloud::Parameters(untold));
        }
        if let Some(text) = self.nodes.unheeded(hello) {
            let warning = true;
            link.session.report(&FromCloud::Notice { warning, text });
        }
        // What the node has set before there was a link to tell.
        if let Ok(ParamValue::Map(set)) = self.bus.parameter(node).await {
            let set = set
                .into_iter()
                .map(|(key, value)| (format!("{node}/{key}"), Some(value)));
            link.session.report(&FromCloud::Parameters(set.collect()));
        }
        self.changed();
        let turn = *link.kick.borrow();
        Ok((link, false, turn))
    }

    /// A robot of the other ROS has nothing that the servant's nodes understand. Earlier stubs do not say; they are of ROS 1.
    fn check_ros(&self, robot: u8) -> Result<(), Refusal> {
        let (ours, robot) = (self.bus.version().number(), robot.max(1));
        if ours == robot {
            return Ok(());
        }
        let service = match self.nodes.service() {
            "" => format!("servant {}", self.servant),
            service => format!("service {service}"),
        };
        Err(Refusal::final_(format!(
            "{service} is of ROS {ours} and this robot is of ROS {robot}, whose messages are others: push the package for ROS {robot} and \
             install the stub of that service, or start this stub where ROS {ours} is set up"
        )))
    }

    fn check_open(&self) -> Result<(), Refusal> {
        match &*self.closed.borrow() {
            Some(reason) => Err(Refusal {
                reason: reason.clone(),
                again: true,
            }),
            None => Ok(()),
        }
    }

    fn changed(&self) {
        self.changes.send_modify(|changes| *changes += 1);
    }

    /// Whose inputs of this topic are sent: the first link that listens to it.
    fn feeder(&self, topic: &str) -> Option<String> {
        let links = self.links.lock();
        let mut listening = links.values().filter(|link| link.listens_to(topic));
        let first = listening.clone().find(|link| link.session.is_up());
        first
            .or_else(|| listening.next())
            .map(|link| link.node.clone())
    }

    /// The nodes of other links, with all that their processes are.
    fn siblings(&self, graph: &Graph, node: &str) -> Vec<String> {
        let links = self.links.lock();
        let others = links.keys().filter(|name| *name != node);
        let nodes: BTreeSet<String> = others.flat_map(|name| graph.of_process(name)).collect();
        nodes.into_iter().collect()
    }

    /// Takes the link out of reach.
    fn forget(&self, link: &Arc<NodeLink>) {
        let mut links = self.links.lock();
        if links
            .get(&link.node)
            .is_some_and(|known| Arc::ptr_eq(known, link))
        {
            links.remove(&link.node);
        }
        drop(links);
        link.end();
        self.changed();
    }

    /// Ends the link and its node, unless another connection has taken the link up since the one of this turn.
    async fn end(&self, link: &Arc<NodeLink>, turn: u64) {
        let _turn = self.turns.of(&link.node).await;
        let known = self.links.lock().get(&link.node).cloned();
        let current = known.is_some_and(|known| Arc::ptr_eq(&known, link));
        if current && *link.kick.borrow() == turn {
            self.forget(link);
            self.stop(&link.node).await;
        }
    }

    /// Ends the link unless its robot comes back within the grace time.
    fn expire(self: &Arc<Self>, link: &Arc<NodeLink>, turn: u64) {
        let (hub, link) = (Arc::clone(self), Arc::clone(link));
        let mut kicked = link.kick.subscribe();
        tokio::spawn(async move {
            let back = kicked.wait_for(|kicks| *kicks != turn);
            if timeout(hub.options.grace, back).await.is_err() {
                hub.end(&link, turn).await;
            }
        });
    }

    async fn stop(&self, node: &str) {
        for (signal, patience) in STOP {
            if !self.nodes.is_running(node).await || self.nodes.signal(node, signal).await.is_err()
            {
                return;
            }
            if timeout(patience, self.nodes.ended(node)).await.is_ok() {
                return;
            }
        }
    }
}

/// A connection that carries a link. However it ends, dropped in the middle of it included, the link expires, unless it was ended for good.
struct Carrying<'a> {
    hub: &'a Arc<Hub>,
    link: &'a Arc<NodeLink>,
    turn: u64,
    is_ended: bool,
}

impl Drop for Carrying<'_> {
    fn drop(&mut self) {
        // As the daemon ends there is nobody to wait for it.
        if !self.is_ended && Handle::try_current().is_ok() {
            self.hub.expire(self.link, self.turn);
        }
    }
}

struct Refusal {
    reason: String,
    again: bool,
}

impl Refusal {
    fn final_(reason: impl Into<String>) -> Self {
        Self {
            reason: reason.into(),
            again: false,
        }
    }
}

/// Tells a robot why its hello is not read.
async fn refused<S>(socket: &mut WebSocket<S>, lost: Lost) -> Lost
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    if let Some((code, reason)) = lost.goodbye() {
        socket.queue_close(code, &reason);
        let _ = timeout(Duration::from_secs(1), socket.leave(true)).await;
    }
    lost
}

fn replaced_by_another() -> Lost {
    Lost::Closed {
        code: 1012,
        reason: "the robot came back on another connection".into(),
    }
}

/// How the cloud watches a link: the robot pings often, so the cloud need not.
fn session_options(sla: &Sla) -> SessionOptions {
    SessionOptions {
        ping: Duration::from_secs(5),
        silent: Duration::from_secs(7),
        lost: Duration::from_secs(20),
        // A robot may tell any number: beyond what a promise can be it promises nothing.
        max_age: sla.max.and_then(Span::seconds).map(Span::duration),
    }
}

#[cfg(test)]
mod tests;
