//! dynamic_reconfigure at the nodes of a servant of ROS 2: what `rqt_reconfigure` and other clients of ROS 1 use.
//!
//! ```text
//!  /see/parameter_descriptions   latched: names, ranges and texts, by the node's descriptors
//!  /see/parameter_updates        latched: the values, anew when the node reports changes
//!  /see/set_parameters           sets at the node what differs, and answers with the values that it then has
//! ```
//! A parameter is called what it is called below the node's name at a Master: `gains/p`. Lists, bytes and integers of
//! more than 32 bits are no parameters of dynamic_reconfigure, and those that every node has are not shown.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use futures_util::FutureExt;
use ros::bus::parameter_names::spell_in_ros2;
use ros::bus::{Bus, BusError, Graph, Offer, ParamValue, Retry, ServiceType, Subscription, TopicNodes, WireType};
use ros::plumbing::is_builtin_parameter;
use ros::schema::MessageType;

use super::names::{node_names, shown_key, to_key};
use super::reconfigure::{
    self, CONFIG_TYPE, Config, ConfigDescription, DESCRIPTION_TYPE, DESCRIPTIONS, DescribedParameter, SERVICE, UPDATES,
};
use super::refusals::RefusedParameters;
use super::server::ParameterServerView;
use super::topics::{ParameterTopic, TopicFeed};
use super::values::NodeValues;

/// Maximum number of parameters of a node that are shown.
const MAX_PARAMETERS: usize = 2000;

/// A topic of a server of dynamic_reconfigure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::bus) enum ReconfigurePart {
    /// Names, types and ranges.
    Descriptions,
    /// Values.
    Updates,
}

impl ReconfigurePart {
    const ALL: [Self; 2] = [Self::Descriptions, Self::Updates];

    fn suffix(self) -> &'static str {
        match self {
            Self::Descriptions => DESCRIPTIONS,
            Self::Updates => UPDATES,
        }
    }

    fn type_name(self) -> &'static str {
        match self {
            Self::Descriptions => DESCRIPTION_TYPE,
            Self::Updates => CONFIG_TYPE,
        }
    }

    /// Returns the type of the messages.
    pub(super) fn message_type(self) -> Result<Arc<MessageType>, BusError> {
        reconfigure::message(self.type_name())
    }
}

/// Returns the definition of a message of these topics; `None` for other types.
pub(super) fn find_message(of: &WireType) -> Option<Arc<MessageType>> {
    let part = ReconfigurePart::ALL.into_iter().find(|part| part.type_name() == of.name)?;
    part.message_type().ok()
}

/// Adds topics and services of each node of the servant to the graph of a robot. `own` is the bus itself.
pub(in crate::bus) fn add_to_graph(inner: &Graph, own: &str, out: &mut Graph) {
    for node in node_names(inner).filter(|node| *node != own) {
        let owner = inner.process_owner(node).to_owned();
        out.services.insert(format!("{node}{SERVICE}"), owner.clone());
        for part in ReconfigurePart::ALL {
            let type_name = part.type_name().to_owned();
            let nodes = TopicNodes { type_name, publishers: vec![owner.clone()], subscribers: Vec::new() };
            out.topics.insert(format!("{node}{}", part.suffix()), nodes);
        }
    }
}

/// Returns the node of the servant whose name is followed by `suffix`.
fn split_node<'n>(bus: &dyn Bus, name: &'n str, suffix: &str) -> Option<&'n str> {
    let node = name.strip_suffix(suffix).filter(|node| *node != bus.node())?;
    let graph = bus.graph().borrow().clone();
    node_names(&graph).any(|known| known == node).then_some(node)
}

/// Returns what a topic of this name tells about a node of the servant.
pub(super) fn find_topic(bus: &dyn Bus, topic: &str) -> Option<ParameterTopic> {
    ReconfigurePart::ALL.into_iter().find_map(|part| {
        let node = split_node(bus, topic, part.suffix())?;
        let owner = bus.graph().borrow().process_owner(node).to_owned();
        Some(ParameterTopic::Reconfigure { node: node.to_owned(), owner, part })
    })
}

/// Returns the type of a service that changes parameters of a node of the servant; `None` for other services.
pub(super) fn find_service_type(bus: &dyn Bus, service: &str) -> Option<Result<ServiceType, BusError>> {
    split_node(bus, service, SERVICE)?;
    Some(reconfigure::service().map(|of| ServiceType::from_service(&of)))
}

/// A node of ROS 2 whose parameters robots of ROS 1 change by dynamic_reconfigure.
pub(super) struct ReconfigurableNode {
    bus: Arc<dyn Bus>,
    node: String,
}

/// Parameters of such a node.
#[derive(Debug, Default, PartialEq)]
struct NodeConfig {
    description: ConfigDescription,
    values: Config,
}

impl ReconfigurableNode {
    pub(super) fn new(bus: &Arc<dyn Bus>, node: &str) -> Self {
        Self { bus: Arc::clone(bus), node: node.to_owned() }
    }

    /// Answers a call of a service of this name: sets what differs, and returns the serialized response. What is
    /// refused goes to `report`: whoever calls sees from the answer only that it is not so.
    pub(super) async fn call(
        server: &ParameterServerView,
        service: &str,
        request: &[u8],
        report: &(dyn Fn(&str) + Send + Sync),
    ) -> Result<Bytes, BusError> {
        let bus = server.bus();
        let node = split_node(&**bus, service, SERVICE).ok_or_else(|| BusError::NoService(service.to_owned()))?;
        let asked = Config::parse(request).ok_or_else(|| BusError::Protocol {
            what: format!("a request to {service}"),
            reason: "it is truncated or too long".to_owned(),
        })?;
        let node = Self::new(bus, node);
        if let Err(refused) = node.change(server, asked).await?.into_result(&node.node) {
            report(&format!("{service}: {refused}"));
        }
        Ok(node.read().await?.values.serialize_state())
    }

    /// Sets the values that differ from the node's; returns what was refused.
    async fn change(&self, server: &ParameterServerView, asked: Config) -> Result<RefusedParameters, BusError> {
        let now = self.read().await?;
        let mut changes = NodeValues::default();
        let mut refused = RefusedParameters::default();
        for (name, value) in asked.values {
            let chosen = match now.description.parameters.get(&name) {
                Some(parameter) => parameter.choose(&value).map_err(|refusal| refusal.to_string()),
                None => Err("the node has no such parameter".to_owned()),
            };
            match chosen {
                Ok(value) if now.values.values.get(&name) == Some(&value) => {}
                Ok(value) => changes.values.push((spell_in_ros2(&name), value)),
                Err(reason) => refused.add(&shown_key(&self.node, &name), &reason),
            }
        }
        server.set_at_node(&self.node, changes, &mut refused).await;
        Ok(refused)
    }

    /// Reads the parameters that dynamic_reconfigure can have.
    async fn read(&self) -> Result<NodeConfig, BusError> {
        let parameters = self.bus.node_parameters()?;
        let mut names = parameters.list(&self.node, &[], 0).await?.names;
        names.retain(|name| !is_builtin_parameter(name));
        names.truncate(MAX_PARAMETERS);
        let described = parameters.describe(&self.node, &names).await?;
        let values = parameters.get(&self.node, &names).await?;
        let mut config = NodeConfig::default();
        for ((name, described), value) in names.iter().zip(described).zip(values) {
            let (Some(described), Some(value), Some(key)) = (described, value, to_key("", name)) else { continue };
            if let Some(parameter) = DescribedParameter::from_ros2(&described, &value) {
                let name = key[1..].to_owned();
                config.description.parameters.insert(name.clone(), parameter);
                config.values.values.insert(name, value);
            }
        }
        Ok(config)
    }

    /// Subscribes to one of the topics of the node, which the robot knows by the name `owner`.
    pub(super) fn subscribe(
        self,
        (part, owner): (ReconfigurePart, String),
        offer: Offer,
        of: &WireType,
        depth: usize,
    ) -> Result<Subscription, BusError> {
        let topic = format!("{}{}", self.node, part.suffix());
        TopicFeed::open((&topic, offer), of, depth, |feed| {
            let (defaults, retry) = (BTreeMap::new(), Retry::default());
            ConfigTelling { node: self, part, owner, feed, defaults, last: None, retry }.run()
        })
    }
}

/// One subscription to what the server of a node tells.
struct ConfigTelling {
    node: ReconfigurableNode,
    part: ReconfigurePart,
    /// Name of the node as the robot sees it.
    owner: String,
    feed: TopicFeed,
    /// The first values that were seen: a description must not change with each value.
    defaults: BTreeMap<String, ParamValue>,
    last: Option<Bytes>,
    retry: Retry,
}

impl ConfigTelling {
    async fn run(mut self) {
        self.feed.set_publishers(std::iter::once(&*self.owner));
        loop {
            if let Err(error) = self.tell_changes().await {
                let node = &self.node.node;
                tracing::debug!(node, %error, "its parameters do not reach the robot; trying again");
            }
            self.retry.pause().await;
        }
    }

    /// Sends what is so, and what changes, until the events of the node end.
    async fn tell_changes(&mut self) -> Result<(), BusError> {
        let bus = Arc::clone(&self.node.bus);
        let mut events = bus.node_parameters()?.watch(Some(&self.node.node)).await?;
        loop {
            let config = self.node.read().await?;
            self.tell(config);
            self.retry = Retry::default();
            if events.next().await.is_none() {
                return Ok(());
            }
            // What has changed meanwhile is read at once.
            while let Some(Some(_)) = events.next().now_or_never() {}
        }
    }

    fn tell(&mut self, config: NodeConfig) {
        let message = match self.part {
            ReconfigurePart::Updates => config.values.serialize_state(),
            ReconfigurePart::Descriptions => {
                let NodeConfig { description, values } = config;
                self.defaults.retain(|name, _| description.parameters.contains_key(name));
                for (name, value) in values.values {
                    self.defaults.entry(name).or_insert(value);
                }
                description.serialize(&Config { values: self.defaults.clone() })
            }
        };
        if self.last.as_ref() != Some(&message) {
            self.feed.send(&self.owner, message.clone());
            self.last = Some(message);
        }
    }
}
