//! A group as one robot's bus: services and actions of the interface, nothing else, under the names of a [`View`].

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    ActionClient, ActionHandler, ActionServer, Bus, BusError, Digest, GlobalParameters, Graph,
    NodeParameters, Publisher, Qos, RosVersion, ServiceHandler, ServiceType, Subscription,
    WireType,
};
use ros::schema::{ActionDef, Registry};
use tokio::sync::watch;

use super::action_ends::End;
use super::action_parts::{ActionParts, Notices};
use super::action_topics::ActionTopics;
use super::dispatch::Robot;
use super::goals::GroupClient;
use super::view::{Shown, ShownAction, View};
use super::{Group, node_ends};

/// What is not offered where somebody asks for a parameter.
const PARAMETER: &str = "a parameter of its nodes";

/// One robot's.
pub(super) struct GroupBus {
    group: Arc<Group>,
    robot: Robot,
    registry: Arc<Registry>,
    /// Counts what waits here for servants.
    budget: Budget,
    notices: Notices,
    view: Mutex<Arc<View>>,
    graph: watch::Sender<Arc<Graph>>,
    /// By name in the interface and node, as far as they are used by their parts.
    actions: Mutex<HashMap<(String, String), Action>>,
}

/// An action that is used by its parts.
#[derive(Clone)]
enum Action {
    One(Arc<ActionTopics>),
    Two(Arc<ActionParts>),
}

impl Action {
    fn cancel_all(&self) {
        match self {
            Action::One(topics) => topics.cancel_all(),
            Action::Two(parts) => parts.cancel_all(),
        }
    }
}

impl GroupBus {
    /// The end of an action that a topic is.
    fn topic(&self, topic: &str) -> Result<(End, Action), BusError> {
        let view = self.view();
        match view.topic(topic) {
            Some((action, end)) => Ok((end, self.action(action)?)),
            None => Err(BusError::NotShared(format!("topic {topic}"))),
        }
    }

    /// The end of an action that a service is; none where it is a service of its own.
    fn action_service(&self, service: &str) -> Result<Option<(End, Arc<ActionParts>)>, BusError> {
        let view = self.view();
        let Some((action, end)) = view.action_service(service) else {
            return Ok(None);
        };
        match self.action(action)? {
            Action::Two(parts) => Ok(Some((end, parts))),
            Action::One(_) => Ok(None),
        }
    }

    fn action(&self, action: &ShownAction) -> Result<Action, BusError> {
        let Shown { of: name, node } = &action.shown;
        let mut actions = self.actions.lock();
        let key = (name.clone(), node.clone());
        if let Some(known) = actions.get(&key) {
            return Ok(known.clone());
        }
        let of = self.registry.action(&action.type_name);
        let of = of.map_err(|error| BusError::Protocol {
            what: format!("action {name}"),
            reason: error.to_string(),
        })?;
        let (group, names) = (&self.group, (&**name, &**node));
        let made = match group.ros {
            RosVersion::One => Action::One(ActionTopics::new(
                group,
                self.robot,
                names,
                &of,
                &self.registry,
                &self.budget,
            )?),
            RosVersion::Two => Action::Two(ActionParts::new(
                group,
                self.robot,
                names,
                &of,
                &self.budget,
                &self.notices,
            )?),
        };
        actions.insert(key, made.clone());
        Ok(made)
    }

    /// Which ROS its nodes are of.
    pub(super) fn ros(&self) -> RosVersion {
        self.group.ros
    }

    /// What a node of the group had this parameter set to when the interface was found.
    pub(super) fn value(&self, parameter: &str) -> Option<&serde_json::Value> {
        self.group.values.get(parameter)
    }

    pub(super) fn interface(&self) -> &package::interface::Interface {
        &self.group.interface
    }

    fn view(&self) -> Arc<View> {
        Arc::clone(&self.view.lock())
    }

    /// From now on it shows this. Goals of actions that are not shown any more are cancelled.
    pub(super) fn show(&self, view: View) {
        let mut actions = self.actions.lock();
        let mut now = self.view.lock();
        let shown = |(name, node): &(String, String)| {
            let mut all = view.actions.values().map(|action| &action.shown);
            all.any(|shown| shown.of == *name && shown.node == *node)
        };
        actions.retain(|key, action| {
            let stays = shown(key);
            if !stays {
                action.cancel_all();
            }
            stays
        });
        self.graph.send_modify(|graph| {
            let next = self
                .group
                .graph(&view, &self.registry, graph.generation + 1);
            *graph = Arc::new(next);
        });
        *now = Arc::new(view);
    }
}

impl Drop for GroupBus {
    /// Goals outlive who sent them, or their results would be lost with a connection; not their robot's place.
    fn drop(&mut self) {
        self.actions
            .get_mut()
            .values()
            .for_each(|action| action.cancel_all());
    }
}

impl Group {
    /// Two buses for one robot, one that shows the interface as it was deployed, and one that shows nothing yet; `registry`
    /// holds the definitions of its services and actions, what waits for servants counts in `budget`, and what the robot should know of
    /// is told to `notices`.
    pub(super) fn buses(
        self: &Arc<Self>,
        registry: &Arc<Registry>,
        budget: &Budget,
        notices: &Notices,
    ) -> (Arc<GroupBus>, Arc<GroupBus>) {
        let robot = self
            .robots
            .fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        let bus = |view: &Arc<View>, generation| {
            let graph = self.graph(view, registry, generation);
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

    /// The first of them.
    #[cfg(test)]
    pub(super) fn bus(self: &Arc<Self>, registry: &Arc<Registry>, budget: &Budget) -> Arc<dyn Bus> {
        let (notices, _) = tokio::sync::mpsc::unbounded_channel();
        self.buses(registry, budget, &notices).0
    }

    fn graph(&self, view: &View, registry: &Registry, generation: u64) -> Graph {
        let ends = match self.ros {
            RosVersion::One => Default::default(),
            RosVersion::Two => node_ends::all(view, &self.interface, registry),
        };
        Graph {
            ends,
            ..view.graph(self.ros, generation)
        }
    }

    fn service(&self, name: &str) -> Option<&package::interface::Service> {
        let mut services = self.interface.services.iter();
        services.find(|service| service.name == name)
    }
}

impl GroupBus {
    /// The service that the robot knows by this name.
    fn service(&self, name: &str) -> Result<&package::interface::Service, BusError> {
        let view = self.view();
        let shown = view.services.get(name);
        let known = shown.and_then(|shown| self.group.service(&shown.of));
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

    async fn subscribe(
        &self,
        topic: &str,
        of: WireType,
        qos: Qos,
    ) -> Result<Subscription, BusError> {
        match self.topic(topic)? {
            (end, Action::One(topics)) if !end.is_of_clients() => topics.subscribe(end, &of, qos),
            (end, Action::Two(parts)) => parts.subscribe(end, &of, qos),
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
        match self.topic(topic)? {
            (end, Action::One(topics)) if end.is_of_clients() => topics.advertise(end, &of),
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
        if let Some((end, parts)) = self.action_service(service)? {
            return parts.call((end, service), digest, request, timeout).await;
        }
        let known = self.service(service)?;
        let group = &self.group;
        group
            .call(self.robot, &known.name, digest, request, timeout)
            .await
    }

    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError> {
        if let Some((end, parts)) = self.action_service(service)? {
            return Ok(parts.service_type(end).clone());
        }
        let known = self.service(service)?;
        if known.md5.is_empty() {
            let servant = self.group.members.borrow().values().next().cloned();
            let servant = servant.ok_or_else(|| BusError::NoService(service.to_owned()))?;
            return servant.bus.service_type(&known.name).await;
        }
        Ok(node_ends::service_type(
            self.group.ros,
            known,
            &self.registry,
        ))
    }

    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError> {
        Ok(match self.topic(topic)? {
            (end, Action::One(topics)) => topics.wire_type(end),
            (end, Action::Two(parts)) => parts.wire_type(end).clone(),
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

    fn action_client(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
    ) -> Result<Box<dyn ActionClient>, BusError> {
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

    /// Those of the nodes are the deployer's.
    fn parameters(&self) -> Result<&dyn GlobalParameters, BusError> {
        Err(BusError::NotShared(PARAMETER.to_owned()))
    }

    fn node_parameters(&self) -> Result<&dyn NodeParameters, BusError> {
        Err(BusError::NotShared(PARAMETER.to_owned()))
    }
}
