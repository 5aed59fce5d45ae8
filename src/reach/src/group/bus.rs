//! A group as one robot's bus: services and actions of the interface, nothing else.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use package::interface::Interface;
use parking_lot::Mutex;
use ros::bus::{
    ActionClient, ActionHandler, ActionNodes, ActionServer, Bus, BusError, Digest, Graph,
    Publisher, Qos, RosVersion, ServiceHandler, ServiceType, Subscription, TopicNodes, WireType,
};
use ros::schema::{ActionDef, Registry};
use tokio::sync::watch;

use super::Group;
use super::action_topics::{ActionTopics, End, topics_of};
use super::dispatch::Robot;
use super::goals::GroupClient;

/// The name of a node that the interface does not tell.
const SOMEBODY: &str = "/shared";

/// What a robot sees of an interface.
pub(super) fn graph_of(interface: &Interface) -> Graph {
    let named = |node: &str| match node {
        "" => SOMEBODY.to_owned(),
        node => node.to_owned(),
    };
    let services = interface.services.iter();
    let services: BTreeMap<String, String> = services
        .map(|service| (service.name.clone(), named(&service.node)))
        .collect();
    let actions = interface.actions.iter().map(|action| {
        let nodes = ActionNodes {
            type_name: action.type_name.clone(),
            servers: vec![named(&action.node)],
            topics: topics_of(&action.name).map(|(_, topic)| topic).collect(),
            ..ActionNodes::default()
        };
        (action.name.clone(), nodes)
    });
    let topics = interface.actions.iter().flat_map(|action| {
        topics_of(&action.name).map(|(end, topic)| {
            let mut ends = TopicNodes {
                type_name: end.type_name(&action.type_name),
                ..TopicNodes::default()
            };
            let here = match end.is_of_clients() {
                true => &mut ends.subscribers,
                false => &mut ends.publishers,
            };
            here.push(named(&action.node));
            (topic, ends)
        })
    });
    let topics: BTreeMap<String, TopicNodes> = topics.collect();
    let actions: BTreeMap<String, ActionNodes> = actions.collect();
    let nodes = services
        .values()
        .chain(actions.values().flat_map(|action| action.servers.iter()));
    Graph {
        generation: 1,
        nodes: nodes.map(|node| (node.clone(), String::new())).collect(),
        services: services.clone(),
        actions: actions.clone(),
        topics,
        ..Graph::default()
    }
}

/// One robot's.
pub(super) struct GroupBus {
    pub(super) group: Arc<Group>,
    pub(super) robot: Robot,
    registry: Arc<Registry>,
    /// Counts what waits here for servants.
    budget: Budget,
    /// By name, as far as they are used by their topics.
    actions: Mutex<HashMap<String, Arc<ActionTopics>>>,
}

impl GroupBus {
    /// The end of an action that a topic is.
    fn end(&self, topic: &str) -> Result<(End, Arc<ActionTopics>), BusError> {
        let actions = self.group.interface.actions.iter();
        let found = actions
            .flat_map(|action| topics_of(&action.name).map(move |(end, name)| (action, end, name)))
            .find(|(.., name)| name == topic);
        let Some((action, end, _)) = found else {
            return Err(BusError::NotShared(format!("topic {topic}")));
        };
        let mut actions = self.actions.lock();
        if let Some(known) = actions.get(&action.name) {
            return Ok((end, Arc::clone(known)));
        }
        let of = self.registry.action(&action.type_name);
        let of = of.map_err(|error| BusError::Protocol {
            what: format!("action {}", action.name),
            reason: error.to_string(),
        })?;
        let names = (&*action.name, &*action.node);
        let topics = ActionTopics::new(
            &self.group,
            self.robot,
            names,
            &of,
            &self.registry,
            &self.budget,
        )?;
        actions.insert(action.name.clone(), Arc::clone(&topics));
        Ok((end, topics))
    }
}

impl Drop for GroupBus {
    fn drop(&mut self) {
        // Goals outlive who sent them, or their results would be lost with a connection; not their robot's place.
        for topics in self.actions.lock().values() {
            topics.cancel_all();
        }
    }
}

impl Group {
    /// A bus for one robot; `registry` holds the definitions of its actions, what waits for servants counts in `budget`.
    pub fn bus(self: &Arc<Self>, registry: &Arc<Registry>, budget: &Budget) -> Arc<dyn Bus> {
        let robot = self
            .robots
            .fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        Arc::new(GroupBus {
            group: Arc::clone(self),
            robot,
            registry: Arc::clone(registry),
            budget: budget.clone(),
            actions: Mutex::default(),
        })
    }

    fn service(&self, name: &str) -> Result<&package::interface::Service, BusError> {
        let found = self
            .interface
            .services
            .iter()
            .find(|service| service.name == name);
        found.ok_or_else(|| BusError::NoService(name.to_owned()))
    }
}

#[async_trait]
impl Bus for GroupBus {
    fn version(&self) -> RosVersion {
        self.group.ros
    }

    async fn distribution(&self) -> String {
        self.group.distribution.clone()
    }

    fn graph(&self) -> watch::Receiver<Arc<Graph>> {
        self.group.graph.subscribe()
    }

    async fn subscribe(
        &self,
        topic: &str,
        of: WireType,
        qos: Qos,
    ) -> Result<Subscription, BusError> {
        match self.end(topic)? {
            (end, topics) if !end.is_of_clients() => topics.subscribe(end, &of, qos),
            // Others' goals.
            _ => Err(BusError::NotShared(format!("listening to {topic}"))),
        }
    }

    async fn advertise(
        &self,
        topic: &str,
        of: WireType,
        _qos: Qos,
    ) -> Result<Box<dyn Publisher>, BusError> {
        match self.end(topic)? {
            (end, topics) if end.is_of_clients() => topics.advertise(end, &of),
            _ => Err(BusError::NotShared(format!("publishing {topic}"))),
        }
    }

    async fn call(
        &self,
        service: &str,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        self.call_typed(service, &Digest::any(), request, timeout)
            .await
    }

    async fn call_typed(
        &self,
        service: &str,
        digest: &Digest,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        self.group.service(service)?;
        let group = &self.group;
        group
            .call(self.robot, service, digest, request, timeout)
            .await
    }

    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError> {
        let known = self.group.service(service)?;
        if known.md5.is_empty() {
            let servant = self.group.members.borrow().values().next().cloned();
            let servant = servant.ok_or_else(|| BusError::NoService(service.to_owned()))?;
            return servant.bus.service_type(service).await;
        }
        Ok(ServiceType::new(&*known.type_name, &known.md5))
    }

    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError> {
        let (end, topics) = self.end(topic)?;
        Ok(topics.wire_type(end))
    }

    async fn serve(
        &self,
        service: &str,
        _service_type: ServiceType,
        _handler: Arc<dyn ServiceHandler>,
    ) -> Result<Box<dyn Send + Sync>, BusError> {
        Err(BusError::NotShared(format!("serving {service}")))
    }

    fn action_client(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
    ) -> Result<Box<dyn ActionClient>, BusError> {
        let mut known = self.group.interface.actions.iter();
        if !known.any(|known| known.name == action) {
            return Err(BusError::NotShared(format!("action {action}")));
        }
        Ok(Box::new(GroupClient::new(
            &self.group,
            self.robot,
            action,
            of,
        )))
    }

    fn serve_action(
        &self,
        action: &str,
        _of: &Arc<ActionDef>,
        _handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError> {
        Err(BusError::NotShared(format!("serving {action}")))
    }
}
