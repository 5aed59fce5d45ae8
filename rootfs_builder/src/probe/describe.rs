//! From what was seen to the interface: types asked for and compared with their definitions.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use package::interface::{Action, Direction, Interface, Need, Parameter, Service, Topic};
use ros::bus::{Bus, BusError, Graph, ParamValue, WireType};
use ros::ros1::own_parameters::every_node_asks_for;
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
        if name.ends_with("/get_loggers") || name.ends_with("/set_logger_level") {
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
                compare(
                    &format!("service {name}"),
                    &wire.name,
                    wire.digest.as_str(),
                    &service.md5,
                )?;
                texts.service(&wire.name, [&service.request, &service.response]);
                services.push(Service {
                    name: name.clone(),
                    type_name: wire.name,
                    md5: wire.digest.to_string(),
                    node: node.clone(),
                });
            }
            Err(problem) => found.warnings.push(problem),
        }
    }
    let parameters = parameters(bus, graph, &seen.options.own_name).await;
    found.interface = Interface {
        topics,
        services,
        actions,
        parameters,
        needs: needs_of(seen),
        late: Vec::new(),
        definitions: texts.used,
    };
    for need in &found.interface.needs {
        let (name, nodes) = (&need.name, need.nodes.join(", "));
        found.warnings.push(format!(
            "{nodes} looks for the service {name}, which nobody serves here: on a robot it is looked for there"
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

/// Those, and the services that were lent.
fn needs_of(seen: &Seen<'_>) -> Vec<Need> {
    let mut needs = needs(&seen.graph, &seen.options.own_name);
    for (name, nodes) in &seen.asked {
        if seen.graph.services.contains_key(name) {
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
    let any = wire.name == "*" || wire.digest.is_any();
    if !any {
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
    }
    let ends = seen.graph.topics.get(&name);
    let nodes = match direction {
        Direction::Input => ends.map(|topic| &topic.subscribers),
        Direction::Output => ends.map(|topic| &topic.publishers),
    };
    let nodes = nodes
        .into_iter()
        .flatten()
        .filter(|node| **node != seen.options.own_name)
        .cloned()
        .collect();
    Ok(Topic {
        latched: direction == Direction::Output && seen.latched.contains(&name),
        lazy: direction == Direction::Input && !seen.eager.contains(&name),
        type_name: wire.name,
        md5: wire.digest.to_string(),
        direction,
        nodes,
        name,
    })
}

fn compare(what: &str, type_name: &str, announced: &str, defined: &str) -> Result<(), ProbeError> {
    if announced == "*" || announced == defined {
        return Ok(());
    }
    Err(ProbeError::Mismatch {
        what: what.to_owned(),
        type_name: type_name.to_owned(),
        announced: announced.to_owned(),
        defined: defined.to_owned(),
    })
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
            texts.action(&ends.type_name);
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
        let plumbing = every_node_asks_for(name);
        if plumbing || (read_by.is_empty() && written_by.is_empty()) {
            continue;
        }
        let value = bus.parameter(name).await.ok().map(|value| json(&value));
        parameters.push(Parameter {
            name: name.clone(),
            value,
            read_by,
            written_by,
        });
    }
    parameters
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
        let key = message.name().replacen('/', "/msg/", 1);
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

    fn action(&mut self, name: &str) {
        self.copy(name, "action");
    }

    fn copy(&mut self, name: &str, kind: &str) {
        let key = name.replacen('/', &format!("/{kind}/"), 1);
        if let Some(text) = self.definitions.get(&key) {
            self.used.insert(key, text.clone());
        }
    }
}
