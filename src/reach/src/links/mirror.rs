//! Mirrors what the node has registered in the servant to the robot.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ros::bus::{Digest, RosVersion, ServiceType, TypeInquiries, WireType};
use translation::bus::LeftOut;

use super::node_endpoints::{self, DeclaredType, NodeEndpointSet};
use super::state::{Hub, NodeLink, NodeService};
use super::types;
use link::control::{FromCloud, Graph, OutputChannel, RequestedInput, ServiceChannel};
use ros::codec::Stamps;

/// Maximum number of nodes that are warned about.
const MAX_WARNINGS: usize = 20;

/// The state sent to the robot so far.
#[derive(Default)]
struct MirrorState {
    types: BTreeSet<(String, Digest)>,
    channels: BTreeMap<String, u32>,
    services: BTreeMap<String, (u32, ServiceType)>,
    next: u32,
    graph: Option<Graph>,
    /// Nodes that were warned about.
    warned: BTreeSet<String>,
    /// Topics, services and actions that were reported as left out.
    omitted: BTreeSet<String>,
    inquiries: TypeInquiries,
}

/// Sends every change to the robot until the link ends.
pub(super) async fn follow(link: Arc<NodeLink>, hub: Arc<Hub>) {
    let mut graphs = link.view.bus.graph();
    let mut changes = hub.changes.subscribe();
    let mut left_out = link.view.left_out();
    let mut sent = MirrorState::default();
    loop {
        graphs.borrow_and_update();
        changes.borrow_and_update();
        if let Some(left_out) = &mut left_out {
            let now = left_out.borrow_and_update().clone();
            sent.warn_of_omissions(&link, &now);
        }
        sent.send_changes(&link, &hub).await;
        let omitted = async {
            match &mut left_out {
                Some(left_out) => left_out.changed().await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            changed = graphs.changed() => if changed.is_err() { return },
            changed = changes.changed() => if changed.is_err() { return },
            changed = omitted => if changed.is_err() { return },
            () = sent.inquiries.next() => {}
        }
    }
}

impl MirrorState {
    async fn send_changes(&mut self, link: &Arc<NodeLink>, hub: &Arc<Hub>) {
        let bus = &link.view.bus;
        let graph = bus.graph().borrow().clone();
        let seen = NodeEndpointSet::from_graph(&graph, &link.node, bus.version());
        let listening: BTreeSet<String> = seen.inputs.keys().cloned().collect();
        let before = std::mem::replace(&mut *link.listening.lock(), listening.clone());
        if before != listening {
            hub.notify_changed();
        }
        self.warn_of_shared(link, graph.ambiguous_process_nodes(&link.node));
        self.inquire(link, &seen).await;
        let mut graph = Graph {
            siblings: hub.siblings(&graph, &link.node),
            nodes: node_endpoints::owners(&graph, &link.node),
            ..Graph::default()
        };
        for (topic, declared) in &seen.outputs {
            let Some(of) = self.output_type(link, topic, declared) else {
                continue;
            };
            self.send_type(link, &of);
            graph.outputs.push(OutputChannel {
                channel: self.channel_for(link, topic, &of),
                topic: topic.clone(),
                type_name: of.name,
                md5: of.digest.to_string(),
                qos: declared.qos(),
            });
        }
        for (topic, declared) in &seen.inputs {
            let (type_name, md5) = self.input_type(link, declared);
            graph.inputs.push(RequestedInput {
                topic: topic.clone(),
                type_name,
                md5,
                feed: hub.feeder(topic).as_deref() == Some(&link.node),
                // A node of ROS 1 requests nothing: it takes what is latched and what is not. The graph of robots of
                // ROS 2 has no such subscribers.
                qos: declared.qos().filter(|_| hub.bus.version() == RosVersion::Two),
            });
        }
        for (service, of) in &seen.services {
            let served = self.service_entry(link, hub, service, of.as_ref());
            graph.services.extend(served);
        }
        self.remove_gone(link, &graph);
        if self.graph.as_ref() != Some(&graph) {
            link.session.send_control(&FromCloud::Graph(graph.clone()));
            self.graph = Some(graph);
        }
    }

    /// Queries types that are not announced and waits a moment for new ones.
    async fn inquire(&mut self, link: &NodeLink, seen: &NodeEndpointSet) {
        let services = seen.services.keys().collect();
        self.inquiries.retain(&services, &seen.outputs.keys().collect());
        let before = self.inquiries.count();
        for (service, told) in &seen.services {
            if told.is_none() {
                self.inquiries.service(&link.view.bus, service);
            }
        }
        for (topic, declared) in &seen.outputs {
            self.output_type(link, topic, declared);
        }
        if self.inquiries.count() > before {
            self.inquiries.settle().await;
        }
    }

    /// Returns the type of an output, with its definition if known.
    fn output_type(&mut self, link: &NodeLink, topic: &str, declared: &DeclaredType) -> Option<WireType> {
        match declared {
            DeclaredType::Named(name) => match link.view.types.find_message_named(name) {
                Some(known) => Some(WireType::from_message(&known)),
                // Only its node knows it.
                None => self.inquiries.topic(&link.view.bus, topic).map(|offer| WireType::clone(&offer.wire_type)),
            },
            DeclaredType::Told(of, _) => match link.view.types.find_message(of) {
                Some(known) => Some(WireType::from_message(&known)),
                None => Some(of.clone()),
            },
        }
    }

    /// Warns once about each node that is left out.
    fn warn_of_shared(&mut self, link: &NodeLink, shared: BTreeSet<String>) {
        for name in shared {
            if self.warned.len() < MAX_WARNINGS && !self.warned.contains(&name) {
                link.session.send_control(&FromCloud::Notice {
                    warning: true,
                    text: format!(
                        "node {name} of {} is not on the robot: another program of this servant has a node of the same \
                         name; give each a name of its own (-r NODE:__node:=NAME)",
                        link.node
                    ),
                });
                self.warned.insert(name);
            }
        }
    }

    /// Says once of each topic, service and action of the node why the robot does not see it.
    fn warn_of_omissions(&mut self, link: &NodeLink, left_out: &LeftOut) {
        let own = left_out.iter().filter(|(_, entry)| entry.nodes.contains(&link.node));
        for (what, entry) in own {
            if self.omitted.len() < MAX_WARNINGS && self.omitted.insert(what.clone()) {
                let text = format!("{what} of {} is not on the robot: {}", link.node, entry.reason);
                link.session.send_control(&FromCloud::Notice { warning: true, text });
            }
        }
    }

    /// Sends a type before its first use.
    fn send_type(&mut self, link: &NodeLink, of: &WireType) {
        let key = (of.name.clone(), of.digest.clone());
        if self.types.insert(key) {
            link.session.send_control(&FromCloud::Type {
                name: of.name.clone(),
                md5: of.digest.to_string(),
                definition: of.definition.clone(),
            });
        }
    }

    /// Returns name and hash of an input's type.
    fn input_type(&mut self, link: &NodeLink, declared: &DeclaredType) -> (String, String) {
        match declared {
            DeclaredType::Named(name) => {
                let known = link.view.types.find_message_named(name);
                let md5 = known.map_or_else(|| "*".to_owned(), |known| known.md5().to_owned());
                (name.clone(), md5)
            }
            DeclaredType::Told(of, _) => {
                // The robot's publishers do not announce definitions, but its end needs them.
                if let Some(known) = link.view.types.find_message(of) {
                    let definition = known.full_text().into();
                    self.send_type(link, &WireType { definition, ..of.clone() });
                }
                (of.name.clone(), of.digest.to_string())
            }
        }
    }

    fn channel_for(&mut self, link: &NodeLink, topic: &str, of: &WireType) -> u32 {
        if let Some(channel) = self.channels.get(topic) {
            return *channel;
        }
        self.next += 1;
        self.channels.insert(topic.to_owned(), self.next);
        // The definition of a type that belongs to an action is only in the image.
        let known = of.schema().ok();
        let known = known.or_else(|| link.view.types.find_message(of));
        let stamps = known.map(|of| Stamps::for_type(&of)).unwrap_or_default();
        link.outputs.add(self.next, topic, stamps);
        let schema = codec::Schema::for_type(&of.name, of.digest.as_str());
        link.session.open_channel(self.next, topic, schema);
        self.next
    }

    /// Returns the description of a service; `told` is its type, if the server need not be asked.
    fn service_entry(
        &mut self,
        link: &NodeLink,
        hub: &Hub,
        name: &str,
        told: Option<&ServiceType>,
    ) -> Option<ServiceChannel> {
        let known = self.services.get(name).cloned();
        let same = |of: &ServiceType| told.is_none_or(|told| told == of);
        if let Some((channel, of)) = known.as_ref().filter(|(_, of)| same(of)) {
            return Some(ServiceChannel::new(*channel, name, of));
        }
        let of = match told {
            Some(told) => told.clone(),
            None => self.inquiries.service(&link.view.bus, name)?,
        };
        let channel = match known {
            // The server was found after the client: more is now known about the same type.
            Some((channel, before)) if before.name == of.name && before.is_compatible_with(&of) => channel,
            before => {
                if let Some((channel, _)) = before {
                    link.services.lock().remove(&channel);
                }
                self.next += 1;
                self.next
            }
        };
        let known = link.view.types.find_service(&of);
        let (request, response) = types::call_stamps(known.as_deref());
        let service = NodeService {
            name: name.to_owned(),
            sizes: hub.inputs.for_input(name, known.as_ref().map(|of| &*of.request)),
            request,
            response,
        };
        link.services.lock().insert(channel, Arc::new(service));
        let served = ServiceChannel::new(channel, name, &of);
        self.services.insert(name.to_owned(), (channel, of));
        Some(served)
    }

    /// Forgets what the node no longer has.
    fn remove_gone(&mut self, link: &NodeLink, graph: &Graph) {
        self.channels.retain(|topic, channel| {
            let there = graph.outputs.iter().any(|output| output.topic == *topic);
            if !there {
                link.outputs.remove(*channel);
                link.session.forget_channel(*channel);
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
