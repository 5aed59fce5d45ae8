//! dynamic_reconfigure: parameters of running nodes of ROS 1, with their ranges
//! (<http://wiki.ros.org/dynamic_reconfigure>).
//!
//! A server at `/see` describes its parameters on the latched topic `/see/parameter_descriptions`, changes them by the
//! service `/see/set_parameters` and writes the values that it has chosen to the Master. A node may have several, below
//! its name: what the one at `/see/filter` calls `gain` is the node's parameter `filter.gain`.

mod messages;

use std::collections::BTreeMap;
use std::time::Duration;

use ros::bus::{
    Bus, BusError, DoubleRange, Graph, IntegerRange, ParamValue, ParameterDescription, ParameterKind, QosProfile,
    ServiceType, WireType,
};
use tokio::time::timeout;

use super::names::{below, to_name};
use messages::ConfigDescription;
pub(super) use messages::{Config, ConfigKind, DescribedParameter};

/// Time limit for a node to change parameters; it does so between other work.
const PATIENCE: Duration = Duration::from_secs(10);
/// Time limit for a description, which is sent as soon as the node is connected.
const DESCRIBED: Duration = Duration::from_secs(3);
/// Maximum number of servers of a node that are asked.
const MAX_SERVERS: usize = 16;

const SERVICE: &str = "/set_parameters";
const DESCRIPTIONS: &str = "/parameter_descriptions";
const DESCRIPTION_TYPE: &str = "dynamic_reconfigure/ConfigDescription";

/// A server of a node, and its parameters.
#[derive(Debug)]
pub(super) struct ReconfigureServer {
    /// Namespace of the server.
    namespace: String,
    /// What the node's names of the parameters begin with: `filter.`, or nothing.
    prefix: String,
    parameters: BTreeMap<String, DescribedParameter>,
}

/// Reasons why a parameter does not take a value.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(super) enum ReconfigureRefusal {
    #[error("it is of the type {0}")]
    Kind(&'static str),
    #[error("it takes values from {from} to {to}")]
    Range { from: f64, to: f64 },
    #[error("it belongs to dynamic_reconfigure and cannot be deleted while the node runs")]
    Deleted,
    #[error("the node has set it to {0}")]
    Other(String),
    #[error("the node does not tell what it has set it to")]
    Untold,
}

impl ReconfigureServer {
    /// Returns the servers of a node, by the graph. One that does not describe its parameters is left out.
    pub(super) async fn find_all(bus: &dyn Bus, node: &str) -> Vec<ReconfigureServer> {
        let graph = bus.graph().borrow().clone();
        let mut servers = Vec::new();
        for namespace in find_namespaces(&graph, node).into_iter().take(MAX_SERVERS) {
            match read_description(bus, &namespace).await {
                Ok(description) => servers.push(ReconfigureServer {
                    prefix: below(&namespace, node).map_or(String::new(), |rest| format!("{}.", to_name(rest))),
                    namespace,
                    parameters: description.parameters,
                }),
                Err(error) => {
                    tracing::debug!(namespace, %error, "a dynamic_reconfigure server does not describe its parameters");
                }
            }
        }
        servers
    }

    /// Returns the server's name of the node's parameter, and its description.
    pub(super) fn find<'n>(&self, name: &'n str) -> Option<(&'n str, &DescribedParameter)> {
        let own = name.strip_prefix(&*self.prefix)?;
        Some((own, self.parameters.get(own)?))
    }

    /// Changes parameters, all at once. Returns the values that the server has chosen.
    pub(super) async fn change(&self, bus: &dyn Bus, changes: &Config) -> Result<Config, BusError> {
        let of = messages::service()?;
        let service = format!("{}{SERVICE}", self.namespace);
        let digest = ServiceType::from_service(&of).digest;
        let response = bus.call_typed(&service, &digest, changes.serialize(), PATIENCE).await?;
        Config::parse(&response).ok_or_else(|| BusError::Protocol {
            what: format!("service {service}"),
            reason: "its answer is truncated or too long".to_owned(),
        })
    }
}

impl DescribedParameter {
    /// Converts a value to the parameter's type where that is lossless, and checks its range: the server itself would
    /// silently choose the nearest value.
    pub(super) fn check(&self, value: &ParamValue) -> Result<ParamValue, ReconfigureRefusal> {
        let fitting = match (self.kind, value) {
            (ConfigKind::Bool, ParamValue::Bool(_)) | (ConfigKind::Text, ParamValue::String(_)) => value.clone(),
            (ConfigKind::Integer, ParamValue::Int(number)) if i32::try_from(*number).is_ok() => value.clone(),
            (ConfigKind::Integer, ParamValue::Double(number)) if number.fract() == 0.0 && number.abs() < 2e9 => {
                ParamValue::Int(*number as i64)
            }
            (ConfigKind::Double, ParamValue::Double(_)) => value.clone(),
            (ConfigKind::Double, ParamValue::Int(number)) => ParamValue::Double(*number as f64),
            _ => return Err(ReconfigureRefusal::Kind(self.kind.name())),
        };
        let number = match fitting {
            ParamValue::Int(number) => number as f64,
            ParamValue::Double(number) => number,
            _ => return Ok(fitting),
        };
        match self.range {
            Some((from, to)) if !(from..=to).contains(&number) => Err(ReconfigureRefusal::Range { from, to }),
            _ => Ok(fitting),
        }
    }

    /// Returns the description as ROS 2 has it.
    pub(super) fn describe(&self, name: &str) -> ParameterDescription {
        let kind = match self.kind {
            ConfigKind::Bool => ParameterKind::Bool,
            ConfigKind::Integer => ParameterKind::Integer,
            ConfigKind::Double => ParameterKind::Double,
            ConfigKind::Text => ParameterKind::String,
        };
        let range = |of| self.range.filter(|_| self.kind == of);
        ParameterDescription {
            name: name.to_owned(),
            kind,
            description: self.description.clone(),
            constraints: self.choices.clone(),
            double_range: range(ConfigKind::Double).map(|(from, to)| DoubleRange { from, to, step: 0.0 }),
            integer_range: range(ConfigKind::Integer).map(|(from, to)| IntegerRange {
                from: from as i64,
                to: to as i64,
                step: 1,
            }),
            ..ParameterDescription::default()
        }
    }
}

/// Returns the namespaces of the servers of a node.
fn find_namespaces(graph: &Graph, node: &str) -> Vec<String> {
    let served = graph.services.iter().filter(|(_, server)| *server == node);
    let namespaces = served.filter_map(|(service, _)| service.strip_suffix(SERVICE));
    let described = namespaces.filter(|namespace| {
        let topic = graph.topics.get(&format!("{namespace}{DESCRIPTIONS}"));
        let is_below = *namespace == node || below(namespace, node).is_some();
        is_below && topic.is_some_and(|topic| topic.type_name == DESCRIPTION_TYPE)
    });
    described.map(str::to_owned).collect()
}

async fn read_description(bus: &dyn Bus, namespace: &str) -> Result<ConfigDescription, BusError> {
    let topic = format!("{namespace}{DESCRIPTIONS}");
    let of = WireType::from_message(&*messages::message(DESCRIPTION_TYPE)?);
    let mut subscription = bus.subscribe(&topic, of, QosProfile::keep_last(1)).await?;
    let message = match timeout(DESCRIBED, subscription.messages.recv()).await {
        Ok(Some(message)) => message,
        Ok(None) => return Err(BusError::Closed),
        Err(_) => return Err(BusError::Timeout { what: format!("topic {topic}"), after: DESCRIBED }),
    };
    ConfigDescription::parse(&message.bytes).ok_or_else(|| BusError::Protocol {
        what: format!("topic {topic}"),
        reason: "the description is truncated or too long".to_owned(),
    })
}

#[cfg(test)]
pub(super) use messages::{message as message_type, service as service_type};

#[cfg(test)]
mod tests {
    use super::*;

    fn parameter(kind: ConfigKind, range: Option<(f64, f64)>) -> DescribedParameter {
        DescribedParameter { kind, description: "how much".into(), choices: "a or b".into(), range }
    }

    #[test]
    fn values_are_checked_before_the_server_would_change_them() {
        use ParamValue::{Bool, Double, Int, String};
        let count = parameter(ConfigKind::Integer, Some((0.0, 10.0)));
        let gain = parameter(ConfigKind::Double, Some((-1.0, 1.0)));
        let (flag, name) = (parameter(ConfigKind::Bool, None), parameter(ConfigKind::Text, None));
        for (parameter, value, taken) in [
            (&count, Int(10), Ok(Int(10))),
            (&count, Double(3.0), Ok(Int(3))),
            (&count, Int(11), Err("it takes values from 0 to 10")),
            (&count, Double(0.5), Err("it is of the type int")),
            (&count, Int(1 << 40), Err("it is of the type int")),
            (&gain, Int(1), Ok(Double(1.0))),
            (&gain, Double(f64::NAN), Err("it takes values from -1 to 1")),
            (&gain, String("x".into()), Err("it is of the type double")),
            (&flag, Bool(true), Ok(Bool(true))),
            (&flag, Int(1), Err("it is of the type bool")),
            (&name, String("x".into()), Ok(String("x".into()))),
        ] {
            let checked = parameter.check(&value).map_err(|refusal| refusal.to_string());
            assert_eq!(checked, taken.map_err(str::to_owned), "{value:?}");
        }
    }

    #[test]
    fn descriptions_have_ranges_of_their_type() {
        let gain = parameter(ConfigKind::Double, Some((-1.0, 1.0))).describe("filter.gain");
        assert_eq!((&*gain.name, gain.kind), ("filter.gain", ParameterKind::Double));
        assert_eq!(gain.double_range, Some(DoubleRange { from: -1.0, to: 1.0, step: 0.0 }));
        assert_eq!((gain.integer_range, gain.read_only), (None, false));
        assert_eq!((&*gain.description, &*gain.constraints), ("how much", "a or b"));
        let count = parameter(ConfigKind::Integer, Some((0.0, 10.0))).describe("count");
        assert_eq!(count.integer_range, Some(IntegerRange { from: 0, to: 10, step: 1 }));
        assert_eq!(parameter(ConfigKind::Bool, None).describe("on").kind, ParameterKind::Bool);
    }

    #[test]
    fn servers_are_found_below_their_nodes_name() {
        let mut graph = Graph::default();
        for (service, node) in [("/see", "/see"), ("/see/filter", "/see"), ("/seen", "/seen"), ("/see/alien", "/x")] {
            graph.services.insert(format!("{service}{SERVICE}"), node.to_owned());
            let topic = ros::bus::TopicNodes { type_name: DESCRIPTION_TYPE.to_owned(), ..Default::default() };
            graph.topics.insert(format!("{service}{DESCRIPTIONS}"), topic);
        }
        graph.services.insert(format!("/see/other{SERVICE}"), "/see".to_owned());
        assert_eq!(find_namespaces(&graph, "/see"), ["/see/filter", "/see"]);
    }
}
