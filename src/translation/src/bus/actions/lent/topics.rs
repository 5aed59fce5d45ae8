//! A server of ROS 1 on the robot, whose topics links carry.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    ActionEndpoint, BusError, GoalEvents, MessageReceiver, MessageSender, PeerId, SerializedMessage, WireType,
    message_queue,
};
use ros::ros1::actions::ActionTopicTypes;
use ros::ros1::actions::goal_client::GoalClient;
use ros::schema::ActionDef;

/// The topics of one action, and the goals sent to it.
pub(super) struct RobotTopics {
    types: ActionTopicTypes,
    goals: GoalClient,
    /// Receivers of goals and cancels.
    listeners: Mutex<Vec<(ActionEndpoint, MessageSender)>>,
}

/// Returns whether parts that are open belong to a server: as in graphs, one that receives goals and publishes results.
pub(super) fn has_server(parts: &BTreeMap<ActionEndpoint, usize>) -> bool {
    parts.contains_key(&ActionEndpoint::Goal) && parts.contains_key(&ActionEndpoint::Result)
}

impl RobotTopics {
    pub(super) fn new(action: &str, of: &ActionDef) -> Result<Self, BusError> {
        let types = ActionTopicTypes::for_action(action, of)?;
        Ok(Self { types, goals: GoalClient::default(), listeners: Mutex::default() })
    }

    /// Returns the type of a topic.
    pub(super) fn wire_type(&self, end: ActionEndpoint) -> Option<&WireType> {
        self.types.get(end).map(|of| &**of)
    }

    /// Adds someone who receives goals or cancels.
    pub(super) fn listen(&self, end: ActionEndpoint, depth: usize) -> MessageReceiver {
        let (sender, messages) = message_queue(depth);
        let mut listeners = self.listeners.lock();
        listeners.retain(|(_, listener)| !listener.is_closed());
        listeners.push((end, sender));
        messages
    }

    /// Sends a goal, in the name of `client`.
    pub(super) fn send_goal(&self, client: PeerId, id: &str, goal: &[u8], events: Arc<dyn GoalEvents>) {
        let message = self.goals.begin(id, goal, events);
        self.publish(client, ActionEndpoint::Goal, message);
    }

    pub(super) fn cancel_goal(&self, client: PeerId, id: &str) {
        if let Some(message) = self.goals.cancel(id) {
            self.publish(client, ActionEndpoint::Cancel, message);
        }
    }

    /// Cancels all goals and forgets them.
    pub(super) fn abandon_goals(&self, client: PeerId) {
        for message in self.goals.abandon() {
            self.publish(client.clone(), ActionEndpoint::Cancel, message);
        }
    }

    /// Receives a message of the robot's server.
    pub(super) fn on_message(&self, end: ActionEndpoint, message: &Bytes) {
        match end {
            ActionEndpoint::Feedback => self.goals.on_feedback(message),
            ActionEndpoint::Result => self.goals.on_result(message),
            ActionEndpoint::Status => drop(self.goals.on_status(message)),
            _ => {}
        }
    }

    fn publish(&self, publisher: PeerId, end: ActionEndpoint, bytes: Bytes) {
        let Some(of) = self.types.get(end) else {
            return;
        };
        let message = SerializedMessage { bytes, wire_type: Arc::clone(of), publisher, latching: false };
        for (_, listener) in self.listeners.lock().iter().filter(|(of, _)| *of == end) {
            listener.send(message.clone());
        }
    }
}
