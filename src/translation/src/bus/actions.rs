//! Actions across ROSes: those of the servant for robots of the other ROS, and those of such robots for the servant
//! ([`lent`]).
//!
//! An action consists of five topics in ROS 1, and of three services and two topics in ROS 2. So its parts are not
//! carried one by one: to the robot a server of its own ROS seems to be there, behind which a client of the servant's
//! ROS stands, and only goals, feedback and results are translated.
//!
//! ```text
//!  robot's nodes                       TranslatedBus                            servant's node
//!  topics of ROS 1   ──▶ GoalTopics ──▶ TranslatedActionClient ──▶ client of ROS 2 ──▶ services of ROS 2
//!  services of ROS 2 ──▶ GoalServices ▶ TranslatedActionClient ──▶ client of ROS 1 ──▶ topics of ROS 1
//! ```
//!
//! What clients of ROS 1 see of a server of ROS 2:
//!
//! | in ROS 2 | in ROS 1 |
//! |---|---|
//! | the goal is not answered yet | PENDING; RECALLING once it is cancelled, which the server is told when it accepts |
//! | accepted | ACTIVE; PREEMPTING if it was cancelled before |
//! | not accepted | REJECTED |
//! | the cancel is accepted, or refused | PREEMPTING: in ROS 1 nobody refuses, the goal just goes on to its end |
//! | SUCCEEDED | SUCCEEDED |
//! | CANCELED | PREEMPTED; RECALLED if it was never accepted |
//! | ABORTED, UNKNOWN, the server is gone | ABORTED |
//! | the id, a UUID | the client's own text; a text that is no UUID has a random one in ROS 2 |
//!
//! What clients of ROS 2 see of a server of ROS 1:
//!
//! | in ROS 1 | in ROS 2 |
//! |---|---|
//! | PENDING, RECALLING | accepted; ACCEPTED |
//! | ACTIVE, PREEMPTING, or feedback | accepted; EXECUTING |
//! | REJECTED, before it was listed | not accepted |
//! | PREEMPTING, RECALLING after a cancel | the cancel is accepted; CANCELING |
//! | SUCCEEDED | SUCCEEDED |
//! | PREEMPTED, RECALLED | CANCELED |
//! | ABORTED, LOST, the server is gone; REJECTED later | ABORTED |
//! | the text of a result | a notice to the robot: ROS 2 has no field for it |
//! | the id | the UUID as text |
//!
//! Whether a newer goal preempts an older one is the server's own policy in both: a `SimpleActionServer` does it, and
//! the older goal is CANCELED in ROS 2; a server of ROS 2 that cancels or aborts the older goal has it PREEMPTED or
//! ABORTED in ROS 1. A cancel of all goals concerns those that were sent through this bus.

mod client;
mod graph;
mod lent;
mod server;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    ActionClient, ActionEndpoint, ActionHandler, ActionServer, BusError, CallFate, Digest, Offer, Publisher,
    QosProfile, RosVersion, ServiceType, Subscription, WireType, split_action_endpoint,
};
use ros::ros1::actions::goal_topics::GoalTopics;
use ros::ros2::actions::goal_server;
use ros::ros2::actions::goal_services::{GoalNotices, GoalServices};
use ros::schema::ActionDef;
use tokio_util::task::AbortOnDropHandle;
use tracing::Instrument;

use self::client::TranslatedActionClient;
pub(super) use self::graph::add_actions;
use self::lent::LentActions;
use self::server::TranslatedActionServer;
use super::state::{Translation, not_translated};
use crate::ActionTwin;

/// Maximum number of actions of a servant that a robot uses at a time.
const MAX_ACTIONS: usize = 256;

/// Name of the budget for goals that are under way and results that are kept, in errors.
const GOALS: &str = "the goals and results of actions";

/// The actions of a servant that its robot uses by their topics and services, and those of the robot.
pub(super) struct ActionEnds {
    translation: Arc<Translation>,
    /// Budget for the goals that are under way and the results that are kept.
    budget: Budget,
    fronts: Mutex<HashMap<String, KnownFront>>,
    lent: Arc<LentActions>,
    /// Keeps the actions of the robot up to date.
    _following: AbortOnDropHandle<()>,
}

/// An action in use.
struct KnownFront {
    /// Name of its type in the servant.
    type_name: String,
    front: ActionFront,
}

/// Stand-in for a server, as the robot sees it.
#[derive(Clone)]
pub(super) enum ActionFront {
    One(Arc<GoalTopics<TranslatedActionClient>>),
    Two(Arc<GoalServices<TranslatedActionClient>>),
}

impl ActionEnds {
    pub(super) fn new(translation: &Arc<Translation>, budget: &Budget) -> Self {
        // Results that are kept must not take the room of what is on its way.
        let budget = budget.child(GOALS, budget.max_permit() / 2);
        let lent = LentActions::new(translation, &budget);
        let following = tokio::spawn(budget.meter(Arc::clone(&lent).follow_graph()).in_current_span());
        Self {
            translation: Arc::clone(translation),
            budget,
            fronts: Mutex::default(),
            lent,
            _following: AbortOnDropHandle::new(following),
        }
    }

    /// Returns the actions of the robot.
    pub(super) fn lent_actions(&self) -> &LentActions {
        &self.lent
    }

    /// Returns the action that a topic of the robot's ROS is part of, and the part; `None` if no node of the servant
    /// serves such an action.
    pub(super) fn find_topic(&self, topic: &str) -> Result<Option<(ActionEndpoint, ActionFront)>, BusError> {
        let part = split_action_endpoint(self.translation.version, topic);
        self.find(part.filter(|(_, end)| !end.is_service()))
    }

    /// Returns the action that a service of the robot's ROS is part of, likewise.
    pub(super) fn find_service(&self, service: &str) -> Result<Option<(ActionEndpoint, ActionFront)>, BusError> {
        let part = split_action_endpoint(self.translation.version, service);
        self.find(part.filter(|(_, end)| end.is_service()))
    }

    fn find(&self, part: Option<(&str, ActionEndpoint)>) -> Result<Option<(ActionEndpoint, ActionFront)>, BusError> {
        let Some((action, end)) = part else {
            return Ok(None);
        };
        let graph = self.translation.inner.graph().borrow().clone();
        let own = self.translation.inner.node();
        let served = graph.actions.get(action).filter(|nodes| nodes.servers.iter().any(|node| node != own));
        let mut fronts = self.fronts.lock();
        if let Some(known) = fronts.get(action) {
            // A server that has gone may come back, and its clients keep their topics until then.
            if served.is_none_or(|nodes| nodes.type_name == known.type_name) {
                return Ok(Some((end, known.front.clone())));
            }
        }
        let Some((nodes, server)) =
            served.and_then(|nodes| Some((nodes, nodes.servers.iter().find(|node| *node != own)?)))
        else {
            return Ok(None);
        };
        let front = self.open(action, &nodes.type_name, graph.process_owner(server))?;
        let known = KnownFront { type_name: nodes.type_name.clone(), front: front.clone() };
        if let Some(other) = fronts.insert(action.to_owned(), known) {
            other.front.cancel_all();
        }
        if fronts.len() > MAX_ACTIONS {
            fronts.retain(|name, known| name == action || known.front.has_goals() || graph.serves_action(name));
        }
        Ok(Some((end, front)))
    }

    fn open(&self, action: &str, type_name: &str, server: &str) -> Result<ActionFront, BusError> {
        let translation = &self.translation;
        let twin = translation.twins.action(type_name);
        let twin = twin.map_err(|reason| not_translated(format!("action {action}"), reason))?;
        let names = (action, server);
        let client = TranslatedActionClient::open(translation, action, &twin, &self.budget)?;
        Ok(match translation.version {
            RosVersion::One => ActionFront::One(GoalTopics::new(names, &twin.twin, client, &self.budget)?),
            RosVersion::Two => {
                let (telling, name) = (Arc::clone(translation), action.to_owned());
                let notices: GoalNotices = Arc::new(move |text| telling.losses.report(&name, &text));
                ActionFront::Two(GoalServices::new(names, &twin.twin, client, &self.budget, notices)?)
            }
        })
    }

    /// Creates a client with the robot's type of an action that a node of the servant serves.
    pub(super) fn client(&self, action: &str, of: &Arc<ActionDef>) -> Result<Box<dyn ActionClient>, BusError> {
        let twin = self.find_type(action, of)?;
        Ok(Box::new(TranslatedActionClient::open(&self.translation, action, &twin, &self.budget)?))
    }

    /// Serves an action to the servant's nodes; the handler has the robot's type.
    pub(super) fn serve(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError> {
        let twin = self.find_type(action, of)?;
        TranslatedActionServer::open(&self.translation, action, &twin, handler)
    }

    fn find_type(&self, action: &str, of: &Arc<ActionDef>) -> Result<Arc<ActionTwin>, BusError> {
        let twin = self.translation.twins.action_for_robot(of);
        twin.map_err(|reason| not_translated(format!("action {action}"), reason))
    }

    /// Cancels all goals, because the robot has gone.
    pub(super) fn cancel_all(&self) {
        self.fronts.lock().values().for_each(|known| known.front.cancel_all());
        self.lent.clear();
    }
}

impl Drop for ActionEnds {
    fn drop(&mut self) {
        self.cancel_all();
    }
}

impl ActionFront {
    /// Subscribes to a topic with updates about goals.
    pub(super) fn subscribe(
        &self,
        (end, topic): (ActionEndpoint, &str),
        of: &WireType,
        qos: QosProfile,
    ) -> Result<Subscription, BusError> {
        match self {
            Self::One(topics) if !end.is_published_by_clients() => topics.subscribe(end, of, qos),
            Self::Two(services) if !end.is_service() => services.subscribe(end, of, qos),
            _ => Err(not_translated(format!("topic {topic}"), "the servant's action server receives it")),
        }
    }

    /// Advertises a topic on which goals are sent or cancelled.
    pub(super) fn advertise(
        &self,
        (end, topic): (ActionEndpoint, &str),
        of: &WireType,
    ) -> Result<Box<dyn Publisher>, BusError> {
        match self {
            Self::One(topics) if end.is_published_by_clients() => topics.advertise(end, of),
            _ => Err(not_translated(format!("topic {topic}"), "the servant's action server publishes it")),
        }
    }

    /// Calls one of the services. A goal of which nobody can tell whether it was accepted is not accepted: ROS 2 has no
    /// other answer, and whoever sent it would wait for one.
    pub(super) async fn call(
        &self,
        (end, service): (ActionEndpoint, &str),
        digest: &Digest,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        let Self::Two(services) = self else {
            return Err(BusError::NoService(service.to_owned()));
        };
        match services.call((end, service), digest, request, timeout).await {
            Err(BusError::CallFailed { fate: CallFate::Unknown, .. }) if end == ActionEndpoint::SendGoal => {
                Ok(goal_server::rejected_response())
            }
            answer => answer,
        }
    }

    /// Returns the type of a topic, and whether late subscribers are given its last message.
    pub(super) fn offer(&self, end: ActionEndpoint, topic: &str) -> Result<Offer, BusError> {
        let wire_type = match self {
            Self::One(topics) => topics.wire_type(end).cloned(),
            Self::Two(services) => (!end.is_service()).then(|| Arc::new(services.wire_type(end).clone())),
        };
        let latching = matches!((self, end), (Self::Two(_), ActionEndpoint::Status));
        let offer = wire_type.map(|wire_type| Offer { wire_type, latching, kept: None });
        offer.ok_or_else(|| BusError::NoTopic(topic.to_owned()))
    }

    /// Returns the type of a service.
    pub(super) fn service_type(&self, end: ActionEndpoint, service: &str) -> Result<ServiceType, BusError> {
        match self {
            Self::Two(services) if end.is_service() => Ok(services.service_type(end).clone()),
            _ => Err(BusError::NoService(service.to_owned())),
        }
    }

    fn cancel_all(&self) {
        match self {
            Self::One(topics) => topics.cancel_all(),
            Self::Two(services) => services.cancel_all(),
        }
    }

    fn has_goals(&self) -> bool {
        match self {
            Self::One(topics) => topics.has_goals(),
            Self::Two(services) => services.has_goals(),
        }
    }
}
