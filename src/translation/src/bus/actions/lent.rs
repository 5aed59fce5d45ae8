//! Actions that a node of the robot serves, for clients in the servant: to these a server of their own ROS is there, as
//! long as the robot has one, behind which a client of the robot's ROS stands.
//!
//! ```text
//!  servant's nodes                          TranslatedBus                     robot's node
//!  clients of ROS 2 ──▶ TranslatedActionServer ──▶ RobotTopics ◀────▶ topics of ROS 1, which links carry
//!  clients of ROS 1 ──▶ TranslatedActionServer ──▶ RobotServices ──▶ services of ROS 2, which are lent
//! ```
//! A goal is accepted or rejected as the robot's server does; one of ROS 1 accepts a goal by listing it. A goal that is
//! not answered in time is cancelled and rejected. Feedback that does not fit into the queue of a slow client gives way
//! to newer feedback.

mod goals;
mod services;
mod topics;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    ActionEndpoint, ActionNodes, ActionServer, BusError, FailureReason, GoalEnd, GoalOutcome, Graph, Lender,
    MatchedPeers, PeerId, Publisher, QosProfile, RosVersion, Subscription, TopicPeer, WireType, linked_node,
    split_action_endpoint,
};
use ros::codec::default_message;
use tokio::runtime::Handle;
use tokio::sync::{Semaphore, watch};
use tokio::time::{sleep, timeout};
use tokio_util::task::AbortOnDropHandle;
use tracing::Instrument;

use self::goals::{LentGoalEvents, LentGoalHandler};
use self::services::RobotServices;
use self::topics::RobotTopics;
use super::server::TranslatedActionServer;
use crate::ActionTwin;
use crate::bus::state::{Translation, not_translated};

/// Maximum number of actions that nodes of a servant look for.
const MOST_SOUGHT: usize = 256;
/// Maximum number of goals under way that the servant's nodes have sent to servers of the robot, together.
const MAX_GOALS: usize = 256;

/// Time for which a server of ROS 1 may be without a part, as when another link carries its topics from now on. Also
/// the pause before an action that could not be served is served again.
const GRACE: Duration = Duration::from_secs(1);

/// The actions that nodes of the servant look for and no other node of it serves.
pub(in crate::bus) struct LentActions {
    translation: Arc<Translation>,
    /// Budget for the goals that are under way.
    budget: Budget,
    /// Places for them.
    places: Arc<Semaphore>,
    /// Finds services of a robot of ROS 2, once there is one.
    lender: watch::Sender<Option<Arc<dyn Lender>>>,
    actions: Mutex<HashMap<String, SoughtAction>>,
}

struct SoughtAction {
    /// Name of its type in the servant.
    type_name: String,
    action: Arc<LentAction>,
    /// Serves it while the robot does.
    _serving: AbortOnDropHandle<()>,
}

impl LentActions {
    pub(super) fn new(translation: &Arc<Translation>, budget: &Budget) -> Arc<Self> {
        Arc::new(Self {
            translation: Arc::clone(translation),
            budget: budget.clone(),
            places: Arc::new(Semaphore::new(MAX_GOALS)),
            lender: watch::Sender::new(None),
            actions: Mutex::default(),
        })
    }

    /// Sets who finds services of a robot of ROS 2, in the terms of that ROS.
    pub(in crate::bus) fn set_lender(&self, lender: Arc<dyn Lender>) {
        self.lender.send_replace(Some(lender));
    }

    /// Follows which actions are looked for until the servant's bus is closed.
    pub(super) async fn follow_graph(self: Arc<Self>) {
        let mut graphs = self.translation.inner.graph();
        loop {
            let now = graphs.borrow_and_update().clone();
            self.update(&now);
            if graphs.changed().await.is_err() {
                return;
            }
        }
    }

    /// Returns the action whose server on the robot publishes a topic or, if `is_received`, receives it; `None` if no
    /// node of the servant looks for such an action.
    pub(in crate::bus) fn find_topic(
        &self,
        topic: &str,
        is_received: bool,
    ) -> Option<(ActionEndpoint, Arc<LentAction>)> {
        let (action, end) = split_action_endpoint(self.translation.version, topic)?;
        if end.is_service() || end.is_published_by_clients() != is_received {
            return None;
        }
        let graph = self.translation.inner.graph().borrow().clone();
        self.update(&graph);
        let actions = self.actions.lock();
        Some((end, Arc::clone(&actions.get(action)?.action)))
    }

    /// Ends all goals, because the robot has gone.
    pub(super) fn clear(&self) {
        self.actions.lock().clear();
    }

    fn update(&self, graph: &Graph) {
        let mut actions = self.actions.lock();
        actions.retain(|name, known| {
            let nodes = graph.actions.get(name).filter(|nodes| self.is_sought(nodes));
            known.action.set_clients(graph, nodes);
            let is_same = nodes.is_none_or(|nodes| nodes.type_name == known.type_name);
            // A client that comes back finds the topics that its robot's server still has.
            is_same && (nodes.is_some() || known.action.is_open())
        });
        let sought = graph.actions.iter().filter(|(_, nodes)| self.is_sought(nodes));
        for (name, nodes) in sought {
            if actions.len() >= MOST_SOUGHT {
                return;
            }
            if actions.contains_key(name) {
                continue;
            }
            // The graph that the robot sees says why an action is not carried.
            if let Ok(action) = LentAction::open(self, name, &nodes.type_name) {
                action.set_clients(graph, Some(nodes));
                let serving = tokio::spawn(serve_while_there(Arc::clone(&action)).in_current_span());
                let type_name = nodes.type_name.clone();
                let sought = SoughtAction { type_name, action, _serving: AbortOnDropHandle::new(serving) };
                actions.insert(name.clone(), sought);
            }
        }
    }

    /// Returns whether a node of the servant looks for an action that no node of it serves.
    fn is_sought(&self, nodes: &ActionNodes) -> bool {
        let own = self.translation.inner.node();
        let is_other = |node: &String| node != own;
        nodes.clients.iter().any(is_other) && !nodes.servers.iter().any(is_other)
    }
}

/// One action of the robot.
pub(in crate::bus) struct LentAction {
    name: String,
    translation: Arc<Translation>,
    twin: Arc<ActionTwin>,
    budget: Budget,
    places: Arc<Semaphore>,
    /// Nodes of the servant that look for it; those of processes that robots have started come first.
    clients: watch::Sender<Vec<String>>,
    /// These nodes as the robot sees them.
    matched: watch::Sender<MatchedPeers>,
    /// Numbers of open parts of the robot's servers.
    parts: watch::Sender<BTreeMap<ActionEndpoint, usize>>,
    robot: RobotServer,
    /// The server in the servant, while the robot has one.
    server: Mutex<Option<Arc<dyn ActionServer>>>,
    /// Reason that the robot was told last.
    reported: Mutex<String>,
    runtime: Handle,
}

/// A server on the robot, as it is reached.
enum RobotServer {
    One(RobotTopics),
    Two(Box<RobotServices>),
}

impl LentAction {
    /// Call it within a Tokio runtime.
    fn open(actions: &LentActions, name: &str, type_name: &str) -> Result<Arc<Self>, BusError> {
        let translation = &actions.translation;
        let twin = translation.twins.action(type_name);
        let twin = twin.map_err(|reason| not_translated(format!("action {name}"), reason))?;
        let robot = match translation.version {
            RosVersion::One => RobotServer::One(RobotTopics::new(name, &twin.twin)?),
            RosVersion::Two => {
                let services = RobotServices::new(name, &twin.twin, actions.lender.subscribe())?;
                RobotServer::Two(Box::new(services))
            }
        };
        Ok(Arc::new(Self {
            name: name.to_owned(),
            translation: Arc::clone(translation),
            twin,
            budget: actions.budget.clone(),
            places: Arc::clone(&actions.places),
            clients: watch::Sender::default(),
            matched: watch::Sender::default(),
            parts: watch::Sender::default(),
            robot,
            server: Mutex::default(),
            reported: Mutex::default(),
            runtime: Handle::current(),
        }))
    }

    /// Subscribes to a topic on which goals are sent or cancelled, for a server of the robot.
    pub(in crate::bus) fn subscribe(
        self: &Arc<Self>,
        end: ActionEndpoint,
        of: &WireType,
        qos: QosProfile,
    ) -> Result<Subscription, BusError> {
        let RobotServer::One(topics) = &self.robot else {
            return Err(BusError::NoTopic(format!("topic of action {}", self.name)));
        };
        self.check_type(end, of)?;
        let messages = topics.listen(end, qos.depth);
        Ok(Subscription {
            dropped: messages.drop_counter(),
            messages,
            matched: self.matched.subscribe(),
            guard: Box::new(OpenPart::new(self, end)),
        })
    }

    /// Advertises a topic with updates about goals, for a server of the robot.
    pub(in crate::bus) fn advertise(
        self: &Arc<Self>,
        end: ActionEndpoint,
        of: &WireType,
    ) -> Result<Box<dyn Publisher>, BusError> {
        self.check_type(end, of).inspect_err(|error| self.report(&error.to_string()))?;
        Ok(Box::new(LentTopicPublisher(OpenPart::new(self, end))))
    }

    fn check_type(&self, end: ActionEndpoint, of: &WireType) -> Result<(), BusError> {
        let what = || format!("topic of action {}", self.name);
        let ours = match &self.robot {
            RobotServer::One(topics) => topics.wire_type(end),
            RobotServer::Two(services) => services.wire_type(end),
        };
        let ours = ours.ok_or_else(|| BusError::NoTopic(what()))?;
        if ours.is_compatible_with(of) {
            return Ok(());
        }
        Err(BusError::TypeMismatch { what: what(), theirs: of.to_string(), ours: ours.to_string() })
    }

    /// Sets the nodes that look for the action.
    fn set_clients(&self, graph: &Graph, nodes: Option<&ActionNodes>) {
        let own = self.translation.inner.node();
        let clients = nodes.into_iter().flat_map(|nodes| &nodes.clients).filter(|node| *node != own);
        let mut clients: Vec<String> = clients.cloned().collect();
        let linked: BTreeSet<&str> = graph.enclaves.keys().filter_map(|mark| linked_node(mark)).collect();
        // Links pass on what their own nodes send, and goals do not tell who sends them.
        clients.sort_by_key(|node| !linked.contains(graph.process_owner(node)));
        let mut matched = MatchedPeers::default();
        for node in &clients {
            let id = PeerId::from(graph.process_owner(node));
            if !matched.contains(&id) {
                matched.peers.push(TopicPeer { id, connected: true, offer: None });
            }
        }
        self.matched.send_if_modified(|before| std::mem::replace(before, matched.clone()) != matched);
        self.clients.send_if_modified(|before| std::mem::replace(before, clients.clone()) != clients);
    }

    /// Returns whether a part of a server on the robot is open.
    fn is_open(&self) -> bool {
        !self.parts.borrow().is_empty()
    }

    /// Tells the robot why goals do not reach its server, unless it knows.
    fn report(&self, reason: &str) {
        if std::mem::replace(&mut *self.reported.lock(), reason.to_owned()) == reason {
            return;
        }
        let text = format!("action {} of the robot cannot be used by nodes in the cloud: {reason}", self.name);
        self.translation.losses.report(&self.name, &text);
    }

    /// Waits until a server of the robot can be sent goals.
    async fn wait_until_there(&self) {
        match &self.robot {
            RobotServer::One(_) => drop(self.parts.subscribe().wait_for(topics::has_server).await),
            RobotServer::Two(services) => services.connect(&self.clients, |reason| self.report(reason)).await,
        }
    }

    /// Waits until it is gone.
    async fn wait_until_gone(&self) {
        match &self.robot {
            RobotServer::One(_) => {
                let mut parts = self.parts.subscribe();
                loop {
                    drop(parts.wait_for(|parts| !topics::has_server(parts)).await);
                    if timeout(GRACE, parts.wait_for(topics::has_server)).await.is_err() {
                        return;
                    }
                }
            }
            RobotServer::Two(services) => services.wait_until_gone().await,
        }
    }

    /// Sends a goal of the robot's type to its server.
    fn send_goal(self: &Arc<Self>, id: &str, goal: &[u8]) -> Result<(), FailureReason> {
        let place = Arc::clone(&self.places).try_acquire_owned();
        let place = place.map_err(|_| {
            FailureReason::new(format!(
                "{MAX_GOALS} goals of this service are under way on the robot already; wait for some to end"
            ))
        })?;
        let held = self.budget.take(id.len() + goal.len());
        let held = held.map_err(|full| FailureReason::new(full.to_string()))?;
        let events = LentGoalEvents::new(self, id, place, held);
        match &self.robot {
            RobotServer::One(topics) => topics.send_goal(self.client(), id, goal, Arc::new(events)),
            RobotServer::Two(services) => services.send_goal(id, goal, Arc::new(events))?,
        }
        Ok(())
    }

    fn end_goal(&self, id: &str, end: GoalEnd) {
        if let Some(server) = self.current_server() {
            server.end_goal(id, end);
        }
    }

    /// Returns the server in the servant, while the robot has one.
    fn current_server(&self) -> Option<Arc<dyn ActionServer>> {
        self.server.lock().clone()
    }

    fn cancel_goal(&self, id: &str) {
        match &self.robot {
            RobotServer::One(topics) => topics.cancel_goal(self.client(), id),
            RobotServer::Two(services) => services.cancel_goal(id),
        }
    }

    /// Cancels all goals, which nobody waits for any more.
    fn abandon_goals(&self) {
        match &self.robot {
            RobotServer::One(topics) => topics.abandon_goals(self.client()),
            RobotServer::Two(services) => services.disconnect(),
        }
    }

    /// Returns the node that goals come from, as the robot sees it.
    fn client(&self) -> PeerId {
        let matched = self.matched.borrow();
        let first = matched.peers.first().map(|peer| peer.id.clone());
        first.unwrap_or_else(|| PeerId::from(self.translation.inner.node()))
    }

    /// Returns the end of a goal that has no result.
    fn end_without_result(&self, outcome: GoalOutcome, text: String) -> GoalEnd {
        GoalEnd { outcome, text, result: default_message(&self.twin.twin.result).into() }
    }
}

/// Serves an action in the servant while the robot has a server and a node looks for it.
async fn serve_while_there(action: Arc<LentAction>) {
    let mut clients = action.clients.subscribe();
    loop {
        drop(clients.wait_for(|clients| !clients.is_empty()).await);
        let unsought = async { drop(clients.wait_for(Vec::is_empty).await) };
        tokio::select! {
            () = action.wait_until_there() => {}
            () = unsought => continue,
        }
        let serving = match ServedAction::begin(&action) {
            Ok(serving) => serving,
            Err(error) => {
                action.report(&error.to_string());
                sleep(GRACE).await;
                continue;
            }
        };
        let unsought = async { drop(clients.wait_for(Vec::is_empty).await) };
        tokio::select! {
            () = action.wait_until_gone() => {}
            () = unsought => {}
        }
        drop(serving);
    }
}

/// A server in the servant; its goals end when this is dropped.
struct ServedAction(Arc<LentAction>);

impl ServedAction {
    fn begin(action: &Arc<LentAction>) -> Result<Self, BusError> {
        let handler = Arc::new(LentGoalHandler::new(action));
        // What cannot be served needs no connection to the robot's server either.
        let served = Self(Arc::clone(action));
        let server = TranslatedActionServer::open(&action.translation, &action.name, &action.twin, handler)?;
        *action.server.lock() = Some(Arc::from(server));
        Ok(served)
    }
}

impl Drop for ServedAction {
    fn drop(&mut self) {
        self.0.abandon_goals();
        // Unlocked when it is dropped, which aborts the goals.
        let server = self.0.server.lock().take();
        drop(server);
    }
}

/// A topic of a server on the robot; it counts until it is dropped.
struct OpenPart {
    action: Arc<LentAction>,
    end: ActionEndpoint,
}

impl OpenPart {
    fn new(action: &Arc<LentAction>, end: ActionEndpoint) -> Self {
        action.parts.send_modify(|parts| *parts.entry(end).or_default() += 1);
        Self { action: Arc::clone(action), end }
    }
}

impl Drop for OpenPart {
    fn drop(&mut self) {
        self.action.parts.send_modify(|parts| {
            let count = parts.get(&self.end).copied().unwrap_or_default();
            if count > 1 {
                parts.insert(self.end, count - 1);
            } else {
                parts.remove(&self.end);
            }
        });
    }
}

/// A topic on which a server of the robot publishes.
struct LentTopicPublisher(OpenPart);

impl Publisher for LentTopicPublisher {
    fn publish(&self, message: Bytes) {
        let OpenPart { action, end } = &self.0;
        match &action.robot {
            RobotServer::One(topics) => topics.on_message(*end, &message),
            RobotServer::Two(services) => services.on_message(*end, message),
        }
    }

    fn matched_subscribers(&self) -> watch::Receiver<MatchedPeers> {
        self.0.action.matched.subscribe()
    }
}
