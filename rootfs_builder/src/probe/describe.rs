//! Description of the interface from observations: types are queried and compared with their definitions.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use package::interface::qos::{from_bus, to_bus};
use package::interface::{Action, Direction, Interface, Need, Parameter, Qos, Service, Topic};
use package::names;
use ros::bus::{Bus, BusError, Digest, Graph, NodeEntities, ParamValue, RosVersion, ServiceType, WireFormat, WireType};
use ros::plumbing;
use ros::ros2::lifecycle::LifecycleNode;
use ros::schema::{Base, MessageType, Registry};

use super::{ProbeError, ProbeOptions, ProbeResult, inputs, outputs, settle};

/// Time limit, in the node's own time, for reporting a type; what exceeds it is left out with a warning.
const ANSWER: Duration = Duration::from_secs(5);

/// Observations of a package.
pub(super) struct ObservedPackage<'a> {
    /// Outputs with a latching publisher.
    pub(super) latched: BTreeSet<String>,
    /// Inputs registered before anything was subscribed to.
    pub(super) eager: BTreeSet<String>,
    /// Graph at the end.
    pub(super) graph: Arc<Graph>,
    /// Options: the observing node, and time limits.
    pub(super) options: &'a ProbeOptions,
    /// Services that were looked up and provided by the probe, with the nodes that did.
    pub(super) asked: BTreeMap<String, BTreeSet<String>>,
    /// Inputs of any type.
    pub(super) any: BTreeSet<String>,
}

/// Queries types and compares them with the definitions.
pub(super) async fn describe(
    bus: &dyn Bus,
    registry: &Registry,
    definitions: &BTreeMap<String, String>,
    seen: &ObservedPackage<'_>,
) -> Result<ProbeResult, ProbeError> {
    let mut found = ProbeResult::default();
    let mut texts = DefinitionTexts { definitions, used: BTreeMap::new() };
    let graph = &*seen.graph;
    let mut topics = Vec::new();
    for (direction, names) in [
        (Direction::Input, inputs(graph, &seen.options.own_name)),
        (Direction::Output, outputs(graph, &seen.options.own_name)),
    ] {
        for name in names {
            match ask_type(&name, seen, bus.topic_type(&name)).await {
                Ok(wire) => {
                    let wire = if follows_any(seen, &name, direction, &wire) { WireType::any() } else { wire };
                    topics.push(describe_topic(registry, seen, name, direction, wire, &mut texts)?);
                }
                Err(problem) => found.warnings.push(problem),
            }
        }
    }
    let actions = extract_actions(&mut topics, seen, registry, &mut texts)?;
    topics
        .sort_by(|a, b| (&a.name, a.direction == Direction::Output).cmp(&(&b.name, b.direction == Direction::Output)));
    let mut services = Vec::new();
    for (name, node) in graph.services.iter().filter(|(_, node)| **node != seen.options.own_name) {
        if plumbing::is_builtin_service(seen.options.ros, graph, name) {
            continue;
        }
        match ask_type(name, seen, bus.service_type(name)).await {
            Ok(wire) => {
                let service = registry
                    .service(&wire.name)
                    .map_err(|problem| ProbeError::NoDefinition { what: format!("service {name}"), problem })?;
                let defined = ServiceType::from_service(&service);
                if !wire.is_compatible_with(&defined) {
                    let (announced, defined) = differing_digests(&wire, &defined);
                    return Err(mismatch(&format!("service {name}"), &wire.name, &announced, &defined));
                }
                texts.service(&wire.name, [&service.request, &service.response]);
                services.push(Service {
                    name: name.clone(),
                    type_name: wire.name,
                    // ROS 2 nodes may report only the digests of request and response.
                    md5: service.md5.clone(),
                    node: node.clone(),
                });
            }
            Err(problem) => found.warnings.push(problem),
        }
    }
    let mut parameters = shared_parameters(bus, graph, &seen.options.own_name).await;
    own_parameters(bus, seen, &mut parameters, &mut found.warnings).await;
    let lifecycle = LifecycleNode::all(graph).into_iter();
    found.interface = Interface {
        topics,
        services,
        actions,
        parameters,
        needs: all_needs(seen),
        lifecycle: lifecycle.filter(|node| *node != seen.options.own_name).collect(),
        late: Vec::new(),
        requests: None,
        definitions: texts.used,
    };
    for need in &found.interface.needs {
        let (name, nodes) = (&need.name, need.nodes.join(", "));
        found.warnings.push(format!("{nodes} needs {name}, which no node serves here: it must be served on the robot"));
    }
    Ok(found)
}

/// Returns the services that were looked up and do not exist yet.
pub(super) fn missing_needs(graph: &Graph, own_name: &str) -> Vec<Need> {
    let sought = graph.sought.iter();
    let missing = sought.filter(|(name, _)| !graph.services.contains_key(*name));
    let needs = missing.map(|(name, nodes)| Need {
        name: name.clone(),
        nodes: nodes.iter().filter(|node| *node != own_name).cloned().collect(),
    });
    needs.filter(|need| !need.nodes.is_empty()).collect()
}

/// Returns all needs: missing services, actions without a server (ROS 2, where no topics reveal them), and services
/// provided by the probe.
fn all_needs(seen: &ObservedPackage<'_>) -> Vec<Need> {
    let own_name = &seen.options.own_name;
    let mut needs = missing_needs(&seen.graph, own_name);
    let actions = seen.graph.actions.iter();
    let others = |nodes: &[String]| -> Vec<String> {
        let nodes = nodes.iter().filter(|node| *node != own_name);
        nodes.cloned().collect()
    };
    let sought = actions.filter(|(_, ends)| ends.topics.is_empty() && others(&ends.servers).is_empty());
    let sought = sought.map(|(name, ends)| Need { name: name.clone(), nodes: others(&ends.clients) });
    needs.extend(sought.filter(|need| !need.nodes.is_empty()));
    for (name, nodes) in &seen.asked {
        let server = seen.graph.services.get(name);
        if server.is_some_and(|node| *node != seen.options.own_name) {
            continue;
        }
        match needs.iter_mut().find(|need| need.name == *name) {
            Some(need) => {
                let new = nodes.iter().filter(|node| !need.nodes.contains(node));
                let new: Vec<String> = new.cloned().collect();
                need.nodes.extend(new);
            }
            None => needs.push(Need { name: name.clone(), nodes: nodes.iter().cloned().collect() }),
        }
    }
    needs.sort_by(|a, b| a.name.cmp(&b.name));
    needs
}

/// Returns whether an output has its type only because an input of any type was given a message of that type.
fn follows_any(seen: &ObservedPackage<'_>, name: &str, direction: Direction, wire: &WireType) -> bool {
    let fed = |topic: &String| {
        let ends = (seen.graph.topics.get(topic), seen.graph.topics.get(name));
        let (Some(input), Some(output)) = ends else {
            return false;
        };
        output.publishers.iter().any(|node| *node != seen.options.own_name && input.subscribers.contains(node))
    };
    match direction {
        Direction::Input => seen.any.contains(name),
        Direction::Output => wire.name == super::feed::ANY && seen.any.iter().any(fed),
    }
}

async fn ask_type<T>(
    name: &str,
    seen: &ObservedPackage<'_>,
    answer: impl Future<Output = Result<T, BusError>>,
) -> Result<T, String> {
    match settle::await_answer(ANSWER, seen.options, answer).await {
        Some(Ok(value)) => Ok(value),
        Some(Err(error)) => Err(format!("cannot get the type of {name}: {error}")),
        None => Err(format!("no response about the type of {name} within {ANSWER:?}")),
    }
}

fn describe_topic(
    registry: &Registry,
    seen: &ObservedPackage<'_>,
    name: String,
    direction: Direction,
    wire: WireType,
    texts: &mut DefinitionTexts<'_>,
) -> Result<Topic, ProbeError> {
    // Some nodes accept any type; there is nothing to compare.
    let untold = wire.format == WireFormat::Ros1 && wire.digest.is_any();
    let mut md5 = wire.digest.to_string();
    if wire.name != "*" && !untold {
        let message = match registry.message(&wire.name) {
            Ok(message) => message,
            // The image has no definition, but the publisher sent its own.
            Err(_) if !wire.definition.is_empty() => {
                let added = registry.insert_full_text(&wire.name, &wire.definition);
                added
                    .and_then(|()| registry.message(&wire.name))
                    .map_err(|problem| ProbeError::NoDefinition { what: format!("topic {name}"), problem })?
            }
            Err(problem) => {
                return Err(ProbeError::NoDefinition { what: format!("topic {name}"), problem });
            }
        };
        compare_digests(&format!("topic {name}"), &wire.name, wire.digest.as_str(), message.md5())?;
        texts.message(&message);
        // ROS 2 nodes before Iron report no digests.
        md5 = message.digest().to_owned();
    }
    let ends = seen.graph.topics.get(&name);
    let nodes = match direction {
        Direction::Input => ends.map(|topic| &topic.subscribers),
        Direction::Output => ends.map(|topic| &topic.publishers),
    };
    let nodes: Vec<String> =
        nodes.into_iter().flatten().filter(|node| **node != seen.options.own_name).cloned().collect();
    let qos = combined_qos(&seen.graph, &name, direction, &nodes);
    let keeps = qos.is_some_and(|qos| to_bus(&qos, 1).is_latching());
    Ok(Topic {
        latched: direction == Direction::Output && (keeps || seen.latched.contains(&name)),
        qos,
        lazy: direction == Direction::Input && !seen.eager.contains(&name),
        type_name: wire.name,
        md5,
        direction,
        nodes,
        name,
    })
}

/// Returns the QoS that is compatible with all of these nodes, if known.
fn combined_qos(graph: &Graph, topic: &str, direction: Direction, nodes: &[String]) -> Option<Qos> {
    let ends = nodes.iter().filter_map(|node| {
        let NodeEntities { publishers, subscribers, .. } = graph.ends.get(node)?;
        let ends = match direction {
            Direction::Output => publishers,
            Direction::Input => subscribers,
        };
        ends.get(topic).map(|(_, qos)| from_bus(qos))
    });
    ends.reduce(|all, one| match direction {
        Direction::Output => all.common_offer(one),
        Direction::Input => all.common_request(one),
    })
}

/// Returns the first pair of digests that differ, of those that both report.
fn differing_digests(announced: &ServiceType, defined: &ServiceType) -> (String, String) {
    let parts = [
        (&announced.digest, &defined.digest),
        (&announced.request, &defined.request),
        (&announced.response, &defined.response),
    ];
    let pair = parts.into_iter().find(|(one, other)| !one.is_compatible_with(other));
    let (one, other) = pair.unwrap_or(parts[0]);
    (Digest::to_string(one), Digest::to_string(other))
}

fn compare_digests(what: &str, type_name: &str, announced: &str, defined: &str) -> Result<(), ProbeError> {
    if announced == "*" || announced == defined {
        return Ok(());
    }
    Err(mismatch(what, type_name, announced, defined))
}

fn mismatch(what: &str, type_name: &str, announced: &str, defined: &str) -> ProbeError {
    ProbeError::Mismatch {
        what: what.to_owned(),
        type_name: type_name.to_owned(),
        announced: announced.to_owned(),
        defined: defined.to_owned(),
    }
}

/// Returns the actions provided by the package, and removes their topics.
fn extract_actions(
    topics: &mut Vec<Topic>,
    seen: &ObservedPackage<'_>,
    registry: &Registry,
    texts: &mut DefinitionTexts<'_>,
) -> Result<Vec<Action>, ProbeError> {
    let mut actions = Vec::new();
    for (name, ends) in &seen.graph.actions {
        let mut servers = ends.servers.iter().filter(|node| **node != seen.options.own_name);
        let Some(node) = servers.next().filter(|_| ends.type_name != "*") else {
            continue;
        };
        if let Ok(action) = registry.action(&ends.type_name) {
            let goal = &action.action_goal;
            let of_goals =
                topics.iter().filter(|topic| ends.topics.contains(&topic.name) && topic.type_name == goal.name());
            for topic in of_goals {
                compare_digests(&format!("action {name}"), &topic.type_name, &topic.md5, goal.md5())?;
            }
            texts.action(&ends.type_name, [&action.goal, &action.result, &action.feedback]);
        }
        // In both directions: a server may also be its own client (move_base is).
        topics.retain(|topic| !ends.topics.contains(&topic.name));
        actions.push(Action { name: name.clone(), type_name: ends.type_name.clone(), node: node.clone() });
    }
    Ok(actions)
}

async fn shared_parameters(bus: &dyn Bus, graph: &Graph, own: &str) -> Vec<Parameter> {
    let mut parameters = Vec::new();
    for (name, uses) in &graph.parameters {
        let others = |nodes: &[String]| -> Vec<String> { nodes.iter().filter(|node| *node != own).cloned().collect() };
        let (read_by, written_by) = (others(&uses.read_by), others(&uses.written_by));
        if plumbing::is_builtin_parameter(name) || (read_by.is_empty() && written_by.is_empty()) {
            continue;
        }
        let value = bus.parameter(name).await.ok().map(|value| to_json(&value));
        parameters.push(Parameter { name: name.clone(), value, read_by, written_by, ..Parameter::default() });
    }
    parameters
}

/// Adds the nodes' own parameters with their descriptors.
async fn own_parameters(
    bus: &dyn Bus,
    seen: &ObservedPackage<'_>,
    all: &mut Vec<Parameter>,
    warnings: &mut Vec<String>,
) {
    let (graph, own_name) = (&*seen.graph, &seen.options.own_name);
    if seen.options.ros == RosVersion::One {
        return;
    }
    let nodes = graph.nodes.keys().filter(|node| {
        let list = graph.services.get(&format!("{node}/list_parameters"));
        list == Some(*node) && *node != own_name
    });
    for node in nodes {
        match settle::await_answer(ANSWER, seen.options, node_parameters(bus, node)).await {
            Some(Ok(parameters)) => all.extend(parameters),
            Some(Err(error)) => {
                warnings.push(format!("cannot get the parameters of {node}: {error}"));
            }
            None => warnings.push(format!("no response about the parameters of {node} within {ANSWER:?}")),
        }
    }
}

async fn node_parameters(bus: &dyn Bus, node: &str) -> Result<Vec<Parameter>, BusError> {
    let parameters = bus.node_parameters()?;
    let mut names = parameters.list(node, &[], 0).await?.names;
    names.retain(|name| !plumbing::is_builtin_parameter(name));
    names.sort();
    let descriptions = if names.is_empty() {
        return Ok(Vec::new());
    } else {
        parameters.describe(node, &names).await?
    };
    let values = parameters.get(node, &names).await?;
    let told = names.into_iter().zip(descriptions).zip(values);
    let parameter = |((name, description), value)| Parameter {
        name: format!("{node}/{name}"),
        node: node.to_owned(),
        value: Option::map(value, |value| to_json(&value)),
        descriptor: Option::map(description, Into::into),
        ..Parameter::default()
    };
    Ok(told.map(parameter).collect())
}

fn to_json(value: &ParamValue) -> serde_json::Value {
    serde_json::to_value(value).unwrap_or(serde_json::Value::Null)
}

/// Collects the definition texts that are used, with all that they refer to.
struct DefinitionTexts<'a> {
    definitions: &'a BTreeMap<String, String>,
    used: BTreeMap<String, String>,
}

impl DefinitionTexts<'_> {
    fn message(&mut self, message: &Arc<MessageType>) {
        let key = names::definition_key(message.name(), "msg");
        // Requests, goals and the like have no text of their own; it is part of the service or action.
        let text = self.definitions.get(&key).cloned().unwrap_or_else(|| message.text().to_owned());
        if self.used.insert(key, text).is_none() {
            self.fields(message);
        }
    }

    fn fields(&mut self, message: &Arc<MessageType>) {
        for field in message.fields() {
            if let Base::Message(inner) = &field.base {
                self.message(inner);
            }
        }
    }

    fn service(&mut self, name: &str, halves: [&Arc<MessageType>; 2]) {
        self.copy(name, "srv");
        halves.into_iter().for_each(|half| self.fields(half));
    }

    fn action(&mut self, name: &str, parts: [&Arc<MessageType>; 3]) {
        self.copy(name, "action");
        parts.into_iter().for_each(|part| self.fields(part));
    }

    fn copy(&mut self, name: &str, kind: &str) {
        let key = names::definition_key(name, kind);
        if let Some(text) = self.definitions.get(&key) {
            self.used.insert(key, text.clone());
        }
    }
}
