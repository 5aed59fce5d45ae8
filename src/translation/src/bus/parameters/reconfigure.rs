//! dynamic_reconfigure: parameters of running nodes of ROS 1, with their ranges
//! (<http://wiki.ros.org/dynamic_reconfigure>).
//!
//! A server at `/see` describes its parameters on the latched topic `/see/parameter_descriptions`, changes them by the
//! service `/see/set_parameters` and writes the values that it has chosen to the Master. A node may have several, below
//! its name: what the one at `/see/filter` calls `gain` is the node's parameter `filter.gain`.

mod messages;

use std::collections::BTreeMap;
use std::time::Duration;

use ros::bus::parameter_names::spell_in_ros2;
use ros::bus::{
    Bus, BusError, DoubleRange, Graph, IntegerRange, ParamValue, ParameterDescription, ParameterKind, QosProfile,
    ServiceType, WireType,
};
use tokio::time::timeout;

use super::names::strip_parent;
pub(super) use messages::{Config, ConfigDescription, ConfigKind, DescribedParameter, message, service};

/// Time limit for a node to change parameters; it does so between other work.
const PATIENCE: Duration = Duration::from_secs(10);
/// Time limit for a description, which is sent as soon as the node is connected.
const DESCRIPTION_TIMEOUT: Duration = Duration::from_secs(3);
/// Maximum number of servers of a node that are asked.
const MAX_SERVERS: usize = 16;

/// Ends of the names of a server's service and topics.
pub(super) const SERVICE: &str = "/set_parameters";
pub(super) const DESCRIPTIONS: &str = "/parameter_descriptions";
pub(super) const UPDATES: &str = "/parameter_updates";
/// Types of the topics.
pub(super) const DESCRIPTION_TYPE: &str = "dynamic_reconfigure/ConfigDescription";
pub(super) const CONFIG_TYPE: &str = "dynamic_reconfigure/Config";

/// A server of a node, and its parameters.
#[derive(Debug)]
pub(super) struct ReconfigureServer {
    /// Namespace of the server.
    namespace: String,
    /// Prefix of the parameters in the node: `filter.`, or nothing.
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
                    prefix: strip_parent(&namespace, node)
                        .map_or(String::new(), |rest| format!("{}.", spell_in_ros2(rest))),
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
        let of = service()?;
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
    /// Returns the parameter of a node of ROS 2 that has this value; `None` if dynamic_reconfigure has none like it.
    pub(super) fn from_ros2(of: &ParameterDescription, value: &ParamValue) -> Option<Self> {
        let whole = |number: i64| number.clamp(i32::MIN.into(), i32::MAX.into()) as f64;
        let (kind, range) = match value {
            ParamValue::Bool(_) => (ConfigKind::Bool, None),
            ParamValue::String(_) => (ConfigKind::Text, None),
            ParamValue::Int(number) => {
                i32::try_from(*number).ok()?;
                (ConfigKind::Integer, of.integer_range.map(|range| (whole(range.from), whole(range.to))))
            }
            ParamValue::Double(_) => (ConfigKind::Double, of.double_range.map(|range| (range.from, range.to))),
            _ => return None,
        };
        // There is no other way to say that a number stays as it is.
        let range = match value {
            ParamValue::Int(number) if of.read_only => Some((whole(*number), whole(*number))),
            ParamValue::Double(number) if of.read_only => Some((*number, *number)),
            _ => range,
        };
        let read_only = if of.read_only { "read-only" } else { "" };
        let texts = [&*of.description, &*of.constraints, read_only].into_iter().filter(|text| !text.is_empty());
        Some(Self {
            kind,
            description: texts.collect::<Vec<_>>().join("; "),
            choices: String::new(),
            range: range.filter(|(from, to)| from <= to),
        })
    }

    /// Converts a value to the parameter's type where that is lossless, and checks its range: the server itself would
    /// silently choose the nearest value.
    pub(super) fn check(&self, value: &ParamValue) -> Result<ParamValue, ReconfigureRefusal> {
        let fitting = self.fit(value)?;
        match (as_number(&fitting), self.range) {
            (Some(number), Some((from, to))) if !(from..=to).contains(&number) => {
                Err(ReconfigureRefusal::Range { from, to })
            }
            _ => Ok(fitting),
        }
    }

    /// Converts a value, likewise, and returns the nearest one of the range, as a server does.
    pub(super) fn choose(&self, value: &ParamValue) -> Result<ParamValue, ReconfigureRefusal> {
        let range = self.range;
        Ok(match (self.fit(value)?, range) {
            (ParamValue::Int(number), Some((from, to))) => ParamValue::Int((number as f64).clamp(from, to) as i64),
            (ParamValue::Double(number), Some((from, to))) => ParamValue::Double(number.clamp(from, to)),
            (fitting, _) => fitting,
        })
    }

    fn fit(&self, value: &ParamValue) -> Result<ParamValue, ReconfigureRefusal> {
        Ok(match (self.kind, value) {
            (ConfigKind::Bool, ParamValue::Bool(_)) | (ConfigKind::Text, ParamValue::String(_)) => value.clone(),
            (ConfigKind::Integer, ParamValue::Int(number)) if i32::try_from(*number).is_ok() => value.clone(),
            (ConfigKind::Integer, ParamValue::Double(number)) if number.fract() == 0.0 && number.abs() < 2e9 => {
                ParamValue::Int(*number as i64)
            }
            (ConfigKind::Double, ParamValue::Double(_)) => value.clone(),
            (ConfigKind::Double, ParamValue::Int(number)) => ParamValue::Double(*number as f64),
            _ => return Err(ReconfigureRefusal::Kind(self.kind.name())),
        })
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

fn as_number(value: &ParamValue) -> Option<f64> {
    match value {
        ParamValue::Int(number) => Some(*number as f64),
        ParamValue::Double(number) => Some(*number),
        _ => None,
    }
}

/// Returns the namespaces of the servers of a node.
fn find_namespaces(graph: &Graph, node: &str) -> Vec<String> {
    let served = graph.services.iter().filter(|(_, server)| *server == node);
    let namespaces = served.filter_map(|(service, _)| service.strip_suffix(SERVICE));
    let described = namespaces.filter(|namespace| {
        let topic = graph.topics.get(&format!("{namespace}{DESCRIPTIONS}"));
        let is_below = *namespace == node || strip_parent(namespace, node).is_some();
        is_below && topic.is_some_and(|topic| topic.type_name == DESCRIPTION_TYPE)
    });
    described.map(str::to_owned).collect()
}

async fn read_description(bus: &dyn Bus, namespace: &str) -> Result<ConfigDescription, BusError> {
    let topic = format!("{namespace}{DESCRIPTIONS}");
    let of = WireType::from_message(&*message(DESCRIPTION_TYPE)?);
    let mut subscription = bus.subscribe(&topic, of, QosProfile::keep_last(1)).await?;
    let told = match timeout(DESCRIPTION_TIMEOUT, subscription.messages.recv()).await {
        Ok(Some(told)) => told,
        Ok(None) => return Err(BusError::Closed),
        Err(_) => return Err(BusError::Timeout { what: format!("topic {topic}"), after: DESCRIPTION_TIMEOUT }),
    };
    ConfigDescription::parse(&told.bytes).ok_or_else(|| BusError::Protocol {
        what: format!("topic {topic}"),
        reason: "the description is truncated or too long".to_owned(),
    })
}

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
    fn parameters_of_ros_2_have_the_ranges_and_texts_of_their_descriptors() {
        use ParamValue::{Bool, Double, Int, List, String};
        let of = ParameterDescription {
            description: "how much".into(),
            constraints: "even".into(),
            double_range: Some(DoubleRange { from: -1.0, to: 1.0, step: 0.5 }),
            integer_range: Some(IntegerRange { from: 0, to: 1 << 40, step: 2 }),
            ..ParameterDescription::default()
        };
        let described = |value| DescribedParameter::from_ros2(&of, &value).map(|it| (it.kind, it.range));
        assert_eq!(described(Double(0.5)), Some((ConfigKind::Double, Some((-1.0, 1.0)))));
        assert_eq!(described(Int(2)), Some((ConfigKind::Integer, Some((0.0, i32::MAX.into())))));
        assert_eq!(described(Bool(true)), Some((ConfigKind::Bool, None)));
        assert_eq!(described(String("x".into())), Some((ConfigKind::Text, None)));
        for value in [Int(1 << 31), List(vec![Int(1)]), ParamValue::Binary(vec![1])] {
            assert_eq!(described(value), None);
        }
        let fixed = ParameterDescription { read_only: true, ..of };
        let fixed = DescribedParameter::from_ros2(&fixed, &Int(7)).expect("it is one");
        assert_eq!((&*fixed.description, fixed.range), ("how much; even; read-only", Some((7.0, 7.0))));
        // As a server of ROS 1 does.
        assert_eq!(fixed.choose(&Int(9)), Ok(Int(7)));
        let gain = parameter(ConfigKind::Double, Some((-1.0, 1.0)));
        assert_eq!((gain.choose(&Double(5.0)), gain.choose(&Int(0))), (Ok(Double(1.0)), Ok(Double(0.0))));
        assert!(gain.choose(&Bool(true)).is_err());
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
