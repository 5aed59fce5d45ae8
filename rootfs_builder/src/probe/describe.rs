//! From what was seen to the interface: types asked for and compared with their definitions.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use package::interface::{Action, Direction, Interface, Need, Parameter, Qos, Service, Topic};
use package::names;
use ros::bus::{
    Bus, BusError, Digest, Graph, NodeEnds, ParamValue, RosVersion, ServiceType, WireFormat,
    WireType,
};
use ros::plumbing;
use ros::ros2::lifecycle::LifecycleNode;
use ros::schema::{Base, MessageType, Registry};

use super::{Found, ProbeError, ProbeOptions, inputs, outputs, settle};

/// What does not say its type in this time of its node's own is left out with a warning.
const ANSWER: Duration = Duration::from_secs(5);

/// What looking gave.
pub(super) struct Seen<'a> {
    /// Outputs whose publisher is latching.
    pub(super) latched: BTreeSet<String>,
    /// Inputs registered before anything was subscribed to.
    pub(super) eager: BTreeSet<String>,
    /// The graph at the end.
    pub(super) graph: Arc<Graph>,
    /// Who looked, and how long answers are waited for.
    pub(super) options: &'a ProbeOptions,
    /// Services that were looked for and lent, with the nodes that did.
    pub(super) asked: BTreeMap<String, BTreeSet<String>>,
    /// Inputs of any type.
    pub(super) any: BTreeSet<String>,
}

/// Asks and compares.
pub(super) async fn describe(
    bus: &dyn Bus,
    registry: &Registry,
    definitions: &BTreeMap<String, String>,
    seen: &Seen<'_>,
) -> Result<Found, ProbeError> {
    let mut found = Found::default();
    let mut texts = Texts {
        definitions,
        used: BTreeMap::new(),
    };
    let graph = &*seen.graph;
    let mut topics = Vec::new();
    for (direction, names) in [
        (Direction::Input, inputs(graph, &seen.options.own_name)),
        (Direction::Output, outputs(graph, &seen.options.own_name)),
    ] {
        for name in names {
            match ask(&name, seen, bus.topic_type(&name)).await {
                Ok(wire) => {
                    let wire = if follows_any(seen, &name, direction, &wire) {
                        WireType::any()
                    } else {
                        wire
                    };
                    topics.push(topic(registry, seen, name, direction, wire, &mut texts)?);
                }
                Err(problem) => found.warnings.push(problem),
            }
        }
    }
    let actions = take_actions(&mut topics, seen, registry, &mut texts)?;
    topics.sort_by(|a, b| {
        (&a.name, a.direction == Direction::Output)
            .cmp(&(&b.name, b.direction == Direction::Output))
    });
    let mut services = Vec::new();
    for (name, node) in graph
        .services
        .iter()
        .filter(|(_, node)| **node != seen.options.own_name)
    {
        if plumbing::service(seen.options.ros, graph, name) {
            continue;
        }
        match ask(name, seen, bus.service_type(name)).await {
            Ok(wire) => {
                let service =
                    registry
                        .service(&wire.name)
                        .map_err(|problem| ProbeError::NoDefinition {
                            what: format!("service {name}"),
                            problem,
                        })?;
                let defined = ServiceType::of(&service);
                if !wire.agrees(&defined) {
                    let (announced, defined) = differing(&wire, &defined);
                    return Err(mismatch(
                        &format!("service {name}"),
                        &wire.name,
                        &announced,
                        &defined,
                    ));
                }
                texts.service(&wire.name, [&service.request, &service.response]);
                services.push(Service {
                    name: name.clone(),
                    type_name: wire.name,
                    // Nodes of ROS 2 may tell those of its parts alone.
                    md5: service.md5.clone(),
                    node: node.clone(),
                });
            }
            Err(problem) => found.warnings.push(problem),
        }
    }
    let mut parameters = parameters(bus, graph, &seen.options.own_name).await;
    own_parameters(bus, seen, &mut parameters, &mut found.warnings).await;
    let lifecycle = LifecycleNode::all(graph).into_iter();
    found.interface = Interface {
        topics,
        services,
        actions,
        parameters,
        needs: needs_of(seen),
        lifecycle: lifecycle
            .filter(|node| *node != seen.options.own_name)
            .collect(),
        late: Vec::new(),
        requests: None,
        definitions: texts.used,
    };
    for need in &found.interface.needs {
        let (name, nodes) = (&need.name, need.nodes.join(", "));
        found.warnings.push(format!(
            "{nodes} looks for {name}, which nobody serves here: on a robot it is looked for there"
        ));
    }
    Ok(found)
}

/// Services that were looked for, and are not there yet.
pub(super) fn needs(graph: &Graph, own_name: &str) -> Vec<Need> {
    let sought = graph.sought.iter();
    let missing = sought.filter(|(name, _)| !graph.services.contains_key(*name));
    let needs = missing.map(|(name, nodes)| Need {
        name: name.clone(),
        nodes: nodes
            .iter()
            .filter(|node| *node != own_name)
            .cloned()
            .collect(),
    });
    needs.filter(|need| !need.nodes.is_empty()).collect()
}

/// Those, actions that goals would be sent to (ROS 2, where no topics tell of them), and the services that were lent.
fn needs_of(seen: &Seen<'_>) -> Vec<Need> {
    let own_name = &seen.options.own_name;
    let mut needs = needs(&seen.graph, own_name);
    let actions = seen.graph.actions.iter();
    let others = |nodes: &[String]| -> Vec<String> {
        let nodes = nodes.iter().filter(|node| *node != own_name);
        nodes.cloned().collect()
    };
    let sought =
        actions.filter(|(_, ends)| ends.topics.is_empty() && others(&ends.servers).is_empty());
    let sought = sought.map(|(name, ends)| Need {
        name: name.clone(),
        nodes: others(&ends.clients),
    });
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
            None => needs.push(Need {
                name: name.clone(),
                nodes: nodes.iter().cloned().collect(),
            }),
        }
    }
    needs.sort_by(|a, b| a.name.cmp(&b.name));
    needs
}

/// Whether an output has its type only because an input that takes any was given a message of that type.
fn follows_any(seen: &Seen<'_>, name: &str, direction: Direction, wire: &WireType) -> bool {
    let fed = |topic: &String| {
        let ends = (seen.graph.topics.get(topic), seen.graph.topics.get(name));
        let (Some(input), Some(output)) = ends else {
            return false;
        };
        output
            .publishers
            .iter()
            .any(|node| *node != seen.options.own_name && input.subscribers.contains(node))
    };
    match direction {
        Direction::Input => seen.any.contains(name),
        Direction::Output => wire.name == super::feed::ANY && seen.any.iter().any(fed),
    }
}

async fn ask<T>(
    name: &str,
    seen: &Seen<'_>,
    answer: impl Future<Output = Result<T, BusError>>,
) -> Result<T, String> {
    match settle::answered(ANSWER, seen.options, answer).await {
        Some(Ok(value)) => Ok(value),
        Some(Err(error)) => Err(format!("{name} does not tell its type: {error}")),
        None => Err(format!("{name} does not tell its type within {ANSWER:?}")),
    }
}

fn topic(
    registry: &Registry,
    seen: &Seen<'_>,
    name: String,
    direction: Direction,
    wire: WireType,
    texts: &mut Texts<'_>,
) -> Result<Topic, ProbeError> {
    // Some nodes take any type; nothing is to be compared.
    let untold = wire.format == WireFormat::Ros1 && wire.digest.is_any();
    let mut md5 = wire.digest.to_string();
    if wire.name != "*" && !untold {
        let message = match registry.message(&wire.name) {
            Ok(message) => message,
            // No definition in the image, but the publisher sent its own.
            Err(_) if !wire.definition.is_empty() => {
                let added = registry.insert_full_text(&wire.name, &wire.definition);
                added
                    .and_then(|()| registry.message(&wire.name))
                    .map_err(|problem| ProbeError::NoDefinition {
                        what: format!("topic {name}"),
                        problem,
                    })?
            }
            Err(problem) => {
                return Err(ProbeError::NoDefinition {
                    what: format!("topic {name}"),
                    problem,
                });
            }
        };
        compare(
            &format!("topic {name}"),
            &wire.name,
            wire.digest.as_str(),
            message.md5(),
        )?;
        texts.message(&message);
        // Before Iron nodes of ROS 2 tell no digests.
        md5 = message.digest().to_owned();
    }
    let ends = seen.graph.topics.get(&name);
    let nodes = match direction {
        Direction::Input => ends.map(|topic| &topic.subscribers),
        Direction::Output => ends.map(|topic| &topic.publishers),
    };
    let nodes: Vec<String> = nodes
        .into_iter()
        .flatten()
        .filter(|node| **node != seen.options.own_name)
        .cloned()
        .collect();
    let qos = qos(&seen.graph, &name, direction, &nodes);
    let keeps = qos.is_some_and(|qos| qos.on_bus(1).is_latching());
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

/// What these nodes offer or ask for together, where ends tell it.
fn qos(graph: &Graph, topic: &str, direction: Direction, nodes: &[String]) -> Option<Qos> {
    let ends = nodes.iter().filter_map(|node| {
        let NodeEnds {
            publishers,
            subscribers,
            ..
        } = graph.ends.get(node)?;
        let ends = match direction {
            Direction::Output => publishers,
            Direction::Input => subscribers,
        };
        ends.get(topic).map(|(_, qos)| Qos::from(qos))
    });
    ends.reduce(|all, one| match direction {
        Direction::Output => all.least(one),
        Direction::Input => all.most(one),
    })
}

/// Of what both tell: that in which they differ.
fn differing(announced: &ServiceType, defined: &ServiceType) -> (String, String) {
    let parts = [
        (&announced.digest, &defined.digest),
        (&announced.request, &defined.request),
        (&announced.response, &defined.response),
    ];
    let pair = parts.into_iter().find(|(one, other)| !one.agrees(other));
    let (one, other) = pair.unwrap_or(parts[0]);
    (Digest::to_string(one), Digest::to_string(other))
}

fn compare(what: &str, type_name: &str, announced: &str, defined: &str) -> Result<(), ProbeError> {
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

/// Actions that the package serves; topics that they are made of are no part of the interface.
fn take_actions(
    topics: &mut Vec<Topic>,
    seen: &Seen<'_>,
    registry: &Registry,
    texts: &mut Texts<'_>,
) -> Result<Vec<Action>, ProbeError> {
    let mut actions = Vec::new();
    for (name, ends) in &seen.graph.actions {
        let mut servers = ends
            .servers
            .iter()
            .filter(|node| **node != seen.options.own_name);
        let Some(node) = servers.next().filter(|_| ends.type_name != "*") else {
            continue;
        };
        if let Ok(action) = registry.action(&ends.type_name) {
            let goal = &action.action_goal;
            let of_goals = topics.iter().filter(|topic| {
                ends.topics.contains(&topic.name) && topic.type_name == goal.name()
            });
            for topic in of_goals {
                compare(
                    &format!("action {name}"),
                    &topic.type_name,
                    &topic.md5,
                    goal.md5(),
                )?;
            }
            texts.action(
                &ends.type_name,
                [&action.goal, &action.result, &action.feedback],
            );
        }
        // In either direction: a server may well be its own client (move_base is).
        topics.retain(|topic| !ends.topics.contains(&topic.name));
        actions.push(Action {
            name: name.clone(),
            type_name: ends.type_name.clone(),
            node: node.clone(),
        });
    }
    Ok(actions)
}

async fn parameters(bus: &dyn Bus, graph: &Graph, own: &str) -> Vec<Parameter> {
    let mut parameters = Vec::new();
    for (name, uses) in &graph.parameters {
        let others = |nodes: &[String]| -> Vec<String> {
            nodes.iter().filter(|node| *node != own).cloned().collect()
        };
        let (read_by, written_by) = (others(&uses.read_by), others(&uses.written_by));
        if plumbing::parameter(name) || (read_by.is_empty() && written_by.is_empty()) {
            continue;
        }
        let value = bus.parameter(name).await.ok().map(|value| json(&value));
        parameters.push(Parameter {
            name: name.clone(),
            value,
            read_by,
            written_by,
            ..Parameter::default()
        });
    }
    parameters
}

/// Adds parameters that nodes have of their own, with what they say of them.
async fn own_parameters(
    bus: &dyn Bus,
    seen: &Seen<'_>,
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
        match settle::answered(ANSWER, seen.options, parameters_of(bus, node)).await {
            Some(Ok(parameters)) => all.extend(parameters),
            Some(Err(error)) => {
                warnings.push(format!("{node} does not tell its parameters: {error}"));
            }
            None => warnings.push(format!(
                "{node} does not tell its parameters within {ANSWER:?}"
            )),
        }
    }
}

async fn parameters_of(bus: &dyn Bus, node: &str) -> Result<Vec<Parameter>, BusError> {
    let parameters = bus.node_parameters()?;
    let mut names = parameters.list(node, &[], 0).await?.names;
    names.retain(|name| !plumbing::parameter(name));
    names.sort();
    let descriptions = match names.is_empty() {
        true => return Ok(Vec::new()),
        false => parameters.describe(node, &names).await?,
    };
    let values = parameters.get(node, &names).await?;
    let told = names.into_iter().zip(descriptions).zip(values);
    let parameter = |((name, description), value)| Parameter {
        name: format!("{node}/{name}"),
        node: node.to_owned(),
        value: Option::map(value, |value| json(&value)),
        descriptor: Option::map(description, Into::into),
        ..Parameter::default()
    };
    Ok(told.map(parameter).collect())
}

fn json(value: &ParamValue) -> serde_json::Value {
    serde_json::to_value(value).unwrap_or(serde_json::Value::Null)
}

/// Definition texts of what is used and all it refers to.
struct Texts<'a> {
    definitions: &'a BTreeMap<String, String>,
    used: BTreeMap<String, String>,
}

impl Texts<'_> {
    fn message(&mut self, message: &Arc<MessageType>) {
        let key = names::key(message.name(), "msg");
        // Requests, goals and the like have no text of their own: the service's or the action's is theirs.
        let text = self
            .definitions
            .get(&key)
            .cloned()
            .unwrap_or_else(|| message.text().to_owned());
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
        let key = names::key(name, kind);
        if let Some(text) = self.definitions.get(&key) {
            self.used.insert(key, text.clone());
        }
    }
}
