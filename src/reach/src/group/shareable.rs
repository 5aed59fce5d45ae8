//! Decides which parts of an interface robots can share: services and actions, whose responses go to the caller. Topics
//! reach every robot, so an interface with topics is refused; so is one that lets a robot change the state of its
//! nodes.
//!
//! | part of a package | shared? |
//! |---|---|
//! | service or action | shown to each robot |
//! | topic with logs, statistics, diagnostics, parameter or lifecycle changes, bonds (by type) | not shown [^1] |
//! | any other topic, in or out (including tf, clock and latched topics) | refused |
//! | node that writes parameters, except through dynamic_reconfigure (ROS 1) | refused: it keeps state |
//! | parameters of a node (ROS 2) | not shown: they belong to the deployer |
//! | service that sets or gets parameters, loggers, nodelets, components, lifecycles (by type) | not shown [^2] |
//! | service with an empty response (`std_srvs/Empty`), or `std_srvs/SetBool` | refused: it changes state |
//! | service or action that it looks for on its robot | refused: the robot would be ambiguous |
//!
//! [^1]: Nobody outside the servant receives them.
//! [^2]: They change the node for all robots.
//!
//! Types are written as in ROS 1; for ROS 2, `package/Type` stands for `package/msg/Type`.

use std::borrow::Cow;
use std::fmt;

use package::interface::{Direction, Interface};
use ros::bus::RosVersion;
use ros::schema::{Base, MessageType, Registry};

/// Types of topics that no robot needs.
const INTERNAL_TYPES: [&str; 10] = [
    "rosgraph_msgs/Log",
    "rosgraph_msgs/TopicStatistics",
    "rcl_interfaces/Log",
    "rcl_interfaces/ParameterEvent",
    "statistics_msgs/MetricsMessage",
    "lifecycle_msgs/TransitionEvent",
    "diagnostic_msgs/DiagnosticArray",
    "dynamic_reconfigure/Config",
    "dynamic_reconfigure/ConfigDescription",
    "bond/Status",
];

/// Packages with administrative services.
const ADMINISTER: [&str; 8] = [
    "dynamic_reconfigure/",
    "roscpp/",
    "nodelet/",
    "topic_tools/",
    "rcl_interfaces/",
    "type_description_interfaces/",
    "lifecycle_msgs/",
    "composition_interfaces/",
];

/// Types of transforms.
const TRANSFORMS: [&str; 2] = ["tf2_msgs/TFMessage", "tf/tfMessage"];

/// A server of this type writes its own parameters when it starts.
const RECONFIGURE: &str = "dynamic_reconfigure/Reconfigure";

/// Type of services that switch something in the node.
const SWITCH: &str = "std_srvs/SetBool";

/// Returns `package/Type` for either ROS version.
fn plain_type_name(type_name: &str) -> Cow<'_, str> {
    let mut parts = type_name.split('/');
    match (parts.next(), parts.next(), parts.next(), parts.next()) {
        (Some(package), Some(_), Some(name), None) => format!("{package}/{name}").into(),
        _ => type_name.into(),
    }
}

/// Reasons why an interface cannot be shared.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unshareable(pub Vec<String>);

impl fmt::Display for Unshareable {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "robots cannot share it: {}", self.0.join("; "))
    }
}

impl std::error::Error for Unshareable {}

/// Returns an error if robots cannot share the interface.
pub fn check_shareable(ros: RosVersion, interface: &Interface) -> Result<(), Unshareable> {
    let mut found = Vec::new();
    let topics = interface.topics.iter();
    for topic in topics.filter(|topic| !INTERNAL_TYPES.contains(&&*plain_type_name(&topic.type_name))) {
        let transforms = TRANSFORMS.contains(&&*plain_type_name(&topic.type_name));
        let (verb, of) = match topic.direction {
            Direction::Input if transforms => {
                ("subscribes to", "it would see the transforms of all robots as one tree")
            }
            Direction::Input => ("subscribes to", "one robot's messages would reach all robots"),
            Direction::Output if transforms => ("publishes", "its transforms would be in every robot's tree"),
            Direction::Output if topic.latched => {
                ("publishes, latched,", "its last result for one robot would be latched for all robots")
            }
            Direction::Output => ("publishes", "its results for one robot would reach all robots"),
        };
        found.push(format!("it {verb} {} ({}): {of}", topic.name, topic.type_name));
    }
    let of_clients = |node: &str| {
        let mut services = interface.services.iter();
        services.any(|it| it.node == node && it.type_name == RECONFIGURE)
    };
    for parameter in &interface.parameters {
        let mut nodes = parameter.written_by.iter();
        if let Some(node) = nodes.find(|node| !(of_clients(node) && parameter.name.starts_with(&format!("{node}/")))) {
            found.push(format!(
                "its node {node} writes the parameter {}: it would hold data of all robots' requests",
                parameter.name
            ));
        }
    }
    for need in &interface.needs {
        found.push(format!("it calls {}, which each robot serves itself", need.name));
    }
    // Invalid definitions were refused before.
    let registry =
        Registry::with_definitions(ros, &interface.definitions).unwrap_or_else(|_| Registry::for_version(ros));
    let shown = shared_interface(interface);
    for service in &shown.services {
        let of = registry.service(&service.type_name);
        let answers_nothing = of.is_ok_and(|of| is_empty_message(&of.response));
        if answers_nothing || plain_type_name(&service.type_name) == SWITCH {
            found.push(format!(
                "it serves {} ({}), whose response is empty: it changes the state of the node for all robots",
                service.name, service.type_name
            ));
        }
    }
    if found.is_empty() && shown.services.is_empty() && shown.actions.is_empty() {
        found.push("it has neither a service nor an action".to_owned());
    }
    if found.is_empty() { Ok(()) } else { Err(Unshareable(found)) }
}

/// Returns whether a message has no fields except empty messages such as std_msgs/Empty.
fn is_empty_message(of: &MessageType) -> bool {
    let mut fields = of.fields().iter();
    fields.all(|field| matches!(&field.base, Base::Message(inner) if is_empty_message(inner)))
}

/// Returns remarks for the deployer of a shared interface.
pub fn remarks(interface: &Interface) -> Vec<String> {
    let lifecycles = interface.lifecycle.iter();
    let remark = |node: &String| {
        format!(
            "{node} has a lifecycle: its servants keep it active, and robots that share it can neither query nor \
                change its state; a launch file of a robot that waits for it never goes on"
        )
    };
    lifecycles.map(remark).collect()
}

/// Returns the part of a shared interface that each robot sees.
pub fn shared_interface(interface: &Interface) -> Interface {
    let administers = |name: &str| ADMINISTER.iter().any(|package| name.starts_with(package));
    let services = interface.services.iter();
    Interface {
        topics: Vec::new(),
        parameters: Vec::new(),
        services: services.filter(|service| !administers(&service.type_name)).cloned().collect(),
        ..interface.clone()
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn interface(change: impl FnOnce(&mut Value)) -> Interface {
        let mut interface = json!({
            "topics": [
                { "name": "/rosout", "type": "rosgraph_msgs/Log", "direction": "output" },
                { "name": "/adder/parameter_updates", "type": "dynamic_reconfigure/Config", "direction": "output" },
            ],
            "services": [
                { "name": "/add", "type": "x_msgs/Add" },
                { "name": "/adder/set_parameters", "type": "dynamic_reconfigure/Reconfigure" },
            ],
            "actions": [],
            "definitions": {
                "x_msgs/srv/Add": "int64 a\n---\nint64 sum\n",
                "x_msgs/srv/Reset": "---\n",
                "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message\n",
            },
        });
        change(&mut interface);
        serde_json::from_value(interface).expect("an interface")
    }

    fn findings(change: impl FnOnce(&mut Value)) -> Vec<String> {
        let outcome = check_shareable(RosVersion::One, &interface(change));
        outcome.err().map_or(Vec::new(), |refused| refused.0)
    }

    fn push_item(value: &mut Value, field: &str, item: Value) {
        value[field].as_array_mut().expect("a list").push(item);
    }

    #[test]
    fn services_are_shared_and_what_administers_the_node_is_not_shown() {
        let interface = interface(|_| {});
        assert_eq!(check_shareable(RosVersion::One, &interface), Ok(()));
        let shown = shared_interface(&interface);
        let names: Vec<_> = shown.services.iter().map(|it| it.name.as_str()).collect();
        assert_eq!((names, shown.topics.len()), (vec!["/add"], 0));
    }

    #[test]
    fn interfaces_that_leak_between_robots_are_refused_with_the_findings() {
        let topic = |name: &str, of: &str, direction: &str| {
            let latched = name == "/map";
            let topic = json!({ "name": name, "type": of, "direction": direction, "latched": latched });
            findings(|it| push_item(it, "topics", topic)).join("; ")
        };
        for (name, of, direction, expected) in [
            ("/image", "sensor_msgs/Image", "input", "it subscribes to /image (sensor_msgs/Image)"),
            (
                "/map",
                "nav_msgs/OccupancyGrid",
                "output",
                "it publishes, latched, /map (nav_msgs/OccupancyGrid): its last result",
            ),
            ("/found", "x_msgs/Found", "output", "it publishes /found (x_msgs/Found): its results"),
            (
                "/tf",
                "tf2_msgs/TFMessage",
                "input",
                "it subscribes to /tf (tf2_msgs/TFMessage): it would see the transforms of all robots",
            ),
            ("/tf_static", "tf/tfMessage", "output", "it publishes /tf_static (tf/tfMessage): its transforms"),
            ("/clock", "rosgraph_msgs/Clock", "input", "it subscribes to /clock"),
        ] {
            let found = topic(name, of, direction);
            assert!(found.starts_with(expected), "{found}");
        }
        let calls = findings(|it| it["needs"] = json!([{ "name": "/get_map" }]));
        assert_eq!(calls, ["it calls /get_map, which each robot serves itself"]);
    }

    #[test]
    fn a_node_that_keeps_something_in_parameters_is_refused() {
        for (name, node, refused) in [
            ("/seen", "/adder", true),
            ("/finder/last", "/finder", true),
            // As dynamic_reconfigure does.
            ("/adder/gain", "/adder", false),
        ] {
            let service = json!({
                "name": "/adder/set_parameters", "type": "dynamic_reconfigure/Reconfigure", "node": "/adder",
            });
            let found = findings(|it| {
                push_item(it, "services", service);
                it["parameters"] = json!([
                    { "name": "/adder/word", "read_by": ["/adder"] },
                    { "name": name, "written_by": [node] },
                ]);
            });
            let words = format!("its node {node} writes the parameter {name}");
            assert_eq!(found.len(), usize::from(refused), "{found:?}");
            assert!(found.iter().all(|it| it.starts_with(&words)), "{found:?}");
        }
    }

    #[test]
    fn a_service_that_only_changes_the_node_is_refused() {
        for of in ["x_msgs/Reset", "std_srvs/SetBool"] {
            let service = json!({ "name": "/reset", "type": of });
            let found = findings(|it| push_item(it, "services", service)).join("; ");
            assert!(found.starts_with("it serves /reset"), "{of}: {found}");
        }
    }

    #[test]
    fn an_interface_without_services_and_actions_is_refused() {
        let found = findings(|it| it["services"] = json!([]));
        assert_eq!(found, ["it has neither a service nor an action"]);
    }

    /// A shareable interface of ROS 2.
    fn interface_ros2(change: impl FnOnce(&mut Value)) -> Interface {
        let topic = |name: &str, of: &str| json!({ "name": name, "type": of, "direction": "output" });
        let service = |name: &str, of: &str| json!({ "name": name, "type": of, "node": "/adder" });
        let mut interface = json!({
            "topics": [
                topic("/rosout", "rcl_interfaces/msg/Log"),
                topic("/parameter_events", "rcl_interfaces/msg/ParameterEvent"),
                topic("/adder/transition_event", "lifecycle_msgs/msg/TransitionEvent"),
                topic("/statistics", "statistics_msgs/msg/MetricsMessage"),
                topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
            ],
            "services": [
                service("/add", "x_msgs/srv/Add"),
                service("/adder/set_parameters", "rcl_interfaces/srv/SetParameters"),
                service("/adder/get_type_description", "type_description_interfaces/srv/GetTypeDescription"),
                service("/adder/change_state", "lifecycle_msgs/srv/ChangeState"),
                service("/adder/_container/load_node", "composition_interfaces/srv/LoadNode"),
            ],
            "actions": [{ "name": "/count", "type": "x_msgs/action/Count" }],
            "parameters": [{ "name": "/adder/rate", "node": "/adder", "value": 3 }],
            "lifecycle": ["/adder"],
            "definitions": {
                "x_msgs/srv/Add": "int64 a\n---\nint64 sum\n",
                "x_msgs/srv/Reset": "---\n",
                "x_msgs/srv/Clear": "---\nstd_msgs/Empty response\n",
                "x_msgs/action/Count": "int32 to\n---\nint32 all\n---\nint32 at\n",
                "std_msgs/msg/Empty": "",
                "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message\n",
            },
        });
        change(&mut interface);
        serde_json::from_value(interface).expect("an interface")
    }

    fn findings_ros2(change: impl FnOnce(&mut Value)) -> Vec<String> {
        let outcome = check_shareable(RosVersion::Two, &interface_ros2(change));
        outcome.err().map_or(Vec::new(), |refused| refused.0)
    }

    #[test]
    fn standard_interfaces_of_ros_2_nodes_are_not_shown() {
        let interface = interface_ros2(|_| {});
        assert_eq!(check_shareable(RosVersion::Two, &interface), Ok(()));
        let shown = shared_interface(&interface);
        let names: Vec<_> = shown.services.iter().map(|it| it.name.as_str()).collect();
        assert_eq!(names, ["/add"]);
        assert!(shown.topics.is_empty() && shown.parameters.is_empty());
        assert_eq!(shown.actions.len(), 1);
        // A robot's launch file may want to change it.
        let remarks = remarks(&interface);
        assert!(remarks.len() == 1 && remarks[0].starts_with("/adder has a lifecycle"));
    }

    #[test]
    fn unshareable_interfaces_of_ros_2_are_refused() {
        for (name, of, direction, expected) in [
            ("/image", "sensor_msgs/msg/Image", "input", "it subscribes to /image (sensor_msgs/msg/Image)"),
            (
                "/tf",
                "tf2_msgs/msg/TFMessage",
                "input",
                "it subscribes to /tf (tf2_msgs/msg/TFMessage): it would see the transforms of all",
            ),
            ("/clock", "rosgraph_msgs/msg/Clock", "input", "it subscribes to /clock"),
        ] {
            let topic = json!({ "name": name, "type": of, "direction": direction });
            let found = findings_ros2(|it| push_item(it, "topics", topic)).join("; ");
            assert!(found.starts_with(expected), "{found}");
        }
        for of in ["x_msgs/srv/Reset", "x_msgs/srv/Clear", "std_srvs/srv/SetBool"] {
            let service = json!({ "name": "/reset", "type": of });
            let found = findings_ros2(|it| push_item(it, "services", service)).join("; ");
            assert!(found.starts_with("it serves /reset"), "{of}: {found}");
        }
        let calls = findings_ros2(|it| it["needs"] = json!([{ "name": "/dock" }]));
        assert_eq!(calls, ["it calls /dock, which each robot serves itself"]);
    }
}
