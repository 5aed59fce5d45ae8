//! The node on the robot: what the real one has registered in its servant is registered here, and messages, calls and
//! parameters are carried between the two.
//!
//! ```text
//!  Graph ─▶ outputs: advertised here ──listeners──▶ cloud          data ─▶ publish
//!        ─▶ inputs: subscribed to here ─▶ Open, data ─▶ cloud
//!        ─▶ services: served here ─▶ call ─▶ cloud ─▶ answer
//!  Lookup ─▶ lent: services of the robot ◀─ call ◀─ cloud
//! ```
//! Registrations outlive a lost link: the robot's other nodes see one node that lives on.

mod calls;
pub mod diagnostics;
mod dropped;
mod inputs;
mod known;
mod lent;
mod outputs;
mod parameters;
pub mod promise;
mod refusals;
mod reports;
pub mod requests;
mod safe_stop;
mod stand_in;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::{Arc, OnceLock, Weak};
use std::time::Duration;

use budget::Permit;
use foreign::terminal;
use link::control::{Exit, FromCloud, Graph};
use link::drops::{Cause, Drops};
use link::record::{Called, Record};
use link::{Handler, RobotSession};
use parking_lot::{Mutex, RwLock};
use ros::bus::{Bus, NodeNames, ParamValue, WireType};
use tokio::sync::{mpsc, watch};

use crate::output;
use calls::Calls;
use inputs::Inputs;
use lent::LentServices;
use outputs::Outputs;
use parameters::Parameters;
use promise::Promise;
use refusals::Refusals;

/// How long a node of a new session may take to register what it had before.
const SETTLE: Duration = Duration::from_secs(3);

/// The node on the robot.
pub struct Mirror {
    /// For tasks that it starts.
    this: Weak<Mirror>,
    bus: Arc<dyn Bus>,
    /// By which stubs of one servant know each other.
    label: String,
    session: watch::Sender<Arc<RobotSession>>,
    inputs: Inputs,
    outputs: Outputs,
    calls: Calls,
    lent: LentServices,
    parameters: Parameters,
    /// Messages dropped on this side, but for the session's own.
    drops: Drops,
    /// With whom no messages pass.
    refusals: Arc<Refusals>,
    promise: OnceLock<Promise>,
    /// How long a call of a robot's service may take.
    call_limit: Duration,
    /// What is registered here; locked while it is changed.
    applied: tokio::sync::Mutex<Applied>,
    /// Definitions by name and md5.
    types: Mutex<HashMap<(String, String), KnownType>>,
    siblings: RwLock<BTreeSet<String>>,
    exit: watch::Sender<Option<Exit>>,
    orders: mpsc::UnboundedSender<(FromCloud, Permit)>,
}

impl Mirror {
    /// A mirror on `bus`, which is labelled so; its tasks end with it. A service of the robot may take `call_limit` when
    /// the node calls it.
    pub fn start(
        bus: Arc<dyn Bus>,
        label: String,
        session: Arc<RobotSession>,
        call_limit: Duration,
    ) -> Arc<Self> {
        let (orders, taken) = mpsc::unbounded_channel();
        let mirror = Arc::new_cyclic(|this| Self {
            this: this.clone(),
            bus,
            label,
            session: watch::Sender::new(session),
            inputs: Inputs::default(),
            outputs: Outputs::default(),
            calls: Calls::default(),
            lent: LentServices::default(),
            parameters: Parameters::default(),
            drops: Drops::default(),
            refusals: Arc::default(),
            promise: OnceLock::new(),
            call_limit,
            applied: tokio::sync::Mutex::default(),
            types: Mutex::default(),
            siblings: RwLock::default(),
            exit: watch::Sender::new(None),
            orders,
        });
        tokio::spawn(obey(Arc::downgrade(&mirror), taken));
        tokio::spawn(lent::follow(Arc::downgrade(&mirror)));
        tokio::spawn(dropped::report(Arc::downgrade(&mirror)));
        tokio::spawn(refusals::report(Arc::downgrade(&mirror)));
        mirror
    }

    /// How the real node ended, once it has.
    pub fn exit(&self) -> watch::Receiver<Option<Exit>> {
        self.exit.subscribe()
    }

    /// The session in use, as it is replaced.
    pub fn sessions(&self) -> watch::Receiver<Arc<RobotSession>> {
        self.session.subscribe()
    }

    /// All parameters of the robot, and from now on their changes go to the cloud.
    pub async fn parameters(self: &Arc<Self>) -> BTreeMap<String, ParamValue> {
        parameters::begin(self).await
    }

    /// The session in use.
    pub fn session(&self) -> Arc<RobotSession> {
        self.session.borrow().clone()
    }

    /// Another session takes the place of the one that was lost: calls under way have failed, and what the node
    /// listens to is opened again.
    pub fn renew(&self, session: Arc<RobotSession>) {
        self.calls.renew();
        let before = self.session.send_replace(session);
        for drop in before.drops() {
            self.drops.add(&drop.topic, drop.cause, drop.count);
        }
        self.lent.renew();
        self.calls.fail(
            self.keeper(),
            "the cloud has forgotten this call: its daemon or servant was restarted",
        );
        self.inputs.renew();
    }

    /// The type of this name and hash, with its definition where that was told.
    fn wire_type(&self, name: &str, md5: &str) -> WireType {
        if name == "*" {
            return WireType::any();
        }
        let key = (name.to_owned(), md5.to_owned());
        let known = self.types.lock().get(&key).map(|known| known.of.clone());
        known.unwrap_or_else(|| WireType::new(name, md5, "").written_by(self.bus.version()))
    }

    async fn apply(self: &Arc<Self>, graph: Graph) {
        let mut applied = self.applied.lock().await;
        let session = Arc::downgrade(&self.session());
        if !Weak::ptr_eq(&applied.session, &session) {
            applied.session = session;
            // Before the first one nothing was registered, unless the original stood in.
            applied.settled = applied.graph.is_none() && !applied.stood_in;
            if !applied.settled {
                tokio::spawn(settle(self.this.clone(), applied.session.clone()));
            }
        }
        *self.siblings.write() = graph.siblings.iter().cloned().collect();
        applied.told(graph);
        self.register(&applied).await;
    }

    async fn register(self: &Arc<Self>, applied: &Applied) {
        let Some(graph) = &applied.graph else { return };
        let keeps = !applied.settled;
        self.bus.stands_for(applied.nodes.clone());
        self.outputs.apply(self, &graph.outputs, keeps).await;
        self.inputs.apply(self, &graph.inputs, keeps);
        self.calls.apply(self, &graph.services, (true, keeps)).await;
        self.learn(graph, applied.settled).await;
    }
}

impl Handler<FromCloud> for Mirror {
    fn undecodable(&self, channel: u32) {
        if let Some(topic) = self.outputs.topic_of(channel) {
            self.drops.add(&topic, Cause::Undecodable, 1);
        }
    }

    fn record(&self, record: Record<FromCloud>, held: Permit, arrived: i64) {
        match record {
            Record::Data(data) => self.outputs.take(self, data, arrived),
            Record::Answer {
                id,
                taken,
                given,
                response,
            } => {
                let way = (taken, given, arrived);
                self.calls.answered(self, id, way, response);
            }
            Record::Call {
                id,
                service,
                request,
            } => self.lent.call(
                self,
                Called {
                    id,
                    service,
                    request,
                    held,
                    taken: arrived,
                },
            ),
            // A server that is not to be trusted could have the robot's terminal do what it likes.
            Record::Control(FromCloud::Line { error: true, text }) => {
                output::STDERR.print(format!("{}\n", terminal::escape(&text, true)));
            }
            Record::Control(FromCloud::Line { text, .. }) => {
                output::STDOUT.print(format!("{}\n", terminal::escape(&text, true)));
            }
            Record::Control(FromCloud::Lookup { service }) => {
                self.lent.look_up(self, service, held);
            }
            Record::Control(order) => drop(self.orders.send((order, held))),
        }
    }
}

/// A type by its name and hash, with its definition.
struct KnownType {
    of: WireType,
    /// One that the server told counts as the server's: there is no end to what it may tell.
    _held: Option<Permit>,
}

/// What the cloud has told to register.
#[derive(Default)]
struct Applied {
    /// By which session.
    session: Weak<RobotSession>,
    /// That has had time to tell all: what it does not list is taken back.
    settled: bool,
    /// Told last; none: never.
    graph: Option<Graph>,
    /// Which of it is whose, with what is kept of the last session.
    nodes: BTreeMap<String, NodeNames>,
    /// Something was registered without being told.
    stood_in: bool,
}

impl Applied {
    fn told(&mut self, graph: Graph) {
        let told = graph.nodes.iter();
        let told = told.map(|(node, has)| (node.clone(), NodeNames::from(has.clone())));
        if self.settled {
            self.nodes = told.collect();
        } else {
            // What it does not list yet stays registered, and whose it is, too.
            for (node, names) in told {
                let known = self.nodes.entry(node).or_default();
                known.publishes.extend(names.publishes);
                known.subscribes.extend(names.subscribes);
                known.serves.extend(names.serves);
            }
        }
        self.graph = Some(graph);
    }
}

/// A session's node may have just been started, and registers one thing after the other: for so long what was
/// registered on the robot before stays, and whoever uses it waits.
async fn settle(mirror: Weak<Mirror>, session: Weak<RobotSession>) {
    tokio::time::sleep(SETTLE).await;
    let Some(mirror) = mirror.upgrade() else {
        return;
    };
    let mut applied = mirror.applied.lock().await;
    if Weak::ptr_eq(&applied.session, &session) {
        applied.settled = true;
        if let Some(graph) = applied.graph.take() {
            applied.told(graph);
        }
        mirror.register(&applied).await;
    }
}

/// Does what the cloud tells, one thing after the other.
async fn obey(mirror: Weak<Mirror>, mut orders: mpsc::UnboundedReceiver<(FromCloud, Permit)>) {
    while let Some((order, held)) = orders.recv().await {
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        match order {
            FromCloud::Type {
                name,
                md5,
                definition,
            } => {
                let key = (name.clone(), md5.clone());
                let wire_type = WireType::new(name, md5, definition);
                let known = KnownType {
                    of: wire_type.written_by(mirror.bus.version()),
                    _held: Some(held),
                };
                mirror.types.lock().insert(key, known);
            }
            FromCloud::Graph(graph) => mirror.apply(graph).await,
            FromCloud::Parameters(changes) => parameters::change(&mirror, changes).await,
            FromCloud::Exited(exit) => {
                mirror.exit.send_replace(Some(exit));
            }
            FromCloud::Notice {
                warning: true,
                text,
            } => tracing::warn!("{text}"),
            FromCloud::Notice { text, .. } => tracing::info!("{text}"),
            other => tracing::debug!(?other, "not for the robot"),
        }
    }
}
