//! What the node has registered in the servant, told to the robot as it changes.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ros::bus::{Digest, ServiceType, WireType};

use super::inquiries::Inquiries;
use super::node_link::{NodeLink, Service};
use super::seen::{self, Declared, Seen};
use super::{Hub, types};
use link::control::{FromCloud, Graph, Output, Served, Wanted};
use ros::codec::Stamps;

/// Nodes that a robot is warned of.
const WARNED: usize = 20;

/// What was told so far.
#[derive(Default)]
struct Sent {
    types: BTreeSet<(String, Digest)>,
    channels: BTreeMap<String, u32>,
    services: BTreeMap<String, (u32, ServiceType)>,
    next: u32,
    graph: Option<Graph>,
    /// Nodes that it was warned of.
    warned: BTreeSet<String>,
    inquiries: Inquiries,
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
            () = sent.inquiries.next() => {}
        }
    }
}

impl Sent {
    async fn report(&mut self, link: &Arc<NodeLink>, hub: &Arc<Hub>) {
        let graph = hub.bus.graph().borrow().clone();
        let seen = Seen::of(&graph, &link.node, hub.bus.version());
        let listening: BTreeSet<String> = seen.inputs.keys().cloned().collect();
        let before = std::mem::replace(&mut *link.listening.lock(), listening.clone());
        if before != listening {
            hub.changed();
        }
        self.warn_of_shared(link, graph.shared_of_process(&link.node));
        self.inquire(hub, &seen).await;
        let mut graph = Graph {
            siblings: hub.siblings(&graph, &link.node),
            nodes: seen::owners(&graph, &link.node),
            ..Graph::default()
        };
        for (topic, declared) in &seen.outputs {
            let Some(of) = self.output_type(hub, topic, declared) else {
                continue;
            };
            self.tell(link, &of);
            graph.outputs.push(Output {
                channel: self.channel(link, hub, topic, &of),
                topic: topic.clone(),
                type_name: of.name,
                md5: of.digest.to_string(),
                qos: declared.qos(),
            });
        }
        for (topic, declared) in &seen.inputs {
            let (type_name, md5) = self.input_type(link, hub, declared);
            graph.inputs.push(Wanted {
                topic: topic.clone(),
                type_name,
                md5,
                feed: hub.feeder(topic).as_deref() == Some(&link.node),
                qos: declared.qos(),
            });
        }
        for (service, of) in &seen.services {
            let served = self.service(link, hub, service, of.as_ref());
            graph.services.extend(served);
        }
        self.let_go(link, &graph);
        if self.graph.as_ref() != Some(&graph) {
            link.session.report(&FromCloud::Graph(graph.clone()));
            self.graph = Some(graph);
        }
    }

    /// Asks for types that are not told, those that are new at once; they may be told in a moment.
    async fn inquire(&mut self, hub: &Hub, seen: &Seen) {
        let services = seen.services.keys().collect();
        self.inquiries
            .retain(&services, &seen.outputs.keys().collect());
        let before = self.inquiries.count();
        for (service, told) in &seen.services {
            if told.is_none() {
                self.inquiries.service(&hub.bus, service);
            }
        }
        for (topic, declared) in &seen.outputs {
            self.output_type(hub, topic, declared);
        }
        if self.inquiries.count() > before {
            self.inquiries.settle().await;
        }
    }

    /// The type of an output, with its definition where that is known.
    fn output_type(&mut self, hub: &Hub, topic: &str, declared: &Declared) -> Option<WireType> {
        match declared {
            Declared::Named(name) => match hub.registry.message(name) {
                Ok(known) => Some(WireType::of(&known)),
                // Its node knows.
                Err(_) => self.inquiries.topic(&hub.bus, topic),
            },
            Declared::Told(of, _) => match types::message(&hub.registry, of) {
                Some(known) => Some(WireType::of(&known)),
                None => Some(of.clone()),
            },
        }
    }

    /// Warns once of each further node that is left out.
    fn warn_of_shared(&mut self, link: &NodeLink, shared: BTreeSet<String>) {
        for name in shared {
            if self.warned.len() < WARNED && !self.warned.contains(&name) {
                link.session.report(&FromCloud::Notice {
                    warning: true,
                    text: format!(
                        "node {name} of {} is not on the robot: another program of this servant has a node of the same name; give each a name of its own (-r NODE:__node:=NAME)",
                        link.node
                    ),
                });
                self.warned.insert(name);
            }
        }
    }

    /// Tells of a type before it is used.
    fn tell(&mut self, link: &NodeLink, of: &WireType) {
        let key = (of.name.clone(), of.digest.clone());
        if self.types.insert(key) {
            link.session.report(&FromCloud::Type {
                name: of.name.clone(),
                md5: of.digest.to_string(),
                definition: of.definition.clone(),
            });
        }
    }

    /// Name and digest of an input's type.
    fn input_type(&mut self, link: &NodeLink, hub: &Hub, declared: &Declared) -> (String, String) {
        match declared {
            Declared::Named(name) => {
                let known = hub.registry.message(name).ok();
                let md5 = known.map_or_else(|| "*".to_owned(), |known| known.md5().to_owned());
                (name.clone(), md5)
            }
            Declared::Told(of, _) => {
                // The robot's publishers do not tell their definitions, and its end needs them.
                if let Some(known) = types::message(&hub.registry, of) {
                    let definition = known.full_text().into();
                    self.tell(
                        link,
                        &WireType {
                            definition,
                            ..of.clone()
                        },
                    );
                }
                (of.name.clone(), of.digest.to_string())
            }
        }
    }

    fn channel(&mut self, link: &NodeLink, hub: &Hub, topic: &str, of: &WireType) -> u32 {
        if let Some(channel) = self.channels.get(topic) {
            return *channel;
        }
        self.next += 1;
        self.channels.insert(topic.to_owned(), self.next);
        // A type that comes with an action has a definition in the image alone.
        let known = of.schema().ok();
        let known = known.or_else(|| types::message(&hub.registry, of));
        let stamps = known.map(|of| Stamps::of(&of)).unwrap_or_default();
        link.outputs.add(self.next, topic, stamps);
        let schema = codec::Schema::of(&of.name, of.digest.as_str());
        link.session.opens(self.next, topic, schema);
        self.next
    }

    /// A service; `told`: its type, where the server need not be asked.
    fn service(
        &mut self,
        link: &NodeLink,
        hub: &Hub,
        name: &str,
        told: Option<&ServiceType>,
    ) -> Option<Served> {
        let known = self.services.get(name).cloned();
        let same = |of: &ServiceType| told.is_none_or(|told| told == of);
        if let Some((channel, of)) = known.as_ref().filter(|(_, of)| same(of)) {
            return Some(Served::of(*channel, name, of));
        }
        let of = match told {
            Some(told) => told.clone(),
            None => self.inquiries.service(&hub.bus, name)?,
        };
        let channel = match known {
            // The end that answers was found after the one that is asked: more is known of the same.
            Some((channel, before)) if before.name == of.name && before.agrees(&of) => channel,
            before => {
                if let Some((channel, _)) = before {
                    link.services.lock().remove(&channel);
                }
                self.next += 1;
                self.next
            }
        };
        let known = types::service(&hub.registry, &of);
        let (request, response) = types::stamps_of_calls(known.as_deref());
        let service = Service {
            name: name.to_owned(),
            sizes: hub.inputs.of(name, known.as_ref().map(|of| &*of.request)),
            request,
            response,
        };
        link.services.lock().insert(channel, Arc::new(service));
        let served = Served::of(channel, name, &of);
        self.services.insert(name.to_owned(), (channel, of));
        Some(served)
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
