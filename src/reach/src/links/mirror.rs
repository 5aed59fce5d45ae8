//! What the node has registered in the servant, told to the robot as it changes.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ros::bus::{Digest, ServiceType, WireType};

use super::Hub;
use super::node_link::{NodeLink, Service};
use link::control::{FromCloud, Graph, Output, Served, Wanted};
use ros::codec::Stamps;

/// What was told so far.
#[derive(Default)]
struct Sent {
    types: BTreeSet<(String, Digest)>,
    channels: BTreeMap<String, u32>,
    services: BTreeMap<String, (u32, ServiceType)>,
    next: u32,
    graph: Option<Graph>,
}

/// Tells the robot of every change, until the link ends.
pub(super) async fn follow(link: Arc<NodeLink>, hub: Arc<Hub>) {
    let mut graphs = hub.bus.graph();
    let mut changes = hub.changes.subscribe();
    let mut sent = Sent::default();
    loop {
        graphs.borrow_and_update();
        changes.borrow_and_update();
        sent.report(&link, &hub).await;
        tokio::select! {
            changed = graphs.changed() => if changed.is_err() { return },
            changed = changes.changed() => if changed.is_err() { return },
        }
    }
}

impl Sent {
    async fn report(&mut self, link: &Arc<NodeLink>, hub: &Arc<Hub>) {
        let seen = hub.bus.graph().borrow().clone();
        let listening: BTreeSet<String> = seen
            .topics
            .iter()
            .filter(|(_, ends)| ends.subscribers.contains(&link.node))
            .map(|(topic, _)| topic.clone())
            .collect();
        let before = std::mem::replace(&mut *link.listening.lock(), listening.clone());
        if before != listening {
            hub.changed();
        }
        let mut graph = Graph {
            siblings: hub.siblings(&link.node),
            ..Graph::default()
        };
        for (topic, ends) in &seen.topics {
            let wire_type = if ends.publishers.contains(&link.node) {
                self.type_of(link, hub, topic, &ends.type_name).await
            } else {
                None
            };
            if let Some(wire_type) = wire_type {
                let channel = self.channel(link, topic, &wire_type);
                graph.outputs.push(Output {
                    channel,
                    topic: topic.clone(),
                    type_name: wire_type.name,
                    md5: wire_type.digest.to_string(),
                    qos: None,
                });
            }
            if listening.contains(topic) {
                let known = hub.registry.message(&ends.type_name).ok();
                graph.inputs.push(Wanted {
                    topic: topic.clone(),
                    type_name: ends.type_name.clone(),
                    md5: known.map_or_else(|| "*".to_owned(), |known| known.md5().to_owned()),
                    feed: hub.feeder(topic).as_deref() == Some(&link.node),
                    qos: None,
                });
            }
        }
        for (service, server) in &seen.services {
            if *server == link.node {
                graph
                    .services
                    .extend(self.service(link, hub, service).await);
            }
        }
        self.let_go(link, &graph);
        if self.graph.as_ref() != Some(&graph) {
            link.session.report(&FromCloud::Graph(graph.clone()));
            self.graph = Some(graph);
        }
    }

    /// The type with its definition; told before it is used.
    async fn type_of(
        &mut self,
        link: &NodeLink,
        hub: &Hub,
        topic: &str,
        name: &str,
    ) -> Option<WireType> {
        let wire_type = match hub.registry.message(name) {
            Ok(known) => WireType::of(&known),
            // Its node knows.
            Err(_) => hub.bus.topic_type(topic).await.ok()?,
        };
        let key = (wire_type.name.clone(), wire_type.digest.clone());
        if self.types.insert(key) {
            link.session.report(&FromCloud::Type {
                name: wire_type.name.clone(),
                md5: wire_type.digest.to_string(),
                definition: wire_type.definition.clone(),
            });
        }
        Some(wire_type)
    }

    fn channel(&mut self, link: &NodeLink, topic: &str, wire_type: &WireType) -> u32 {
        if let Some(channel) = self.channels.get(topic) {
            return *channel;
        }
        self.next += 1;
        self.channels.insert(topic.to_owned(), self.next);
        let stamps = wire_type
            .schema()
            .map(|of| Stamps::of(&of))
            .unwrap_or_default();
        link.outputs.add(self.next, topic, stamps);
        let schema = codec::Schema::of(&wire_type.name, wire_type.digest.as_str());
        link.session.opens(self.next, topic, schema);
        self.next
    }

    async fn service(&mut self, link: &NodeLink, hub: &Hub, name: &str) -> Option<Served> {
        let (channel, service_type) = match self.services.get(name) {
            Some(known) => known.clone(),
            None => {
                let service_type = hub.bus.service_type(name).await.ok()?;
                self.next += 1;
                let entry = (self.next, service_type);
                self.services.insert(name.to_owned(), entry.clone());
                let stamps = hub.registry.service(&entry.1.name).ok();
                let stamps = stamps.filter(|known| entry.1.digest == *known.md5);
                let service = Service {
                    name: name.to_owned(),
                    sizes: hub.inputs.of(name, stamps.as_ref().map(|of| &*of.request)),
                    request: stamps
                        .as_ref()
                        .map(|of| Stamps::of(&of.request))
                        .unwrap_or_default(),
                    response: stamps
                        .map(|of| Stamps::of(&of.response))
                        .unwrap_or_default(),
                };
                link.services.lock().insert(entry.0, Arc::new(service));
                entry
            }
        };
        Some(Served::of(channel, name, &service_type))
    }

    /// Forgets what the node has taken back.
    fn let_go(&mut self, link: &NodeLink, graph: &Graph) {
        self.channels.retain(|topic, channel| {
            let there = graph.outputs.iter().any(|output| output.topic == *topic);
            if !there {
                link.outputs.remove(*channel);
                link.session.forget(*channel);
            }
            there
        });
        self.services.retain(|name, (channel, _)| {
            let there = graph.services.iter().any(|served| served.name == *name);
            if !there {
                link.services.lock().remove(channel);
            }
            there
        });
    }
}
