//! What of an interface robots can share: services and actions, whose answers go to who asked. What a topic carries is every
//! robot's, so an interface that has any is refused; so is one that lets a robot change what the nodes keep.
//!
//! | what a package has | shared |
//! |---|---|
//! | a service, an action | shown to each robot |
//! | logs, statistics, diagnostics, changes of parameters and of lifecycles, bonds (topics, by type) | not shown; nobody outside the servant gets them |
//! | any other topic, in or out (tf, the clock and latched ones too) | refused |
//! | a node that writes parameters, unless dynamic_reconfigure has it do so (ROS 1) | refused: it keeps something |
//! | parameters of a node's own (ROS 2) | not shown: they are the deployer's |
//! | what sets parameters, loggers, nodelets, components and lifecycles, and what asks for them (services, by type) | not shown: they change the node for all |
//! | a service whose answer says nothing (`std_srvs/Empty`), `std_srvs/SetBool` | refused: it can only be there for what the node keeps |
//! | a service or an action that it looks for on its robot | refused: which robot's would that be |
//!
//! Types are written as ROS 1 does here; of ROS 2 `package/msg/Type` is meant by `package/Type`.

use std::borrow::Cow;
use std::fmt;

use package::interface::{Direction, Interface};
use ros::bus::RosVersion;
use ros::schema::{Base, MessageType, Registry};

/// Types of topics that no robot needs.
const UNNEEDED: [&str; 10] = [
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

/// Packages of services by which nodes are administered.
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

/// Transforms.
const TRANSFORMS: [&str; 2] = ["tf2_msgs/TFMessage", "tf/tfMessage"];

/// Who serves this writes its own parameters when it starts.
const RECONFIGURE: &str = "dynamic_reconfigure/Reconfigure";

/// A service of this type turns something on or off in the node.
const SWITCH: &str = "std_srvs/SetBool";

/// `package/Type`, of whichever ROS.
fn plain(type_name: &str) -> Cow<'_, str> {
    let mut parts = type_name.split('/');
    match (parts.next(), parts.next(), parts.next(), parts.next()) {
        (Some(package), Some(_), Some(name), None) => format!("{package}/{name}").into(),
        _ => type_name.into(),
    }
}

/// Why an interface cannot be shared: each thing that was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unshareable(pub Vec<String>);

impl fmt::Display for Unshareable {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "robots cannot share it: {}", self.0.join("; "))
    }
}

impl std::error::Error for Unshareable {}

/// Refuses an interface of this ROS that robots cannot share.
pub fn check(ros: RosVersion, interface: &Interface) -> Result<(), Unshareable> {
    let mut found = Vec::new();
    let topics = interface.topics.iter();
    for topic in topics.filter(|topic| !UNNEEDED.contains(&&*plain(&topic.type_name))) {
        let transforms = TRANSFORMS.contains(&&*plain(&topic.type_name));
        let (verb, of) = match topic.direction {
            Direction::Input if transforms => (
                "subscribes to",
                "transforms of all robots would be one tree to it",
            ),
            Direction::Input => ("subscribes to", "one robot's messages would reach all"),
            Direction::Output if transforms => {
                ("publishes", "its transforms would be in every robot's tree")
            }
            Direction::Output if topic.latched => (
                "publishes, latched,",
                "what it made of one robot's messages last would be kept for all",
            ),
            Direction::Output => (
                "publishes",
                "what it makes of one robot's messages would reach all",
            ),
        };
        found.push(format!(
            "it {verb} {} ({}): {of}",
            topic.name, topic.type_name
        ));
    }
    let of_clients = |node: &str| {
        let mut services = interface.services.iter();
        services.any(|it| it.node == node && it.type_name == RECONFIGURE)
    };
    for parameter in &interface.parameters {
        let mut nodes = parameter.written_by.iter();
        if let Some(node) = nodes
            .find(|node| !(of_clients(node) && parameter.name.starts_with(&format!("{node}/"))))
        {
            found.push(format!(
                "its node {node} writes the parameter {}: what it keeps there is of all robots' requests",
                parameter.name
            ));
        }
    }
    for need in &interface.needs {
        found.push(format!(
            "it calls {}, which each robot serves itself",
            need.name
        ));
    }
    // What cannot be read here was refused before.
    let registry =
        Registry::of_definitions(ros, &interface.definitions).unwrap_or_else(|_| Registry::of(ros));
    let shown = shown(interface);
    for service in &shown.services {
        let of = registry.service(&service.type_name);
        let answers_nothing = of.is_ok_and(|of| says_nothing(&of.response));
        if answers_nothing || plain(&service.type_name) == SWITCH {
            found.push(format!(
                "it serves {} ({}), whose answer tells nothing: it changes what the node keeps, for all robots",
                service.name, service.type_name
            ));
        }
    }
    if found.is_empty() && shown.services.is_empty() && shown.actions.is_empty() {
        found.push("it has neither a service nor an action".to_owned());
    }
    match found.is_empty() {
        true => Ok(()),
        false => Err(Unshareable(found)),
    }
}

/// Whether a message has nothing but messages that say nothing, such as std_msgs/Empty.
fn says_nothing(of: &MessageType) -> bool {
    let mut fields = of.fields().iter();
    fields.all(|field| matches!(&field.base, Base::Message(inner) if says_nothing(inner)))
}

/// What a deployer should know of an interface that is shared.
pub fn remarks(interface: &Interface) -> Vec<String> {
    let lifecycles = interface.lifecycle.iter();
    let remark = |node: &String| {
        format!(
            "{node} has a lifecycle: its servants keep it active, and robots that share it can neither ask for its state nor change it; a launch file of a robot that waits for that waits in vain"
        )
    };
    lifecycles.map(remark).collect()
}

/// What each robot sees of an interface that is shared.
pub fn shown(interface: &Interface) -> Interface {
    let administers = |name: &str| ADMINISTER.iter().any(|package| name.starts_with(package));
    let services = interface.services.iter();
    Interface {
        topics: Vec::new(),
        parameters: Vec::new(),
        services: services
            .filter(|service| !administers(&service.type_name))
            .cloned()
            .collect(),
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

    fn found(change: impl FnOnce(&mut Value)) -> Vec<String> {
        let outcome = check(RosVersion::One, &interface(change));
        outcome.err().map_or(Vec::new(), |refused| refused.0)
    }

    fn push(value: &mut Value, field: &str, item: Value) {
        value[field].as_array_mut().expect("a list").push(item);
    }

    #[test]
    fn services_are_shared_and_what_administers_the_node_is_not_shown() {
        let interface = interface(|_| {});
        assert_eq!(check(RosVersion::One, &interface), Ok(()));
        let shown = shown(&interface);
        let names: Vec<_> = shown.services.iter().map(|it| it.name.as_str()).collect();
        assert_eq!((names, shown.topics.len()), (vec!["/add"], 0));
    }

    #[test]
    fn what_one_robot_would_see_of_another_is_refused_with_what_was_found() {
        let topic = |name: &str, of: &str, direction: &str| {
            let latched = name == "/map";
            let topic =
                json!({ "name": name, "type": of, "direction": direction, "latched": latched });
            found(|it| push(it, "topics", topic)).join("; ")
        };
        for (name, of, direction, expected) in [
            (
                "/image",
                "sensor_msgs/Image",
                "input",
                "it subscribes to /image (sensor_msgs/Image)",
            ),
            (
                "/map",
                "nav_msgs/OccupancyGrid",
                "output",
                "it publishes, latched, /map (nav_msgs/OccupancyGrid): what it made",
            ),
            (
                "/found",
                "x_msgs/Found",
                "output",
                "it publishes /found (x_msgs/Found): what it makes",
            ),
            (
                "/tf",
                "tf2_msgs/TFMessage",
                "input",
                "it subscribes to /tf (tf2_msgs/TFMessage): transforms of all robots",
            ),
            (
                "/tf_static",
                "tf/tfMessage",
                "output",
                "it publishes /tf_static (tf/tfMessage): its transforms",
            ),
            (
                "/clock",
                "rosgraph_msgs/Clock",
                "input",
                "it subscribes to /clock",
            ),
        ] {
            let found = topic(name, of, direction);
            assert!(found.starts_with(expected), "{found}");
        }
        let calls = found(|it| it["needs"] = json!([{ "name": "/get_map" }]));
        assert_eq!(calls, ["it calls /get_map, which each robot serves itself"]);
    }

    #[test]
    fn a_node_that_keeps_something_in_parameters_is_refused() {
        for (name, node, refused) in [
            ("/seen", "/adder", true),
            ("/finder/last", "/finder", true),
            // As dynamic_reconfigure has it do.
            ("/adder/gain", "/adder", false),
        ] {
            let service = json!({
                "name": "/adder/set_parameters", "type": "dynamic_reconfigure/Reconfigure", "node": "/adder",
            });
            let found = found(|it| {
                push(it, "services", service);
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
            let found = found(|it| push(it, "services", service)).join("; ");
            assert!(found.starts_with("it serves /reset"), "{of}: {found}");
        }
    }

    #[test]
    fn what_answers_nobody_is_refused() {
        let found = found(|it| it["services"] = json!([]));
        assert_eq!(found, ["it has neither a service nor an action"]);
    }

    /// One of ROS 2 that can be shared.
    fn of_two(change: impl FnOnce(&mut Value)) -> Interface {
        let topic =
            |name: &str, of: &str| json!({ "name": name, "type": of, "direction": "output" });
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

    fn found_of_two(change: impl FnOnce(&mut Value)) -> Vec<String> {
        let outcome = check(RosVersion::Two, &of_two(change));
        outcome.err().map_or(Vec::new(), |refused| refused.0)
    }

    #[test]
    fn what_every_node_of_ros_2_has_is_not_shown() {
        let interface = of_two(|_| {});
        assert_eq!(check(RosVersion::Two, &interface), Ok(()));
        let shown = shown(&interface);
        let names: Vec<_> = shown.services.iter().map(|it| it.name.as_str()).collect();
        assert_eq!(names, ["/add"]);
        assert!(shown.topics.is_empty() && shown.parameters.is_empty());
        assert_eq!(shown.actions.len(), 1);
        // A robot's launch file may want to change it.
        let remarks = remarks(&interface);
        assert!(remarks.len() == 1 && remarks[0].starts_with("/adder has a lifecycle"));
    }

    #[test]
    fn what_robots_of_ros_2_cannot_share_is_refused() {
        for (name, of, direction, expected) in [
            (
                "/image",
                "sensor_msgs/msg/Image",
                "input",
                "it subscribes to /image (sensor_msgs/msg/Image)",
            ),
            (
                "/tf",
                "tf2_msgs/msg/TFMessage",
                "input",
                "it subscribes to /tf (tf2_msgs/msg/TFMessage): transforms of all",
            ),
            (
                "/clock",
                "rosgraph_msgs/msg/Clock",
                "input",
                "it subscribes to /clock",
            ),
        ] {
            let topic = json!({ "name": name, "type": of, "direction": direction });
            let found = found_of_two(|it| push(it, "topics", topic)).join("; ");
            assert!(found.starts_with(expected), "{found}");
        }
        for of in [
            "x_msgs/srv/Reset",
            "x_msgs/srv/Clear",
            "std_srvs/srv/SetBool",
        ] {
            let service = json!({ "name": "/reset", "type": of });
            let found = found_of_two(|it| push(it, "services", service)).join("; ");
            assert!(found.starts_with("it serves /reset"), "{of}: {found}");
        }
        let calls = found_of_two(|it| it["needs"] = json!([{ "name": "/dock" }]));
        assert_eq!(calls, ["it calls /dock, which each robot serves itself"]);
    }
}
