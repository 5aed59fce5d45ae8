//! Parameters between a robot of one ROS and a servant of the other. In ROS 1 all nodes share the parameters of the
//! Master; in ROS 2 each node has its own. So the node `/camera/see` with the parameter `gains.p` of ROS 2 is the key
//! `/camera/see/gains/p` of ROS 1.
//!
//! ```text
//!  robot ROS 1 ── GlobalParameters ▶ ParameterServerView ── NodeParameters ▶ servant ROS 2
//!              ── dynamic_reconfigure ▶ ReconfigurableNode ──┘
//!  robot ROS 2 ── NodeParameters ▶ NodeParameterView ── GlobalParameters, dynamic_reconfigure ▶ servant ROS 1
//!              ◀── /parameter_events ──┘
//! ```
//! What a value of one ROS is in the other stands in the module `values`. What cannot be carried is refused in words,
//! or, where nobody waits for an answer, left out with a line in the log.

pub(super) mod event_topic;
mod kept;
mod launch;
mod names;
mod nodes;
pub(super) mod reconfigurable;
mod reconfigure;
mod refusals;
mod server;
mod services;
mod topics;
mod values;

use std::collections::BTreeMap;
use std::sync::Arc;

use budget::Budget;
use bytes::Bytes;
use ros::bus::{
    Bus, BusError, GlobalParameters, NodeParameters, ParameterKind, QosProfile, RosVersion, ServiceType, Subscription,
    WireType,
};
use ros::schema::MessageType;

pub use launch::{LeftOutParameters, TranslatedLaunch};
pub use nodes::NodeParameterView;
use reconfigurable::ReconfigurableNode;
pub use server::ParameterServerView;
pub use services::ParameterServices;
use topics::ParameterTopic;
pub use values::ParameterRefusal;

/// The parameters of a servant in the terms of a robot of the other ROS.
pub enum TranslatedParameters {
    /// Parameters of a ROS 2 servant, for a robot of ROS 1.
    Server(ParameterServerView),
    /// Parameters of a ROS 1 servant, for a robot of ROS 2.
    Nodes(Arc<NodeParameterView>),
}

impl TranslatedParameters {
    /// Creates the parameters of the servant with this bus. What is kept for the robot is charged to `budget`.
    pub fn new(inner: &Arc<dyn Bus>, budget: Budget) -> Self {
        match inner.version() {
            RosVersion::One => Self::Nodes(Arc::new(NodeParameterView::new(Arc::clone(inner)))),
            RosVersion::Two => Self::Server(ParameterServerView::new(Arc::clone(inner), budget)),
        }
    }

    /// Returns the parameters that all nodes share, for a robot of ROS 1.
    pub fn global(&self) -> Result<&dyn GlobalParameters, BusError> {
        match self {
            Self::Server(server) => Ok(server),
            Self::Nodes(_) => Err(BusError::NotOffered("global parameters")),
        }
    }

    /// Returns access to the parameters of individual nodes, for a robot of ROS 2.
    pub fn of_nodes(&self) -> Result<&dyn NodeParameters, BusError> {
        match self {
            Self::Server(_) => Err(BusError::NotOffered("parameters of nodes")),
            Self::Nodes(nodes) => Ok(&**nodes),
        }
    }

    /// Returns the topic of this name that tells the robot about parameters; `None` for other topics.
    pub(super) fn find_topic(&self, topic: &str) -> Option<ParameterTopic> {
        match self {
            Self::Server(server) => reconfigurable::find_topic(&**server.bus(), topic),
            Self::Nodes(_) => (topic == event_topic::TOPIC).then_some(ParameterTopic::Events),
        }
    }

    /// Returns the definition of a message of such topics; `None` for other types.
    pub(super) fn find_message(&self, of: &WireType) -> Option<Arc<MessageType>> {
        let found = match self {
            Self::Server(_) => reconfigurable::find_message(of),
            Self::Nodes(_) => event_topic::message_type().ok().filter(|event| event.name() == of.name),
        };
        found.filter(|found| of.digest.is_compatible_with(&found.digest().into()))
    }

    /// Subscribes to such a topic.
    pub(super) fn subscribe(
        &self,
        topic: ParameterTopic,
        of: &WireType,
        qos: QosProfile,
    ) -> Result<Subscription, BusError> {
        let offer = topic.offer()?;
        match (self, topic) {
            (Self::Server(server), ParameterTopic::Reconfigure { node, owner, part }) => {
                ReconfigurableNode::new(server.bus(), &node).subscribe((part, owner), offer, of, qos.depth)
            }
            (Self::Nodes(nodes), ParameterTopic::Events) => event_topic::subscribe(nodes, offer, of, qos),
            _ => Err(BusError::NotOffered("these topics about parameters")),
        }
    }

    /// Returns the type of the service of this name by which the robot reads or changes parameters of a node; `None`
    /// for other services.
    pub(super) fn find_service_type(&self, service: &str) -> Option<Result<ServiceType, BusError>> {
        match self {
            Self::Server(server) => reconfigurable::find_service_type(&**server.bus(), service),
            Self::Nodes(nodes) => ParameterServices::find_type(&nodes.bus().graph().borrow(), service),
        }
    }

    /// Answers a call of such a service: returns the serialized response. `report` is given what the response has no
    /// place for. The caller limits the time by dropping the future.
    pub(super) async fn call(
        &self,
        service: &str,
        request: &[u8],
        report: &(dyn Fn(&str) + Send + Sync),
    ) -> Result<Bytes, BusError> {
        match self {
            Self::Server(server) => ReconfigurableNode::call(server, service, request, report).await,
            Self::Nodes(nodes) => ParameterServices::call(&**nodes, service, request).await,
        }
    }

    /// Returns what the robot's node of this absolute name is started with. `argv` is in the spelling of the servant's
    /// ROS. At a servant of ROS 2 the arguments then include the parameters that stand below the node's name at the
    /// robot's Master; at a servant of ROS 1 they are to be set before the node starts. `kinds`: types of the node's
    /// parameters, as far as they are known.
    pub fn prepare_launch(
        &self,
        node: &str,
        argv: &[String],
        kinds: &BTreeMap<String, ParameterKind>,
    ) -> TranslatedLaunch {
        match self {
            Self::Server(server) => {
                let (private, simulated) = server.launch_parameters(node);
                launch::for_ros2(argv, &private, simulated, kinds)
            }
            Self::Nodes(_) => launch::for_ros1(node, argv),
        }
    }
}
