//! The node on the robot: it registers here what the real one has registered in its servant, and forwards messages,
//! calls and parameters between the two.
//!
//! ```text
//!  Graph ─▶ outputs: advertised here ──listeners──▶ cloud          data ─▶ publish
//!        ─▶ inputs: subscribed to here ─▶ Open, data ─▶ cloud
//!        ─▶ services: served here ─▶ call ─▶ cloud ─▶ answer
//!  Lookup ─▶ lent: services of the robot ◀─ call ◀─ cloud
//! ```
//!
//! Registrations outlive a lost link: the robot's other nodes see one node that stays alive.

mod calls;
pub mod diagnostics;
mod dropped;
mod inputs;
mod known_interface;
mod lent_services;
mod outputs;
mod parameters;
pub mod promise;
mod refusals;
mod reports;
pub mod requests;
mod safe_stop;
mod stand_in;
mod state;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock, Weak};
use std::time::Duration;

use budget::Permit;
use foreign::terminal;
use link::control::{Exit, FromCloud, Graph};
use link::drops::{Cause, DropCounters};
use link::record::Record;
use link::{RobotSession, SessionHandler};
use parking_lot::{Mutex, RwLock};
use ros::bus::{Bus, ParamValue, WireType};
use tokio::sync::{mpsc, watch};

use crate::output;
use outputs::Outputs;
pub use state::Mirror;
use state::{AppliedGraph, Calls, Inputs, KnownType, LentServices, Parameters};

/// Time that a node of a new session has to register again what it had registered before.
const SETTLE: Duration = Duration::from_secs(3);

impl Mirror {
    /// Starts a mirror on `bus`, labeled with `label`; its tasks end with it. `call_limit` is the time limit for calls
    /// that the node makes to the robot's services.
    pub fn start(bus: Arc<dyn Bus>, label: String, session: Arc<RobotSession>, call_limit: Duration) -> Arc<Self> {
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
            drops: DropCounters::default(),
            refusals: Arc::default(),
            promise: OnceLock::new(),
            call_limit,
            applied: tokio::sync::Mutex::default(),
            types: Mutex::default(),
            siblings: RwLock::default(),
            exit: watch::Sender::new(None),
            orders,
        });
        tokio::spawn(process_orders(Arc::downgrade(&mirror), taken));
        tokio::spawn(lent_services::watch_graph(Arc::downgrade(&mirror)));
        tokio::spawn(dropped::report_loop(Arc::downgrade(&mirror)));
        tokio::spawn(refusals::report_loop(Arc::downgrade(&mirror)));
        mirror
    }

    /// Returns the exit status of the real node, as soon as it has ended.
    pub fn exit(&self) -> watch::Receiver<Option<Exit>> {
        self.exit.subscribe()
    }

    /// Returns the current session and its replacements.
    pub fn sessions(&self) -> watch::Receiver<Arc<RobotSession>> {
        self.session.subscribe()
    }

    /// Returns all parameters of the robot and starts to forward their changes to the cloud.
    pub async fn parameters(self: &Arc<Self>) -> BTreeMap<String, ParamValue> {
        parameters::start_sync(self).await
    }

    /// Returns the current session.
    pub fn session(&self) -> Arc<RobotSession> {
        self.session.borrow().clone()
    }

    /// Replaces a lost session: pending calls fail, and the node's inputs are opened again.
    pub fn replace_session(&self, session: Arc<RobotSession>) {
        self.calls.reset_channels();
        let before = self.session.send_replace(session);
        for drop in before.drops() {
            self.drops.add(&drop.topic, drop.cause, drop.count);
        }
        self.lent.clear();
        self.calls.fail_all(self.keeper(), "this call was lost: the daemon or the servant was restarted");
        self.inputs.reset_channels();
    }

    /// Returns the type of this name and MD5 sum, with its definition if it is known.
    fn wire_type(&self, name: &str, md5: &str) -> WireType {
        if name == "*" {
            return WireType::any();
        }
        let key = (name.to_owned(), md5.to_owned());
        let known = self.types.lock().get(&key).map(|known| known.of.clone());
        known.unwrap_or_else(|| WireType::new(name, md5, "").with_version(self.bus.version()))
    }

    async fn apply_graph(self: &Arc<Self>, graph: Graph) {
        let mut applied = self.applied.lock().await;
        let session = Arc::downgrade(&self.session());
        if !Weak::ptr_eq(&applied.session, &session) {
            applied.session = session;
            // Before the first session nothing was registered, unless the local original took over.
            applied.settled = applied.graph.is_none() && !applied.stood_in;
            if !applied.settled {
                tokio::spawn(settle(self.this.clone(), applied.session.clone()));
            }
        }
        *self.siblings.write() = graph.siblings.iter().cloned().collect();
        applied.set_graph(graph);
        self.register(&applied).await;
    }

    async fn register(self: &Arc<Self>, applied: &AppliedGraph) {
        let Some(graph) = &applied.graph else { return };
        let keeps = !applied.settled;
        self.bus.set_represented_nodes(applied.nodes.clone());
        self.outputs.apply(self, &graph.outputs, keeps).await;
        self.inputs.apply(self, &graph.inputs, keeps);
        self.calls.apply(self, &graph.services, (true, keeps)).await;
        self.learn(graph, applied.settled).await;
    }
}

impl SessionHandler<FromCloud> for Mirror {
    fn on_undecodable(&self, channel: u32) {
        if let Some(topic) = self.outputs.topic_name(channel) {
            self.drops.add(&topic, Cause::Undecodable, 1);
        }
    }

    fn on_record(&self, record: Record<FromCloud>, held: Permit, arrived: i64) {
        match record {
            Record::Data(data) => self.outputs.publish_cloud(self, data, arrived),
            Record::Answer { id, taken, given, response } => {
                let way = (taken, given, arrived);
                self.calls.on_answer(self, id, way, response);
            }
            Record::Call(call) => self.lent.call(self, call, held, arrived),
            // An untrusted server could otherwise send control sequences to the robot's terminal.
            Record::Control(FromCloud::Line { error: true, text }) => {
                output::STDERR.print(format!("{}\n", terminal::escape(&text, true)));
            }
            Record::Control(FromCloud::Line { text, .. }) => {
                output::STDOUT.print(format!("{}\n", terminal::escape(&text, true)));
            }
            // Before the messages behind it, which are not queued either.
            Record::Control(FromCloud::Kept { channel, messages }) => self.outputs.set_kept(channel, messages),
            Record::Control(FromCloud::Lookup { service }) => {
                self.lent.look_up(self, service, held);
            }
            Record::Control(order) => drop(self.orders.send((order, held))),
        }
    }
}

impl AppliedGraph {
    fn set_graph(&mut self, graph: Graph) {
        let told = graph.nodes.clone();
        if self.settled {
            self.nodes = told;
        } else {
            // Names that are not listed yet stay registered, and so does their owner.
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

/// Waits for the node of a session to register. It may have just been started and registers one name after the other;
/// until then, everything registered on the robot before is kept, and its users wait.
async fn settle(mirror: Weak<Mirror>, session: Weak<RobotSession>) {
    loop {
        tokio::time::sleep(SETTLE).await;
        let Some(current) = session.upgrade() else { return };
        // A link that has fallen silent lists nothing more, while the local original needs its inputs.
        if current.is_up() && current.probe(SETTLE).await {
            break;
        }
    }
    let Some(mirror) = mirror.upgrade() else {
        return;
    };
    let mut applied = mirror.applied.lock().await;
    if Weak::ptr_eq(&applied.session, &session) {
        applied.settled = true;
        if let Some(graph) = applied.graph.take() {
            applied.set_graph(graph);
        }
        mirror.register(&applied).await;
    }
}

/// Processes messages from the cloud in order.
async fn process_orders(mirror: Weak<Mirror>, mut orders: mpsc::UnboundedReceiver<(FromCloud, Permit)>) {
    while let Some((order, held)) = orders.recv().await {
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        match order {
            FromCloud::Type { name, md5, definition } => {
                let key = (name.clone(), md5.clone());
                let wire_type = WireType::new(name, md5, definition);
                let known = KnownType { of: wire_type.with_version(mirror.bus.version()), _held: Some(held) };
                mirror.types.lock().insert(key, known);
            }
            FromCloud::Graph(graph) => mirror.apply_graph(graph).await,
            FromCloud::Parameters(changes) => parameters::apply_changes(&mirror, changes).await,
            FromCloud::Exited(exit) => {
                mirror.exit.send_replace(Some(exit));
            }
            FromCloud::Notice { warning: true, text } => tracing::warn!("{text}"),
            FromCloud::Notice { text, .. } => tracing::info!("{text}"),
            other => tracing::debug!(?other, "unexpected record from the cloud"),
        }
    }
}
