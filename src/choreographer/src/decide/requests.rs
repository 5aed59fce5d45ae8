//! Finds the topics on which robots send requests to a servant and receive answers.

use package::interface::{Direction, Interface};
use package::requests::Reason;
use qos::{Correlation, TopicPair};
use ros::bus::RosVersion;

/// Returns the pair of the input whose messages are requests and the outputs that answer them, if the interface has
/// exactly one unambiguous pair. Stamps make a pair unambiguous. If the next output would be the answer, there must be
/// one input and one output, and nothing else to request, unless the deployer declares the pair: messages that a node
/// publishes at its own pace would be taken for answers.
pub fn find_topic_request(ros: RosVersion, interface: &Interface) -> Option<TopicPair> {
    let mut requests = interface.decided_requests(ros);
    let request = requests.pop().filter(|_| requests.is_empty())?;
    let mut pair = request.pair;
    // A latched output represents a state.
    let is_latched = |name: &String| {
        let mut topics = interface.topics.iter();
        topics.any(|it| it.direction == Direction::Output && it.latched && it.name == *name)
    };
    pair.outputs.retain(|name| !is_latched(name));
    let is_alone = || request.reason == Reason::Alone && interface.services.is_empty() && interface.actions.is_empty();
    let is_certain = match pair.by? {
        Correlation::Stamp => true,
        _ => request.reason == Reason::Stated || is_alone(),
    };
    (is_certain && !pair.outputs.is_empty()).then_some(pair)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns an interface with these topics, each `<` or `>` with its name and type, and these services.
    fn interface(topics: &[&str], services: &[&str]) -> Interface {
        let topics = topics.iter().map(|topic| {
            let (end, rest) = topic.split_at(1);
            let (name, type_name) = rest.split_once(' ').expect("a type");
            let direction = if end == "<" { "input" } else { "output" };
            let latched = name.ends_with("latched");
            serde_json::json!({ "name": name, "type": type_name, "direction": direction, "latched": latched })
        });
        let services = services.iter().map(|name| serde_json::json!({ "name": name, "type": "x/Ask" }));
        let definitions = serde_json::json!({
            "x/msg/Text": "string data\n",
            "x/msg/Stamped": "std_msgs/Header header\n",
            "std_msgs/msg/Header": "uint32 seq\ntime stamp\nstring frame_id\n",
        });
        let interface = serde_json::json!({
            "topics": topics.collect::<Vec<_>>(),
            "services": services.collect::<Vec<_>>(),
            "definitions": definitions,
        });
        serde_json::from_value(interface).expect("an interface")
    }

    #[test]
    fn stamps_of_ros_2_are_recognised() {
        let mut two = interface(&["</in x/msg/Stamped", ">/out x/msg/Stamped"], &["/ask"]);
        let header = "builtin_interfaces/Time stamp\nstring frame_id\n".to_owned();
        two.definitions.insert("std_msgs/msg/Header".into(), header);
        let found = find_topic_request(RosVersion::Two, &two).map(|pair| pair.to_string());
        assert_eq!(found.as_deref(), Some("/in -> /out by stamp"));
    }

    #[test]
    fn what_leaves_no_doubt_is_a_pair() {
        for (topics, services, expected) in [
            (&["</in x/Stamped", ">/out x/Stamped"][..], &[][..], "/in -> /out by stamp"),
            // With stamps other topics do not matter.
            (
                &["</in x/Stamped", "</also x/Text", ">/out x/Stamped", ">/beat x/Text"],
                &["/ask"],
                "/in -> /out by stamp",
            ),
            (&["</in x/Text", ">/out x/Text"], &[], "/in -> /out by arrival"),
            (&["</in x/Text", ">/out x/Text", ">/state_latched x/Text"], &[], "/in -> /out by arrival"),
            (&["</in x/Text", ">/out x/Text", ">/rosout x/Text"], &[], "/in -> /out by arrival"),
            // Which of them?
            (&["</in x/Text", "</also x/Text", ">/out x/Text"], &[], ""),
            (&["</in x/Text", ">/out x/Text", ">/beat x/Text"], &[], ""),
            (&["</in x/Text", ">/out x/Text"], &["/ask"], ""),
            (&["</in x/Text", ">/state_latched x/Text"], &[], ""),
            (&["</in x/Text"], &[], ""),
            (&[">/out x/Text"], &[], ""),
            // The type is unknown.
            (&["</in x/Missing", ">/out x/Text"], &[], ""),
            (&[], &["/ask"], ""),
        ] {
            let found = find_topic_request(RosVersion::One, &interface(topics, services));
            let words = found.map(|pair| pair.to_string()).unwrap_or_default();
            assert_eq!(words, expected, "{topics:?} {services:?}");
        }
    }
}
