//! ROS 1 actions: five topics under one name, as in actionlib (<http://wiki.ros.org/actionlib/DetailedDescription>).

pub mod goal_client;
pub mod goal_server;
pub mod goal_topics;
pub mod messages;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ros_bus::{ActionEndpoint, ActionNodes, BusError, TopicNodes, WireType};
use ros_message::schema::{ActionDef, MessageType, Registry, SchemaError};

/// Interval at which a server publishes the status, as in actionlib; it is also published at each change.
pub const STATUS_PERIOD: Duration = Duration::from_millis(200);
/// Queue depth of an action's topics for a slow peer.
pub(crate) const QUEUE: usize = 100;

/// Last part of the names of an action's topics.
const PARTS: [&str; 5] = ["goal", "cancel", "status", "feedback", "result"];

/// Returns true if messages of this type carry a goal id: goals, results and feedback.
pub fn carries_goal_id(type_name: &str) -> bool {
    let ends = ["ActionGoal", "ActionResult", "ActionFeedback"];
    ends.iter().any(|end| type_name.ends_with(end))
}

/// Returns true if messages of this type make a server start or stop a goal.
pub fn is_command_type(type_name: &str) -> bool {
    type_name.ends_with("ActionGoal") || type_name == "actionlib_msgs/GoalID"
}

/// The types of an action's topics.
#[derive(Debug, Clone)]
pub struct ActionTopicTypes {
    pub(crate) goal: Arc<WireType>,
    pub(crate) cancel: Arc<WireType>,
    pub(crate) feedback: Arc<WireType>,
    pub(crate) result: Arc<WireType>,
    pub(crate) status: Arc<WireType>,
}

impl ActionTopicTypes {
    /// Returns those of the action of this name, which an error names.
    pub fn for_action(action: &str, of: &ActionDef) -> Result<Self, BusError> {
        let known = Registry::new();
        let unusable =
            |error: SchemaError| BusError::Protocol { what: format!("action {action}"), reason: error.to_string() };
        let of_message = |of: &MessageType| Arc::new(WireType::from_message(of));
        let common = |name: &str| known.message(name).map(|of| of_message(&of)).map_err(unusable);
        Ok(Self {
            goal: of_message(&of.action_goal),
            cancel: common("actionlib_msgs/GoalID")?,
            feedback: of_message(&of.action_feedback),
            result: of_message(&of.action_result),
            status: common("actionlib_msgs/GoalStatusArray")?,
        })
    }

    /// Returns the type of a topic; `None` for the parts of ROS 2's actions that are services.
    pub fn get(&self, end: ActionEndpoint) -> Option<&Arc<WireType>> {
        Some(match end {
            ActionEndpoint::Goal => &self.goal,
            ActionEndpoint::Cancel => &self.cancel,
            ActionEndpoint::Feedback => &self.feedback,
            ActionEndpoint::Result => &self.result,
            ActionEndpoint::Status => &self.status,
            ActionEndpoint::SendGoal | ActionEndpoint::CancelGoal | ActionEndpoint::GetResult => return None,
        })
    }
}

/// Finds the actions among these topics.
pub(crate) fn find_actions(topics: &BTreeMap<String, TopicNodes>) -> BTreeMap<String, ActionNodes> {
    let mut found = BTreeMap::new();
    for (topic, goal) in topics {
        let Some(name) = topic.strip_suffix("/goal").filter(|name| !name.is_empty()) else {
            continue;
        };
        let parts = PARTS.map(|part| format!("{name}/{part}"));
        let Some(result) = topics.get(&parts[4]) else {
            continue;
        };
        if !parts.iter().all(|part| topics.contains_key(part)) {
            continue;
        }
        let answers = |node: &&String| result.publishers.contains(*node);
        // The type given by the servers, which publish results, has precedence: a client that publishes goals may be
        // mistaken.
        let told = result.type_name.strip_suffix("ActionResult");
        let asked = goal.type_name.strip_suffix("ActionGoal");
        let nodes = ActionNodes {
            type_name: told.or(asked).unwrap_or("*").to_owned(),
            servers: goal.subscribers.iter().filter(answers).cloned().collect(),
            clients: goal.publishers.clone(),
            topics: parts.into(),
        };
        found.insert(name.to_owned(), nodes);
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn five_topics_below_one_name_are_an_action() {
        let topic = |name: &str| {
            let of_server = name.ends_with("result") || name.ends_with("status");
            let mut ends = [vec!["/user".to_owned()], vec!["/server".to_owned()]];
            if of_server {
                ends.reverse();
            }
            let [publishers, subscribers] = ends;
            let type_name = if name.ends_with("result") { "x/DoActionResult" } else { "x/OtherActionGoal" };
            let nodes = TopicNodes { type_name: type_name.to_owned(), publishers, subscribers };
            (name.to_owned(), nodes)
        };
        let mut topics: BTreeMap<_, _> = PARTS.map(|part| topic(&format!("/do/{part}"))).into();
        topics.extend(PARTS.map(|part| topic(&format!("/{part}"))));
        topics.extend([topic("/half/goal"), topic("/half/result")]);
        let found = find_actions(&topics);
        let action = ActionNodes {
            type_name: "x/Do".to_owned(),
            servers: vec!["/server".to_owned()],
            clients: vec!["/user".to_owned()],
            topics: PARTS.map(|part| format!("/do/{part}")).into(),
        };
        assert_eq!(found, [("/do".to_owned(), action)].into());
    }
}
