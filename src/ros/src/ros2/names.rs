//! Names of ROS 2, and what DDS has for them
//! (<https://design.ros2.org/articles/topic_and_service_names.html>).
//!
//! ```text
//! /chatter                 rt/chatter
//! service /add             rq/addRequest, rr/addReply
//! action /fib              the services and topics below /fib/_action
//! std_msgs/msg/String      std_msgs::msg::dds_::String_
//! std_srvs/srv/SetBool     std_srvs::srv::dds_::SetBool_Request_, …_Response_
//! ```

use rtps::Topic;

use super::type_hash;
use crate::bus::{BusError, Digest, ServiceType, WireType};

/// Longer names are no names: DDS's have at most 255 bytes, with what is put before and behind them.
const MAX_NAME: usize = 247;
/// What stands between an action's name and those of its parts.
const ACTION: &str = "/_action/";

/// Whether `name` is absolute and made of what ROS 2 allows: `/camera/image_raw`.
pub fn is_global(name: &str) -> bool {
    let parts = name.strip_prefix('/').map(|rest| rest.split('/'));
    name.len() <= MAX_NAME && parts.is_some_and(|mut parts| parts.all(is_identifier))
}

/// Whether tools do not show it unless they are asked to: a part of it begins with `_`.
pub fn is_hidden(name: &str) -> bool {
    name.split('/').any(|part| part.starts_with('_'))
}

fn is_identifier(part: &str) -> bool {
    let first = part.bytes().next();
    first.is_some_and(|first| !first.is_ascii_digit())
        && part
            .bytes()
            .all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
}

/// What a topic of DDS is to ROS, by its name there.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Named {
    /// The topic of this name.
    Topic(String),
    /// What the service of this name is asked by.
    Request(String),
    /// What the service of this name answers by.
    Reply(String),
}

/// The name of a topic of DDS; none where it is none of ROS's.
pub(super) fn named(topic: &str) -> Option<Named> {
    let (kind, name) = topic.split_at_checked(2)?;
    let (name, make): (&str, fn(String) -> Named) = match kind {
        "rt" => (name, Named::Topic),
        "rq" => (name.strip_suffix("Request")?, Named::Request),
        "rr" => (name.strip_suffix("Reply")?, Named::Reply),
        _ => return None,
    };
    is_global(name).then(|| make(name.to_owned()))
}

/// The action, and which part of it has this name: `/fib` and `send_goal`.
pub fn action_part(name: &str) -> Option<(&str, &str)> {
    let (action, part) = name.rsplit_once(ACTION)?;
    (!action.is_empty() && !is_hidden(action)).then_some((action, part))
}

/// The name of a part of an action: `/fib` and `send_goal` make `/fib/_action/send_goal`.
pub fn part_of_action(action: &str, part: &str) -> String {
    format!("{action}{ACTION}{part}")
}

/// The absolute name of what a node of this absolute name calls `name`: `~` is the node itself.
pub fn resolve(name: &str, node: &str) -> String {
    if name.starts_with('/') {
        return name.to_owned();
    }
    if let Some(own) = name.strip_prefix('~') {
        return format!("{node}{own}");
    }
    let namespace = node.rsplit_once('/').map_or("", |(above, _)| above);
    format!("{namespace}/{name}")
}

/// `std_msgs/msg/String` of DDS's name. What is not made by rosidl is called by its name in DDS.
pub(super) fn type_of(dds: &str) -> String {
    rosidl_type(dds).unwrap_or_else(|| dds.to_owned())
}

fn rosidl_type(dds: &str) -> Option<String> {
    let mut parts = dds.split("::");
    let [package, kind, namespace, short] = [(); 4].map(|()| parts.next().unwrap_or_default());
    let short = short.strip_suffix('_')?;
    let well_formed = [package, kind, short].into_iter().all(is_identifier);
    (namespace == "dds_" && well_formed && parts.next().is_none())
        .then(|| format!("{package}/{kind}/{short}"))
}

/// `std_srvs/srv/SetBool` of DDS's name of its requests.
pub(super) fn service_type_of(request: &str) -> Option<String> {
    let name = rosidl_type(request)?;
    name.strip_suffix("_Request").map(str::to_owned)
}

/// `test_msgs/action/Fibonacci` of DDS's name of the requests by which goals are sent.
pub(super) fn action_type_of(request: &str) -> Option<String> {
    let name = service_type_of(request)?;
    name.strip_suffix("_SendGoal").map(str::to_owned)
}

/// A name of a type with its kind: `package/kind/Type`. `kind` is that of names which do not say.
pub(super) fn full(name: &str, kind: &str) -> String {
    match name.split_once('/') {
        Some((package, short)) if !short.contains('/') => format!("{package}/{kind}/{short}"),
        _ => name.to_owned(),
    }
}

/// DDS's name of a type of ROS; `kind` is that of names which do not say.
fn dds_type(name: &str, kind: &str, ending: &str) -> Result<String, BusError> {
    let bad = || BusError::BadName(name.to_owned());
    let mut parts = name.split('/');
    let (package, second, third) = (parts.next(), parts.next(), parts.next());
    let (package, kind, short) = match (package, second, third) {
        (Some(package), Some(short), None) => (package, kind, short),
        (Some(package), Some(kind), Some(short)) => (package, kind, short),
        // As `type_of` leaves it.
        (Some(other), None, None) if other != "*" && !other.is_empty() => {
            return Ok(other.to_owned());
        }
        _ => return Err(bad()),
    };
    let well_formed = [package, kind, short].into_iter().all(is_identifier);
    if !well_formed || parts.next().is_some() {
        return Err(bad());
    }
    Ok(format!("{package}::{kind}::dds_::{short}{ending}_"))
}

/// DDS's name of a topic.
pub(super) fn topic_name(name: &str) -> String {
    format!("rt{name}")
}

/// DDS's name of the topic by which a service is asked.
pub(super) fn request_name(service: &str) -> String {
    format!("rq{service}Request")
}

/// DDS's name of the topic by which a service answers.
pub(super) fn reply_name(service: &str) -> String {
    format!("rr{service}Reply")
}

/// DDS's name of a type of messages.
pub(super) fn message_type(name: &str) -> Result<String, BusError> {
    dds_type(name, "msg", "")
}

/// A topic, as ends of this type have it.
pub(super) fn topic(name: &str, of: &WireType) -> Result<Topic, BusError> {
    let type_name = message_type(&of.name)?;
    Ok(made(topic_name(name), type_name, &of.digest))
}

/// What a service is asked by.
pub(super) fn request(service: &str, of: &ServiceType) -> Result<Topic, BusError> {
    let type_name = dds_type(&of.name, "srv", "_Request")?;
    Ok(made(request_name(service), type_name, &of.request))
}

/// What a service answers by.
pub(super) fn reply(service: &str, of: &ServiceType) -> Result<Topic, BusError> {
    let type_name = dds_type(&of.name, "srv", "_Response")?;
    Ok(made(reply_name(service), type_name, &of.response))
}

fn made(name: String, type_name: String, digest: &Digest) -> Topic {
    Topic {
        name,
        type_name,
        user_data: type_hash::user_data(digest),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_absolute_clean_names_are_global() {
        for good in ["/a", "/a/b_2", "/_hidden", "/fib/_action/status"] {
            assert!(is_global(good), "{good}");
        }
        for bad in ["", "/", "a", "/a/", "/a//b", "/ä", "/a b", "/2a", "/a/2"] {
            assert!(!is_global(bad), "{bad}");
        }
        assert!(!is_global(&format!("/{}", "x".repeat(MAX_NAME))));
    }

    #[test]
    fn names_of_a_node_are_resolved() {
        for (name, node, expected) in [
            ("/work", "/r1/w", "/work"),
            ("work", "/r1/w", "/r1/work"),
            ("a/work", "/w", "/a/work"),
            ("~/set", "/r1/w", "/r1/w/set"),
            ("~", "/w", "/w"),
        ] {
            assert_eq!(resolve(name, node), expected);
        }
        let part = part_of_action("/a/fib", "status");
        assert_eq!(action_part(&part), Some(("/a/fib", "status")));
    }

    #[test]
    fn topics_of_dds_are_told_by_what_they_are_to_ros() {
        let known = |name: &str| named(name).unwrap_or_else(|| panic!("{name} is ROS's"));
        assert_eq!(known("rt/chatter"), Named::Topic("/chatter".to_owned()));
        assert_eq!(
            known("rq/a/addRequest"),
            Named::Request("/a/add".to_owned())
        );
        assert_eq!(known("rr/a/addReply"), Named::Reply("/a/add".to_owned()));
        for other in [
            "ros_discovery_info",
            "rt",
            "rq/add",
            "rt//x",
            "x",
            "rqé",
            "rq/Request",
        ] {
            assert_eq!(named(other), None, "{other}");
        }
        assert_eq!(
            action_part("/a/fib/_action/send_goal"),
            Some(("/a/fib", "send_goal"))
        );
        for other in ["/send_goal", "/_action/send_goal", "/_a/_action/send_goal"] {
            assert_eq!(action_part(other), None, "{other}");
        }
    }

    #[test]
    fn types_come_back_from_dds() {
        let of = WireType::named("std_msgs/msg/String");
        let topic = topic("/chatter", &of).expect("a topic");
        assert_eq!(
            (&*topic.name, &*topic.type_name),
            ("rt/chatter", "std_msgs::msg::dds_::String_")
        );
        assert_eq!(type_of(&topic.type_name), of.name);
        assert_eq!(
            message_type("std_msgs/String").expect("a type"),
            topic.type_name
        );
        let service = ServiceType::new("test_msgs/action/Fibonacci_SendGoal", "*");
        let asked = request("/fib/_action/send_goal", &service).expect("a topic");
        assert_eq!(
            (&*asked.name, &*asked.type_name),
            (
                "rq/fib/_action/send_goalRequest",
                "test_msgs::action::dds_::Fibonacci_SendGoal_Request_"
            )
        );
        assert_eq!(service_type_of(&asked.type_name), Some(service.name));
        assert_eq!(
            action_type_of(&asked.type_name).as_deref(),
            Some("test_msgs/action/Fibonacci")
        );
        // Made by others.
        assert_eq!(type_of("HelloWorldData::Msg"), "HelloWorldData::Msg");
        assert_eq!(
            message_type("HelloWorldData::Msg").expect("a type"),
            "HelloWorldData::Msg"
        );
        for bad in ["*", "", "a/b/c/d", "a/b c", "/", "a//b"] {
            assert!(message_type(bad).is_err(), "{bad}");
        }
    }
}
