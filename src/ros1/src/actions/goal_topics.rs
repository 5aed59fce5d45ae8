//! An action of ROS 1 that a client of another kind stands behind: to those who use its five topics it looks like one
//! action server.
//!
//! ```text
//!  goal, cancel ──▶ GoalServer ─▶ ActionClient      a group of servants, an action of the other ROS
//!  feedback, result, status ◀── GoalEvents
//! ```
//!
//! Its users have its own goals only: a cancel of all goals concerns no goal that was sent elsewhere.

#[cfg(test)]
mod tests;

use std::sync::{Arc, Weak};

use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::{
    ActionClient, ActionEndpoint, BusError, GoalEnd, GoalError, GoalEvents, GoalOutcome, MatchedPeers, MessageSender,
    PeerId, Publisher, QosProfile, SerializedMessage, Subscription, TopicPeer, WireType, message_queue,
};
use ros_message::schema::ActionDef;
use tokio::sync::watch;

use super::goal_server::{GoalLimits, GoalServer, GoalServerTopics};
use super::{ActionTopicTypes, STATUS_PERIOD};

/// Maximum number of goals under way of those who use one action; more are rejected. A node would hold them in its own
/// memory, but here it is the daemon's.
pub const MAX_GOALS: usize = 256;

/// The topics of one action in front of a client.
pub struct GoalTopics<C> {
    goals: GoalServer<Listeners>,
    client: C,
    matched: watch::Sender<MatchedPeers>,
}

/// Subscribers of the topics.
struct Listeners {
    types: ActionTopicTypes,
    node: PeerId,
    state: Mutex<ListenersState>,
}

#[derive(Default)]
struct ListenersState {
    all: Vec<(ActionEndpoint, MessageSender)>,
    /// True while a task publishes the status.
    ticking: bool,
}

impl Listeners {
    fn publish(&self, end: ActionEndpoint, bytes: Bytes) {
        let Some(of) = self.types.get(end) else {
            return;
        };
        let message =
            SerializedMessage { bytes, wire_type: Arc::clone(of), publisher: self.node.clone(), latching: false };
        let mut state = self.state.lock();
        state.all.retain(|(_, listener)| !listener.is_closed());
        for (_, listener) in state.all.iter().filter(|(of, _)| *of == end) {
            listener.send(message.clone());
        }
    }

    /// Adds a subscriber; returns true if the status is to be published periodically from now on.
    fn add(&self, end: ActionEndpoint, listener: MessageSender) -> bool {
        let mut state = self.state.lock();
        state.all.push((end, listener));
        end == ActionEndpoint::Status && !std::mem::replace(&mut state.ticking, true)
    }

    /// Returns false if nobody subscribes to the status any more; the task that asks ends then.
    fn goes_on_ticking(&self) -> bool {
        let mut state = self.state.lock();
        state.ticking = state.all.iter().any(|(end, _)| *end == ActionEndpoint::Status);
        state.ticking
    }
}

impl GoalServerTopics for Listeners {
    fn publish_status(&self, message: Bytes) {
        self.publish(ActionEndpoint::Status, message);
    }

    fn publish_feedback(&self, message: Bytes) {
        self.publish(ActionEndpoint::Feedback, message);
    }

    fn publish_result(&self, message: Bytes) {
        self.publish(ActionEndpoint::Result, message);
    }
}

impl<C: ActionClient + 'static> GoalTopics<C> {
    /// Creates the topics of an action that `node` seems to serve. Goals under way are charged to `budget`.
    pub fn new(
        (name, node): (&str, &str),
        of: &Arc<ActionDef>,
        client: C,
        budget: &Budget,
    ) -> Result<Arc<Self>, BusError> {
        let node = PeerId::from(node);
        let peer = TopicPeer { id: node.clone(), connected: true, offer: None };
        let listeners = Listeners { types: ActionTopicTypes::for_action(name, of)?, node, state: Mutex::default() };
        let limits = GoalLimits { goals: MAX_GOALS, budget: budget.clone(), holder: "this robot" };
        Ok(Arc::new(Self {
            goals: GoalServer::new(name, of, listeners, limits),
            client,
            matched: watch::Sender::new(MatchedPeers { peers: vec![peer], refused: Vec::new() }),
        }))
    }

    /// Returns the client that executes the goals.
    pub fn client(&self) -> &C {
        &self.client
    }

    /// Returns the type of a topic; `None` for the parts of ROS 2's actions that are services.
    pub fn wire_type(&self, end: ActionEndpoint) -> Option<&Arc<WireType>> {
        self.goals.topics().types.get(end)
    }

    /// Subscribes to a topic with updates about goals.
    pub fn subscribe(
        self: &Arc<Self>,
        end: ActionEndpoint,
        of: &WireType,
        qos: QosProfile,
    ) -> Result<Subscription, BusError> {
        self.check_type(end, of)?;
        let (sender, messages) = message_queue(qos.depth);
        if self.goals.topics().add(end, sender) {
            tokio::spawn(publish_status_periodically(Arc::downgrade(self)));
        }
        if end == ActionEndpoint::Status {
            self.goals.publish_status();
        }
        Ok(Subscription {
            dropped: messages.drop_counter(),
            messages,
            matched: self.matched.subscribe(),
            // The action exists as long as somebody subscribes.
            guard: Box::new(Arc::clone(self)),
        })
    }

    /// Advertises a topic on which goals are sent or cancelled.
    pub fn advertise(self: &Arc<Self>, end: ActionEndpoint, of: &WireType) -> Result<Box<dyn Publisher>, BusError> {
        self.check_type(end, of)?;
        Ok(Box::new(GoalTopicPublisher { topics: Arc::clone(self), end }))
    }

    /// Cancels all goals.
    pub fn cancel_all(&self) {
        self.goals.under_way().iter().for_each(|id| self.client.cancel_goal(id));
    }

    /// Returns true if a goal has not ended.
    pub fn has_goals(&self) -> bool {
        !self.goals.under_way().is_empty()
    }

    fn check_type(&self, end: ActionEndpoint, of: &WireType) -> Result<(), BusError> {
        let what = || format!("topic of action {}", self.goals.name());
        let Some(ours) = self.wire_type(end) else {
            return Err(BusError::NoTopic(what()));
        };
        if ours.is_compatible_with(of) {
            Ok(())
        } else {
            Err(BusError::TypeMismatch { what: what(), theirs: of.to_string(), ours: ours.to_string() })
        }
    }

    fn receive_goal(self: &Arc<Self>, message: &Bytes) {
        let Some((id, goal)) = self.goals.begin(message) else {
            return;
        };
        self.goals.announce_status();
        let events = TopicsGoalEvents {
            // It receives the end of the goal even if nobody subscribes any more.
            topics: Arc::clone(self),
            id: id.clone(),
        };
        self.client.send_goal(&id, goal, Arc::new(events));
    }
}

/// Publishes the status until nobody subscribes to it.
async fn publish_status_periodically<C: ActionClient + 'static>(topics: Weak<GoalTopics<C>>) {
    loop {
        tokio::time::sleep(STATUS_PERIOD).await;
        let Some(topics) = topics.upgrade() else {
            return;
        };
        topics.goals.publish_status();
        if !topics.goals.topics().goes_on_ticking() {
            return;
        }
    }
}

struct GoalTopicPublisher<C> {
    topics: Arc<GoalTopics<C>>,
    end: ActionEndpoint,
}

impl<C: ActionClient + 'static> Publisher for GoalTopicPublisher<C> {
    fn publish(&self, message: Bytes) {
        let topics = &self.topics;
        if self.end == ActionEndpoint::Goal {
            return topics.receive_goal(&message);
        }
        for id in topics.goals.cancel(&message) {
            topics.client.cancel_goal(&id);
        }
    }

    fn matched_subscribers(&self) -> watch::Receiver<MatchedPeers> {
        self.topics.matched.subscribe()
    }
}

struct TopicsGoalEvents<C> {
    topics: Arc<GoalTopics<C>>,
    id: String,
}

impl<C: ActionClient + 'static> GoalEvents for TopicsGoalEvents<C> {
    fn on_accepted(&self) {
        self.topics.goals.accept(&self.id);
    }

    fn on_feedback(&self, feedback: Bytes) {
        self.topics.goals.publish_feedback(&self.id, &feedback);
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        let goals = &self.topics.goals;
        match end {
            Ok(end) => goals.end_goal(&self.id, end),
            Err(error) => goals.end_without_result(&self.id, GoalOutcome::Aborted, error.to_string()),
        };
    }
}
