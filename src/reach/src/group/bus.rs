//! The bus of one robot in a group: services and actions of the interface under the names of a [`GroupView`], nothing
//! else.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    ActionClient, ActionEndpoint, ActionHandler, ActionServer, Bus, BusError, Digest, GlobalParameters, Graph,
    NodeParameters, Publisher, QosProfile, RosVersion, ServiceHandler, ServiceType, Subscription, WireType,
};
use ros::ros1::actions::goal_topics::GoalTopics;
use ros::ros2::actions::goal_services::{GoalNotices, GoalServices};
use ros::schema::{ActionDef, Registry};
use tokio::sync::{mpsc, watch};

use super::dispatch::RobotNumber;
use super::goals::GroupClient;
use super::view::{GroupView, ViewAction, ViewEntry};
use super::{ServantGroup, node_ends};

/// Description of a request for a parameter in errors.
const PARAMETER: &str = "a parameter of its nodes";

/// Notices for a robot: name of the node on the robot, and text.
pub(super) type Notices = mpsc::UnboundedSender<(String, String)>;

/// The bus of one robot.
pub(super) struct GroupBus {
    group: Arc<ServantGroup>,
    robot: RobotNumber,
    registry: Arc<Registry>,
    /// Budget for what waits for servants.
    budget: Budget,
    notices: Notices,
    view: Mutex<Arc<GroupView>>,
    graph: watch::Sender<Arc<Graph>>,
    /// Actions in use by their topics and services, by name in the interface and node.
    actions: Mutex<HashMap<(String, String), ActionBackend>>,
}

/// An action of ROS 2 that is used by its services.
type GroupServices = Arc<GoalServices<GroupClient>>;

/// An action used by its topics and services.
#[derive(Clone)]
enum ActionBackend {
    One(Arc<GoalTopics<GroupClient>>),
    Two(GroupServices),
}

impl ActionBackend {
    /// Cancels all goals because the robot or its node is gone; they are not followed for long.
    fn abandon(&self) {
        match self {
            ActionBackend::One(topics) => topics.client().abandon(),
            ActionBackend::Two(services) => services.client().abandon(),
        }
    }
}

impl GroupBus {
    /// Returns the action and part to which a topic belongs.
    fn find_topic(&self, topic: &str) -> Result<(ActionEndpoint, ActionBackend), BusError> {
        let view = self.view();
        match view.find_topic(topic) {
            Some((action, end)) => Ok((end, self.open_action(action)?)),
            None => Err(BusError::NotShared(format!("topic {topic}"))),
        }
    }

    /// Returns the action and part to which a service belongs; `None` for a regular service.
    fn find_action_service(&self, service: &str) -> Result<Option<(ActionEndpoint, GroupServices)>, BusError> {
        let view = self.view();
        let Some((action, end)) = view.find_action_service(service) else {
            return Ok(None);
        };
        match self.open_action(action)? {
            ActionBackend::Two(parts) => Ok(Some((end, parts))),
            ActionBackend::One(_) => Ok(None),
        }
    }

    fn open_action(&self, action: &ViewAction) -> Result<ActionBackend, BusError> {
        let ViewEntry { of: name, node } = &action.shown;
        let mut actions = self.actions.lock();
        let key = (name.clone(), node.clone());
        if let Some(known) = actions.get(&key) {
            return Ok(known.clone());
        }
        let of = self.registry.action(&action.type_name);
        let of =
            of.map_err(|error| BusError::Protocol { what: format!("action {name}"), reason: error.to_string() })?;
        let (names, budget) = ((&**name, &**node), &self.budget);
        let client = GroupClient::new(&self.group, self.robot, name, &of);
        let made = match self.group.ros {
            RosVersion::One => ActionBackend::One(GoalTopics::new(names, &of, client, budget)?),
            RosVersion::Two => {
                let (notices, node) = (self.notices.clone(), node.clone());
                let notices: GoalNotices = Arc::new(move |text| drop(notices.send((node.clone(), text))));
                ActionBackend::Two(GoalServices::new(names, &of, client, budget, notices)?)
            }
        };
        actions.insert(key, made.clone());
        Ok(made)
    }

    /// Returns the ROS version of its nodes.
    pub(super) fn ros(&self) -> RosVersion {
        self.group.ros
    }

    /// Returns the value of a parameter when the interface was recorded.
    pub(super) fn recorded_value(&self, parameter: &str) -> Option<&serde_json::Value> {
        self.group.values.get(parameter)
    }

    pub(super) fn interface(&self) -> &package::interface::Interface {
        &self.group.interface
    }

    fn view(&self) -> Arc<GroupView> {
        Arc::clone(&self.view.lock())
    }

    /// Replaces the view. Goals of actions that are no longer shown are cancelled.
    pub(super) fn set_view(&self, view: GroupView) {
        let mut actions = self.actions.lock();
        let mut now = self.view.lock();
        let shown = |(name, node): &(String, String)| {
            let mut all = view.actions.values().map(|action| &action.shown);
            all.any(|shown| shown.of == *name && shown.node == *node)
        };
        actions.retain(|key, action| {
            let stays = shown(key);
            if !stays {
                action.abandon();
            }
            stays
        });
        self.graph.send_modify(|graph| {
            let next = self.group.build_graph(&view, &self.registry, graph.generation + 1);
            *graph = Arc::new(next);
        });
        *now = Arc::new(view);
    }
}

impl Drop for GroupBus {
    /// Goals outlive their senders, or their results would be lost with a connection, but not their robot's place.
    fn drop(&mut self) {
        self.actions.get_mut().values().for_each(|action| action.abandon());
    }
}

impl ServantGroup {
    /// Creates two buses for a robot, one that shows the interface as it was deployed, and one that shows nothing yet.
    /// `registry` contains the definitions of its services and actions; what waits for servants is charged to `budget`;
    /// notices for the robot are sent to `notices`.
    pub(super) fn create_buses(
        self: &Arc<Self>,
        registry: &Arc<Registry>,
        budget: &Budget,
        notices: &Notices,
    ) -> (Arc<GroupBus>, Arc<GroupBus>) {
        let robot = self.robots.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        let bus = |view: &Arc<GroupView>, generation| {
            let graph = self.build_graph(view, registry, generation);
            Arc::new(GroupBus {
                group: Arc::clone(self),
                robot,
                registry: Arc::clone(registry),
                budget: budget.clone(),
                notices: notices.clone(),
                view: Mutex::new(Arc::clone(view)),
                graph: watch::Sender::new(Arc::new(graph)),
                actions: Mutex::default(),
            })
        };
        (bus(&self.whole, 1), bus(&Arc::default(), 0))
    }

    /// Creates the first of the two buses.
    #[cfg(test)]
    pub(super) fn create_bus(self: &Arc<Self>, registry: &Arc<Registry>, budget: &Budget) -> Arc<dyn Bus> {
        let (notices, _) = tokio::sync::mpsc::unbounded_channel();
        self.create_buses(registry, budget, &notices).0
    }

    fn build_graph(&self, view: &GroupView, registry: &Registry, generation: u64) -> Graph {
        let ends = match self.ros {
            RosVersion::One => Default::default(),
            RosVersion::Two => node_ends::collect_node_ends(view, &self.interface, registry),
        };
        Graph { ends, ..view.graph(self.ros, generation) }
    }

    fn find_service(&self, name: &str) -> Option<&package::interface::Service> {
        let mut services = self.interface.services.iter();
        services.find(|service| service.name == name)
    }
}

impl GroupBus {
    /// Returns the service known to the robot by this name.
    fn find_service(&self, name: &str) -> Result<&package::interface::Service, BusError> {
        let view = self.view();
        let shown = view.services.get(name);
        let known = shown.and_then(|shown| self.group.find_service(&shown.of));
        known.ok_or_else(|| BusError::NoService(name.to_owned()))
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
        self.graph.subscribe()
    }

    async fn subscribe(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Subscription, BusError> {
        match self.find_topic(topic)? {
            (end, ActionBackend::One(topics)) if !end.is_published_by_clients() => topics.subscribe(end, &of, qos),
            (end, ActionBackend::Two(parts)) => parts.subscribe(end, &of, qos),
            // Contains goals of others.
            _ => Err(BusError::NotShared(format!("listening to {topic}"))),
        }
    }

    async fn advertise(&self, topic: &str, of: WireType, _qos: QosProfile) -> Result<Box<dyn Publisher>, BusError> {
        match self.find_topic(topic)? {
            (end, ActionBackend::One(topics)) if end.is_published_by_clients() => topics.advertise(end, &of),
            _ => Err(BusError::NotShared(format!("publishing {topic}"))),
        }
    }

    async fn call_typed(
        &self,
        service: &str,
        digest: &Digest,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        if let Some((end, parts)) = self.find_action_service(service)? {
            return parts.call((end, service), digest, request, timeout).await;
        }
        let known = self.find_service(service)?;
        let group = &self.group;
        group.call(self.robot, &known.name, digest, request, timeout).await
    }

    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError> {
        if let Some((end, parts)) = self.find_action_service(service)? {
            return Ok(parts.service_type(end).clone());
        }
        let known = self.find_service(service)?;
        if known.md5.is_empty() {
            let servant = self.group.members.borrow().values().next().cloned();
            let servant = servant.ok_or_else(|| BusError::NoService(service.to_owned()))?;
            return servant.bus.service_type(&known.name).await;
        }
        Ok(node_ends::service_type(self.group.ros, known, &self.registry))
    }

    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError> {
        Ok(match self.find_topic(topic)? {
            (end, ActionBackend::One(topics)) => match topics.wire_type(end) {
                Some(of) => WireType::clone(of),
                None => return Err(BusError::NoTopic(topic.to_owned())),
            },
            (end, ActionBackend::Two(parts)) => parts.wire_type(end).clone(),
        })
    }

    async fn serve(
        &self,
        service: &str,
        _service_type: ServiceType,
        _handler: Arc<dyn ServiceHandler>,
    ) -> Result<Box<dyn Send + Sync>, BusError> {
        Err(BusError::NotShared(format!("serving {service}")))
    }

    fn action_client(&self, action: &str, of: &Arc<ActionDef>) -> Result<Box<dyn ActionClient>, BusError> {
        let view = self.view();
        let Some(known) = view.actions.get(action) else {
            return Err(BusError::NotShared(format!("action {action}")));
        };
        let client = GroupClient::new(&self.group, self.robot, &known.shown.of, of);
        Ok(Box::new(client))
    }

    fn serve_action(
        &self,
        action: &str,
        _of: &Arc<ActionDef>,
        _handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError> {
        Err(BusError::NotShared(format!("serving {action}")))
    }

    /// Global parameters belong to the deployer.
    fn parameters(&self) -> Result<&dyn GlobalParameters, BusError> {
        Err(BusError::NotShared(PARAMETER.to_owned()))
    }

    fn node_parameters(&self) -> Result<&dyn NodeParameters, BusError> {
        Err(BusError::NotShared(PARAMETER.to_owned()))
    }
}
