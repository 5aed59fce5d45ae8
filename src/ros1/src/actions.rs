//! ROS 1 actions: five topics under one name, as in actionlib (<http://wiki.ros.org/actionlib/DetailedDescription>).

pub mod messages;

use std::collections::BTreeMap;

use ros_bus::{ActionNodes, TopicNodes};

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
