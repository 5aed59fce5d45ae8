//! A group as one robot's bus: services and actions of the interface, nothing else, under the names of a [`View`].

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    ActionClient, ActionHandler, ActionServer, Bus, BusError, Digest, Graph, Publisher, Qos,
    RosVersion, ServiceHandler, ServiceType, Subscription, WireType,
};
use ros::schema::{ActionDef, Registry};
use tokio::sync::watch;

use super::Group;
use super::action_topics::{ActionTopics, End};
use super::dispatch::Robot;
use super::goals::GroupClient;
use super::view::{Shown, View};

/// One robot's.
pub(super) struct GroupBus {
    group: Arc<Group>,
    robot: Robot,
    registry: Arc<Registry>,
    /// Counts what waits here for servants.
    budget: Budget,
    view: Mutex<Arc<View>>,
    graph: watch::Sender<Arc<Graph>>,
    /// By name in the interface and node, as far as they are used by their topics.
    actions: Mutex<HashMap<(String, String), Arc<ActionTopics>>>,
}

impl GroupBus {
    /// The end of an action that a topic is.
    fn end(&self, topic: &str) -> Result<(End, Arc<ActionTopics>), BusError> {
        let view = self.view();
        let Some((action, end)) = view.action_of(topic) else {
            return Err(BusError::NotShared(format!("topic {topic}")));
        };
        let Shown { of: name, node } = &action.shown;
        let mut actions = self.actions.lock();
        let key = (name.clone(), node.clone());
        if let Some(known) = actions.get(&key) {
            return Ok((end, Arc::clone(known)));
        }
        let of = self.registry.action(&action.type_name);
        let of = of.map_err(|error| BusError::Protocol {
            what: format!("action {name}"),
            reason: error.to_string(),
        })?;
        let names = (&**name, &**node);
        let topics = ActionTopics::new(
            &self.group,
            self.robot,
            names,
            &of,
            &self.registry,
            &self.budget,
        )?;
        actions.insert(key, Arc::clone(&topics));
        Ok((end, topics))
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
        actions.retain(|key, topics| {
            let stays = shown(key);
            if !stays {
                topics.cancel_all();
            }
            stays
        });
        self.graph
            .send_modify(|graph| *graph = Arc::new(view.graph(graph.generation + 1)));
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
    /// holds the definitions of its actions, what waits for servants counts in `budget`.
    pub(super) fn buses(
        self: &Arc<Self>,
        registry: &Arc<Registry>,
        budget: &Budget,
    ) -> (Arc<GroupBus>, Arc<GroupBus>) {
        let robot = self
            .robots
            .fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        let bus = |view: &Arc<View>, graph: &Arc<Graph>| {
            Arc::new(GroupBus {
                group: Arc::clone(self),
                robot,
                registry: Arc::clone(registry),
                budget: budget.clone(),
                view: Mutex::new(Arc::clone(view)),
                graph: watch::Sender::new(Arc::clone(graph)),
                actions: Mutex::default(),
            })
        };
        (
            bus(&self.whole, &self.graph),
            bus(&Arc::default(), &Arc::default()),
        )
    }

    /// The first of them.
    #[cfg(test)]
    pub(super) fn bus(self: &Arc<Self>, registry: &Arc<Registry>, budget: &Budget) -> Arc<dyn Bus> {
        self.buses(registry, budget).0
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

    async fn call_typed(
        &self,
        service: &str,
        digest: &Digest,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        let known = self.service(service)?;
        let group = &self.group;
        group
            .call(self.robot, &known.name, digest, request, timeout)
            .await
    }

    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError> {
        let known = self.service(service)?;
        if known.md5.is_empty() {
            let servant = self.group.members.borrow().values().next().cloned();
            let servant = servant.ok_or_else(|| BusError::NoService(service.to_owned()))?;
            return servant.bus.service_type(&known.name).await;
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
}
