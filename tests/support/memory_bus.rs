//! A ROS system in memory that behaves like ROS 2: endpoints are matched by type and quality of service, definitions
//! are not exchanged, actions are native, parameters belong to nodes, and there are no services of other systems. The
//! users of a bus should not notice the difference.

#[path = "memory_bus/parameters.rs"]
mod parameters;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    ActionClient, ActionHandler, ActionNodes, ActionServer, Bus, BusError, CallFate, Digest, GoalEnd, GoalError,
    GoalEvents, GoalOutcome, Graph, IncompatiblePeer, MatchedPeers, MessageSender, NodeEntities, NodeParameters,
    ParamValue, PeerId, Publisher, QosProfile, QosReliability, RosVersion, SerializedMessage, ServiceHandler,
    ServiceType, Subscription, TopicNodes, TopicPeer, WireFormat, WireType, message_queue,
};
use ros::schema::ActionDef;
use tokio::sync::watch;
use tokio::time::timeout;

/// All nodes, and their registrations.
#[derive(Default)]
pub struct MemorySystem {
    state: Mutex<State>,
    graph: watch::Sender<Arc<Graph>>,
}

#[derive(Default)]
struct State {
    numbers: u128,
    nodes: BTreeSet<String>,
    /// Parameters by node.
    parameters: BTreeMap<String, BTreeMap<String, ParamValue>>,
    topics: BTreeMap<String, Topic>,
    services: BTreeMap<String, Service>,
    actions: BTreeMap<String, Action>,
    /// Clients of services, by number: node, service and type.
    clients: BTreeMap<u128, (String, String, ServiceType)>,
    /// Receivers of parameter events.
    watchers: parameters::Watchers,
}

#[derive(Default)]
struct Topic {
    /// True if its endpoints have changed since the last notification.
    changed: bool,
    publishers: Vec<Publication>,
    subscribers: Vec<Listener>,
}

struct Publication {
    id: PeerId,
    of: Arc<WireType>,
    qos: QosProfile,
    last: Option<Bytes>,
    matched: watch::Sender<MatchedPeers>,
}

struct Listener {
    id: PeerId,
    of: WireType,
    /// Quality of service that publishers must offer; `None` for a bus, for which it is only a preference.
    demanded: Option<QosProfile>,
    messages: MessageSender,
    matched: watch::Sender<MatchedPeers>,
}

struct Service {
    number: u128,
    node: String,
    of: ServiceType,
    handler: Arc<dyn ServiceHandler>,
}

#[derive(Default)]
struct Action {
    type_name: String,
    /// The server, if there is one.
    server: Option<(u128, String, Arc<dyn ActionHandler>)>,
    clients: BTreeMap<u128, String>,
    /// Goals in progress, with the number of their client and the receiver of their events.
    goals: HashMap<String, (u128, Arc<dyn GoalEvents>)>,
}

/// Names the quality of service as the real bus does.
fn profile(qos: &QosProfile) -> &'static str {
    match (qos.reliability, qos.is_latching()) {
        (QosReliability::Reliable, false) => "reliable, volatile",
        (QosReliability::Reliable, true) => "reliable, transient_local",
        (QosReliability::BestEffort, false) => "best_effort, volatile",
        (QosReliability::BestEffort, true) => "best_effort, transient_local",
    }
}

impl Publication {
    /// Returns whether the publisher belongs to another node: a node does not receive its own publications.
    fn is_beside(&self, listener: &Listener) -> bool {
        self.id.node() != listener.id.node()
    }

    fn is_of_type(&self, listener: &Listener) -> bool {
        let named = listener.of.name == "*" || listener.of.name == self.of.name;
        named && self.of.is_compatible_with(&listener.of)
    }

    /// Returns which demand of the listener the publisher does not meet.
    fn lacks(&self, listener: &Listener) -> Option<String> {
        let demanded = listener.demanded.filter(QosProfile::is_latching)?;
        let offers_less = demanded.durability != self.qos.durability;
        offers_less.then(|| {
            format!(
                "durability: the publisher offers volatile, the subscriber asks for transient_local (publisher: {}; \
                 subscriber: {})",
                profile(&self.qos),
                profile(&demanded)
            )
        })
    }

    /// Returns why nothing passes to the listener, as seen from one of both sides.
    fn refuses(&self, listener: &Listener, theirs: &WireType, ours: &WireType) -> Option<String> {
        if self.is_of_type(listener) {
            self.lacks(listener)
        } else {
            Some(format!("its type is {theirs} there and {ours} here"))
        }
    }

    /// Returns whether publications of this endpoint reach the listener.
    fn reaches(&self, listener: &Listener) -> bool {
        self.is_beside(listener) && self.is_of_type(listener) && self.lacks(listener).is_none()
    }

    fn message(&self, bytes: Bytes) -> SerializedMessage {
        SerializedMessage {
            bytes,
            wire_type: self.of.clone(),
            publisher: self.id.clone(),
            latching: self.qos.is_latching(),
        }
    }
}

impl Topic {
    /// Notifies all endpoints of their matches.
    fn show(&self) {
        let tell = |end: &watch::Sender<MatchedPeers>, now: MatchedPeers| {
            end.send_if_modified(|before| std::mem::replace(before, now.clone()) != now);
        };
        let add = |matched: &mut MatchedPeers, id: &PeerId, refusal: Option<String>| match refusal {
            None => matched.peers.push(TopicPeer { id: id.clone(), connected: true, offer: None }),
            Some(why) => matched.refused.push(IncompatiblePeer { peer: id.clone(), why }),
        };
        for publisher in &self.publishers {
            let mut now = MatchedPeers::default();
            let others = self.subscribers.iter();
            for other in others.filter(|other| publisher.is_beside(other)) {
                let refusal = publisher.refuses(other, &other.of, &publisher.of);
                add(&mut now, &other.id, refusal);
            }
            tell(&publisher.matched, now);
        }
        for listener in &self.subscribers {
            let mut now = MatchedPeers::default();
            let others = self.publishers.iter();
            for other in others.filter(|other| other.is_beside(listener)) {
                let refusal = other.refuses(listener, &other.of, &listener.of);
                add(&mut now, &other.id, refusal);
            }
            tell(&listener.matched, now);
        }
    }
}

impl State {
    fn number(&mut self) -> u128 {
        self.numbers += 1;
        self.numbers
    }

    fn graph(&self, generation: u64) -> Graph {
        let node = |id: &PeerId| id.node().to_owned();
        let topics = self.topics.iter().map(|(name, topic)| {
            let publishers = topic.publishers.iter();
            let types = publishers.map(|it| &*it.of);
            let types = types.chain(topic.subscribers.iter().map(|it| &it.of));
            let named = types.map(|of| of.name.as_str()).find(|name| *name != "*");
            let nodes = TopicNodes {
                type_name: named.unwrap_or("*").to_owned(),
                publishers: topic.publishers.iter().map(|it| node(&it.id)).collect(),
                subscribers: topic.subscribers.iter().map(|it| node(&it.id)).collect(),
            };
            (name.clone(), nodes)
        });
        let actions = self.actions.iter().map(|(name, action)| {
            let servers = action.server.iter().map(|(_, node, _)| node.clone());
            let nodes = ActionNodes {
                type_name: action.type_name.clone(),
                servers: servers.collect(),
                clients: action.clients.values().cloned().collect(),
                topics: Vec::new(),
            };
            (name.clone(), nodes)
        });
        let services = self.services.iter();
        let services = services.map(|(name, it)| (name.clone(), it.node.clone()));
        let lists = self.parameters.keys();
        let lists = lists.map(|node| (format!("{node}/list_parameters"), node.clone()));
        let mut sought: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for (node, service, _) in self.clients.values() {
            if !self.services.contains_key(service) {
                sought.entry(service.clone()).or_default().push(node.clone());
            }
        }
        let nodes = self.nodes.iter();
        Graph {
            generation,
            topics: topics.collect(),
            services: services.chain(lists).collect(),
            actions: actions.collect(),
            nodes: nodes.map(|name| (name.clone(), "memory".to_owned())).collect(),
            sought,
            ends: self.ends(),
            ..Graph::default()
        }
    }
}

impl State {
    /// Returns the endpoints of each node. A quality of service that is not demanded counts as requesting nothing.
    fn ends(&self) -> BTreeMap<String, NodeEntities> {
        let mut all: BTreeMap<String, NodeEntities> = BTreeMap::new();
        for (name, topic) in &self.topics {
            for publisher in &topic.publishers {
                let ends = all.entry(publisher.id.node().to_owned()).or_default();
                let end = (WireType::clone(&publisher.of), publisher.qos);
                ends.publishers.insert(name.clone(), end);
            }
            for listener in &topic.subscribers {
                let ends = all.entry(listener.id.node().to_owned()).or_default();
                let nothing = QosProfile { reliability: QosReliability::BestEffort, ..QosProfile::keep_last(1) };
                let end = (listener.of.clone(), listener.demanded.unwrap_or(nothing));
                ends.subscribers.insert(name.clone(), end);
            }
        }
        for (name, served) in &self.services {
            let ends = all.entry(served.node.clone()).or_default();
            ends.services.insert(name.clone(), served.of.clone());
        }
        for (node, service, of) in self.clients.values() {
            let ends = all.entry(node.clone()).or_default();
            ends.clients.insert(service.clone(), of.clone());
        }
        all
    }
}

impl MemorySystem {
    /// Joins as a node of this name.
    pub fn join(self: &Arc<Self>, node: &str) -> Arc<MemoryBus> {
        self.change(|state| state.nodes.insert(node.to_owned()));
        Arc::new(MemoryBus { system: self.clone(), node: node.to_owned(), demands: false })
    }

    /// Joins as a node that only receives from publishers that offer the requested quality of service.
    #[allow(dead_code, reason = "who includes this file need not have such nodes")]
    pub fn join_demanding(self: &Arc<Self>, node: &str) -> Arc<MemoryBus> {
        self.change(|state| state.nodes.insert(node.to_owned()));
        Arc::new(MemoryBus { system: self.clone(), node: node.to_owned(), demands: true })
    }

    /// Changes the registrations and notifies the observers.
    fn change<T>(&self, by: impl FnOnce(&mut State) -> T) -> T {
        let mut state = self.state.lock();
        let done = by(&mut state);
        state.topics.retain(|_, topic| {
            if std::mem::take(&mut topic.changed) {
                topic.show();
            }
            !topic.publishers.is_empty() || !topic.subscribers.is_empty()
        });
        let unused = |action: &Action| action.server.is_none() && action.clients.is_empty();
        state.actions.retain(|_, action| !unused(action));
        let generation = self.graph.borrow().generation + 1;
        self.graph.send_replace(Arc::new(state.graph(generation)));
        done
    }
}

/// One node of a system in memory.
pub struct MemoryBus {
    system: Arc<MemorySystem>,
    node: String,
    /// True if its requests to publishers are requirements.
    demands: bool,
}

impl Drop for MemoryBus {
    fn drop(&mut self) {
        let node = &self.node;
        self.system.change(|state| {
            state.parameters.remove(node);
            state.nodes.remove(node)
        });
    }
}

/// Undoes a registration on drop.
struct Guard(Option<Box<dyn FnOnce() + Send + Sync>>);

impl Drop for Guard {
    fn drop(&mut self) {
        if let Some(undo) = self.0.take() {
            undo();
        }
    }
}

impl MemoryBus {
    fn guard<T>(&self, undo: impl FnOnce(&mut State) -> T + Send + Sync + 'static) -> Guard {
        let system = self.system.clone();
        Guard(Some(Box::new(move || drop(system.change(undo)))))
    }

    /// Registers that this node may call a service, until the guard is dropped.
    #[allow(dead_code, reason = "who includes this file need not have such nodes")]
    pub fn seek(&self, service: &str, of: ServiceType) -> Box<dyn Send + Sync> {
        let number = self.system.change(|state| {
            let number = state.number();
            let client = (self.node.clone(), service.to_owned(), of);
            state.clients.insert(number, client);
            number
        });
        Box::new(self.guard(move |state| state.clients.remove(&number)))
    }

    fn find_served(&self, service: &str) -> Result<(ServiceType, Arc<dyn ServiceHandler>), BusError> {
        let state = self.system.state.lock();
        let found = state.services.get(service);
        found
            .map(|served| (served.of.clone(), served.handler.clone()))
            .ok_or_else(|| BusError::NoService(service.to_owned()))
    }
}

struct MemoryPublisher {
    system: Arc<MemorySystem>,
    topic: String,
    id: PeerId,
    matched: watch::Receiver<MatchedPeers>,
    _guard: Guard,
}

impl Publisher for MemoryPublisher {
    fn publish(&self, bytes: Bytes) {
        let mut state = self.system.state.lock();
        let Some(topic) = state.topics.get_mut(&self.topic) else {
            return;
        };
        let publisher = topic.publishers.iter_mut().find(|it| it.id == self.id);
        let Some(publisher) = publisher else { return };
        if publisher.qos.is_latching() {
            publisher.last = Some(bytes.clone());
        }
        for listener in topic.subscribers.iter().filter(|it| publisher.reaches(it)) {
            listener.messages.send(publisher.message(bytes.clone()));
        }
    }

    fn matched_subscribers(&self) -> watch::Receiver<MatchedPeers> {
        self.matched.clone()
    }
}

#[async_trait]
impl Bus for MemoryBus {
    fn version(&self) -> RosVersion {
        RosVersion::Two
    }

    async fn distribution(&self) -> String {
        "memory".to_owned()
    }

    fn node(&self) -> &str {
        &self.node
    }

    fn graph(&self) -> watch::Receiver<Arc<Graph>> {
        self.system.graph.subscribe()
    }

    async fn subscribe(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Subscription, BusError> {
        let (sender, messages) = message_queue(qos.depth);
        let (end, matched) = watch::channel(MatchedPeers::default());
        let id = self.system.change(|state| {
            let id = PeerId::new(self.node.as_str(), state.number());
            let topic = state.topics.entry(topic.to_owned()).or_default();
            topic.changed = true;
            let listener =
                Listener { id: id.clone(), of, demanded: self.demands.then_some(qos), messages: sender, matched: end };
            let kept = topic.publishers.iter().filter(|it| it.reaches(&listener));
            for publisher in kept.filter(|_| qos.is_latching()) {
                if let Some(last) = publisher.last.clone() {
                    listener.messages.send(publisher.message(last));
                }
            }
            topic.subscribers.push(listener);
            id
        });
        let topic = topic.to_owned();
        let guard = self.guard(move |state| {
            if let Some(topic) = state.topics.get_mut(&topic) {
                topic.changed = true;
                topic.subscribers.retain(|it| it.id != id);
            }
        });
        Ok(Subscription { dropped: messages.drop_counter(), messages, matched, guard: Box::new(guard) })
    }

    async fn advertise(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Box<dyn Publisher>, BusError> {
        let (end, matched) = watch::channel(MatchedPeers::default());
        let id = self.system.change(|state| {
            let id = PeerId::new(self.node.as_str(), state.number());
            let topic = state.topics.entry(topic.to_owned()).or_default();
            topic.changed = true;
            topic.publishers.push(Publication {
                id: id.clone(),
                of: Arc::new(WireType { definition: String::new(), ..of }),
                qos,
                last: None,
                matched: end,
            });
            id
        });
        let (name, own) = (topic.to_owned(), id.clone());
        let guard = self.guard(move |state| {
            if let Some(topic) = state.topics.get_mut(&name) {
                topic.changed = true;
                topic.publishers.retain(|it| it.id != own);
            }
        });
        Ok(Box::new(MemoryPublisher {
            system: self.system.clone(),
            topic: topic.to_owned(),
            id,
            matched,
            _guard: guard,
        }))
    }

    async fn call_typed(
        &self,
        service: &str,
        digest: &Digest,
        request: Bytes,
        patience: Duration,
    ) -> Result<Bytes, BusError> {
        let (of, handler) = self.find_served(service)?;
        if !of.digest.is_compatible_with(digest) {
            return Err(BusError::TypeMismatch {
                what: format!("service {service}"),
                theirs: format!("{} {}", of.name, of.digest),
                ours: digest.to_string(),
            });
        }
        match timeout(patience, handler.call(request, &self.node)).await {
            Ok(answer) => answer.map_err(|reason| BusError::CallFailed {
                service: service.to_owned(),
                reason: reason.into(),
                fate: CallFate::Answered,
            }),
            Err(_) => Err(BusError::Timeout { what: format!("service {service}"), after: patience }),
        }
    }

    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError> {
        Ok(self.find_served(service)?.0)
    }

    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError> {
        let state = self.system.state.lock();
        let known = state.topics.get(topic);
        let known = known.ok_or_else(|| BusError::NoTopic(topic.to_owned()))?;
        let publishers = known.publishers.iter().map(|it| WireType::clone(&it.of));
        let mut types = publishers.chain(known.subscribers.iter().map(|it| it.of.clone()));
        let told = types.find(|of| !of.digest.is_any());
        Ok(told.unwrap_or_else(|| WireType { format: WireFormat::Cdr, ..WireType::any() }))
    }

    async fn serve(
        &self,
        service: &str,
        of: ServiceType,
        handler: Arc<dyn ServiceHandler>,
    ) -> Result<Box<dyn Send + Sync>, BusError> {
        let name = service.to_owned();
        let number = self.system.change(|state| {
            let earlier = state.services.get(&name);
            if earlier.is_some_and(|earlier| earlier.node == self.node) {
                return Err(BusError::AlreadyServed(name.clone()));
            }
            let number = state.number();
            let served = Service { number, node: self.node.clone(), of, handler };
            state.services.insert(name.clone(), served);
            Ok(number)
        })?;
        Ok(Box::new(self.guard(move |state| {
            if state.services.get(&name).is_some_and(|it| it.number == number) {
                state.services.remove(&name);
            }
        })))
    }

    fn action_client(&self, action: &str, of: &Arc<ActionDef>) -> Result<Box<dyn ActionClient>, BusError> {
        let number = self.system.change(|state| {
            let number = state.number();
            let known = state.actions.entry(action.to_owned()).or_default();
            // The type is determined by the server.
            if known.server.is_none() {
                known.type_name.clone_from(&of.name);
            }
            known.clients.insert(number, self.node.clone());
            number
        });
        Ok(Box::new(MemoryClient {
            system: self.system.clone(),
            action: action.to_owned(),
            type_name: of.name.clone(),
            number,
        }))
    }

    fn serve_action(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError> {
        let number = self.system.change(|state| {
            let number = state.number();
            let known = state.actions.entry(action.to_owned()).or_default();
            known.type_name.clone_from(&of.name);
            known.server = Some((number, self.node.clone(), handler));
            number
        });
        Ok(Box::new(MemoryServer { system: self.system.clone(), action: action.to_owned(), number }))
    }

    fn node_parameters(&self) -> Result<&dyn NodeParameters, BusError> {
        Ok(self)
    }
}

struct MemoryClient {
    system: Arc<MemorySystem>,
    action: String,
    type_name: String,
    number: u128,
}

impl MemoryClient {
    fn server(&self) -> Option<Arc<dyn ActionHandler>> {
        let state = self.system.state.lock();
        let (.., handler) = state.actions.get(&self.action)?.server.as_ref()?;
        Some(handler.clone())
    }
}

#[async_trait]
impl ActionClient for MemoryClient {
    async fn wait_for_server(&self, patience: Duration) -> Result<(), BusError> {
        let mut graph = self.system.graph.subscribe();
        let served = |graph: &Arc<Graph>| {
            let action = graph.actions.get(&self.action);
            action.is_some_and(|action| !action.servers.is_empty())
        };
        match timeout(patience, graph.wait_for(served)).await {
            Ok(Ok(graph)) => match graph.action_type_mismatch(&self.action, &self.type_name) {
                Some(other) => Err(other),
                None => Ok(()),
            },
            Ok(Err(_)) => Err(BusError::Closed),
            Err(_) => Err(BusError::Timeout { what: format!("action {}", self.action), after: patience }),
        }
    }

    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        let Some(server) = self.server() else {
            return events.on_ended(Err(GoalError::ServerGone(self.action.clone())));
        };
        {
            let mut state = self.system.state.lock();
            let action = state.actions.entry(self.action.clone()).or_default();
            action.goals.insert(id.to_owned(), (self.number, events.clone()));
        }
        let taken = server.on_goal(id, goal);
        if let Err(reason) = taken {
            let mut state = self.system.state.lock();
            let action = state.actions.entry(self.action.clone()).or_default();
            action.goals.remove(id);
            drop(state);
            events.on_ended(Ok(GoalEnd {
                outcome: GoalOutcome::Rejected,
                text: reason.into_string(),
                result: Bytes::new(),
            }));
        } else if !server.is_answer_deferred() {
            events.on_accepted();
        }
    }

    fn cancel_goal(&self, id: &str) {
        let under_way = {
            let state = self.system.state.lock();
            let action = state.actions.get(&self.action);
            action.and_then(|action| Some(action.goals.get(id)?.1.clone()))
        };
        if let Some((server, events)) = self.server().zip(under_way) {
            events.on_cancel_response(true);
            server.on_cancel(id);
        }
    }
}

impl Drop for MemoryClient {
    fn drop(&mut self) {
        let server = self.server();
        let gone: Vec<String> = self.system.change(|state| {
            let Some(action) = state.actions.get_mut(&self.action) else {
                return Vec::new();
            };
            action.clients.remove(&self.number);
            let goals = action.goals.iter();
            let own = goals.filter(|(_, (client, _))| *client == self.number);
            own.map(|(id, _)| id.clone()).collect()
        });
        for id in gone {
            if let Some(server) = &server {
                server.on_cancel(&id);
            }
        }
    }
}

struct MemoryServer {
    system: Arc<MemorySystem>,
    action: String,
    number: u128,
}

impl MemoryServer {
    /// Returns the events of a goal that has not ended.
    fn goal_events(&self, id: &str) -> Option<Arc<dyn GoalEvents>> {
        let state = self.system.state.lock();
        let action = state.actions.get(&self.action);
        action.and_then(|action| action.goals.get(id).map(|(_, events)| events.clone()))
    }
}

impl ActionServer for MemoryServer {
    fn accept_goal(&self, id: &str) {
        if let Some(events) = self.goal_events(id) {
            events.on_waiting();
        }
    }

    fn execute_goal(&self, id: &str) {
        if let Some(events) = self.goal_events(id) {
            events.on_accepted();
        }
    }

    fn publish_feedback(&self, id: &str, feedback: Bytes) -> bool {
        match self.goal_events(id) {
            Some(events) => {
                events.on_feedback(feedback);
                true
            }
            None => false,
        }
    }

    fn end_goal(&self, id: &str, end: GoalEnd) -> bool {
        let goal = {
            let mut state = self.system.state.lock();
            let action = state.actions.get_mut(&self.action);
            action.and_then(|action| action.goals.remove(id))
        };
        match goal {
            Some((_, events)) => {
                events.on_ended(Ok(end));
                true
            }
            None => false,
        }
    }
}

impl Drop for MemoryServer {
    fn drop(&mut self) {
        let left = self.system.change(|state| {
            let action = state.actions.get_mut(&self.action)?;
            let (number, ..) = action.server.as_ref()?;
            if *number != self.number {
                return None;
            }
            action.server = None;
            Some(std::mem::take(&mut action.goals))
        });
        for (_, events) in left.unwrap_or_default().into_values() {
            events.on_ended(Err(GoalError::ServerGone(self.action.clone())));
        }
    }
}
