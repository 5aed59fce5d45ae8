//! What of an interface robots can share: services and actions, whose answers go to who asked. What a topic carries is every
//! robot's, so an interface that has any is refused; so is one that lets a robot change what the nodes keep.
//!
//! | what a package has | shared |
//! |---|---|
//! | a service, an action | shown to each robot |
//! | logs, diagnostics, parameters of dynamic_reconfigure, bonds (topics, by type) | not shown; nobody outside the servant gets them |
//! | any other topic, in or out (tf, the clock and latched ones too) | refused |
//! | a node that writes parameters, unless dynamic_reconfigure has it do so | refused: it keeps something |
//! | `set_parameters`, loggers, nodelets (services, by type) | not shown: they change the node for all |
//! | a service whose answer says nothing (`std_srvs/Empty`), `std_srvs/SetBool` | refused: it can only be there for what the node keeps |
//! | a service that it looks for on its robot | refused: which robot's would that be |

use std::fmt;

use package::interface::{Direction, Interface};
use ros::schema::Registry;

/// Types of topics that no robot needs.
const UNNEEDED: [&str; 6] = [
    "rosgraph_msgs/Log",
    "rosgraph_msgs/TopicStatistics",
    "diagnostic_msgs/DiagnosticArray",
    "dynamic_reconfigure/Config",
    "dynamic_reconfigure/ConfigDescription",
    "bond/Status",
];

/// Packages of services by which nodes are administered.
const ADMINISTER: [&str; 4] = [
    "dynamic_reconfigure/",
    "roscpp/",
    "nodelet/",
    "topic_tools/",
];

/// Transforms.
const TRANSFORMS: [&str; 2] = ["tf2_msgs/TFMessage", "tf/tfMessage"];

/// Who serves this writes its own parameters when it starts.
const RECONFIGURE: &str = "dynamic_reconfigure/Reconfigure";

/// A service of this type turns something on or off in the node.
const SWITCH: &str = "std_srvs/SetBool";

/// Why an interface cannot be shared: each thing that was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unshareable(pub Vec<String>);

impl fmt::Display for Unshareable {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "robots cannot share it: {}", self.0.join("; "))
    }
}

impl std::error::Error for Unshareable {}

/// Refuses an interface that robots cannot share.
pub fn check(interface: &Interface) -> Result<(), Unshareable> {
    let mut found = Vec::new();
    let topics = interface.topics.iter();
    for topic in topics.filter(|topic| !UNNEEDED.contains(&&*topic.type_name)) {
        let transforms = TRANSFORMS.contains(&&*topic.type_name);
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
    let registry = Registry::from_definitions(&interface.definitions).unwrap_or_default();
    let shown = shown(interface);
    for service in &shown.services {
        let of = registry.service(&service.type_name);
        let says_nothing = of.is_ok_and(|of| of.response.fields().is_empty());
        if says_nothing || service.type_name == SWITCH {
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
        let outcome = check(&interface(change));
        outcome.err().map_or(Vec::new(), |refused| refused.0)
    }

    fn push(value: &mut Value, field: &str, item: Value) {
        value[field].as_array_mut().expect("a list").push(item);
    }

    #[test]
    fn services_are_shared_and_what_administers_the_node_is_not_shown() {
        let interface = interface(|_| {});
        assert_eq!(check(&interface), Ok(()));
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
}
