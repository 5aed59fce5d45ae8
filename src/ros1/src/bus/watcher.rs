//! Tracks the graph: by a long poll of our own Master, by polling every second elsewhere.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ros_bus::{BusError, Graph, TopicNodes};
use tokio::time::sleep;

use super::Ros1BusState;
use super::master_client::to_bus_error;
use crate::actions;
use crate::master::graph::{GraphAnswer, WAIT_GRAPH, wire_generation};
use crate::xmlrpc::{self, Value};

/// Duration of one long poll in seconds, and the grace period for its answer. The end of a Master is noticed at once by
/// its connection, and polling is the only cost of an idle servant, so it is rare.
const POLL: i32 = 240;
const GRACE: Duration = Duration::from_secs(10);
/// Polling interval for a Master without the long poll.
const PERIOD: Duration = Duration::from_secs(1);
/// Pause between attempts to reach a Master that is gone: initial and maximum.
const PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(2);
/// Time for which a Master may be silent before a warning is logged: when one ends, its bus ends a moment later.
const SILENCE: Duration = Duration::from_secs(3);

/// Pause after a poll, per part of the graph, and its maximum. A graph is compared and shown as a whole. A node
/// that keeps changing a large one would keep us busy; the pause is many times as long as the poll took.
const REST: Duration = Duration::from_micros(25);
const LONGEST_REST: Duration = Duration::from_secs(1);

/// Returns the pause after a poll that returned this graph.
fn rest_duration(graph: &Graph) -> Duration {
    let ends = |nodes: &TopicNodes| nodes.publishers.len() + nodes.subscribers.len();
    let parts = graph.topics.values().map(ends).sum::<usize>()
        + graph.services.len()
        + graph.nodes.len()
        + graph.parameters.len()
        + graph.sought.len();
    let parts = u32::try_from(parts).unwrap_or(u32::MAX);
    REST.saturating_mul(parts).min(LONGEST_REST)
}

/// Time since which the Master has not answered, and whether that was logged.
#[derive(Default)]
struct MasterSilence {
    since: Option<Instant>,
    told: bool,
}

impl MasterSilence {
    fn record_failure(&mut self, error: &xmlrpc::Error) {
        let since = *self.since.get_or_insert_with(Instant::now);
        tracing::debug!(%error, "the ROS Master does not answer; trying again");
        if !self.told && since.elapsed() >= SILENCE {
            self.told = true;
            tracing::warn!(%error, "the ROS Master has not answered for {SILENCE:?}; still trying");
        }
    }
}

/// Tracks one bus's graph.
pub(super) struct Watcher {
    bus: Arc<Ros1BusState>,
    /// True if the Master supports the long poll.
    waits: bool,
    known: i32,
    run_id: String,
}

/// Creates the watcher and gets the graph for the first time.
pub(super) async fn start(bus: Arc<Ros1BusState>) -> Result<Watcher, BusError> {
    let mut watcher = Watcher { bus, waits: true, known: -1, run_id: String::new() };
    watcher.refresh().await.map_err(to_bus_error)?;
    Ok(watcher)
}

/// Returns the current graph.
pub(super) async fn fetch(bus: &Arc<Ros1BusState>) -> Result<Graph, BusError> {
    let graph = match wait_graph(bus, -1, "", 0).await {
        Ok(answer) => answer.graph,
        Err(xmlrpc::Error::Fault { .. }) => poll_graph(bus).await.map_err(to_bus_error)?,
        Err(error) => return Err(to_bus_error(error)),
    };
    Ok(graph)
}

impl Watcher {
    /// Runs forever.
    pub(super) async fn run(mut self) {
        let mut pause = PAUSE;
        let mut silence = MasterSilence::default();
        loop {
            if !self.waits {
                sleep(PERIOD).await;
            }
            match self.refresh().await {
                Ok(rest) => {
                    pause = PAUSE;
                    silence = MasterSilence::default();
                    sleep(rest).await;
                }
                Err(error) => {
                    silence.record_failure(&error);
                    // The next answer may come from another Master.
                    self.known = -1;
                    self.waits = true;
                    sleep(pause).await;
                    pause = (pause * 2).min(LONGEST_PAUSE);
                }
            }
        }
    }

    /// Polls the graph once; returns the pause before the next poll.
    async fn refresh(&mut self) -> Result<Duration, xmlrpc::Error> {
        let first = self.known == -1;
        let graph = if self.waits {
            match wait_graph(&self.bus, self.known, &self.run_id, POLL).await {
                Ok(answer) => {
                    if !self.run_id.is_empty() && self.run_id != answer.run_id {
                        tracing::info!(run_id = answer.run_id, "the ROS Master was replaced");
                    }
                    self.run_id.clone_from(&answer.run_id);
                    let known = self.bus.graph.borrow().clone();
                    answer.into_whole(&known).ok_or_else(|| unreadable(WAIT_GRAPH))?
                }
                Err(xmlrpc::Error::Fault { .. }) => {
                    self.waits = false;
                    poll_graph(&self.bus).await?
                }
                Err(error) => return Err(error),
            }
        } else {
            poll_graph(&self.bus).await?
        };
        self.known = wire_generation(graph.generation);
        if first && self.waits {
            // It may be another Master than the one that knows the lender.
            let _ = self.bus.announce_lender().await;
        }
        let rest = rest_duration(&graph);
        self.apply(graph).await;
        Ok(rest)
    }

    /// Reconciles everything with the graph, then publishes it.
    async fn apply(&self, mut graph: Graph) {
        graph.actions = actions::find_actions(&graph.topics);
        let bus = &self.bus;
        bus.calls.keep_current(&graph);
        if self.waits {
            let topics: Vec<_> = bus.subscriptions.lock().values().cloned().collect();
            for topic in topics {
                if let Some(ends) = graph.topics.get(&topic.name) {
                    let uris = ends.publishers.iter().filter_map(|n| graph.nodes.get(n));
                    topic.update(bus, &uris.cloned().collect::<Vec<_>>());
                }
            }
        }
        let differences = bus.registrar.differences(&bus.node, &graph);
        bus.graph.send_if_modified(|before| {
            let news = **before != graph;
            if news {
                *before = Arc::new(graph);
            }
            news
        });
        bus.reconcile(differences).await;
    }
}

impl Ros1BusState {
    /// Reconciles the Master with what is wanted here.
    async fn reconcile(self: &Arc<Self>, differences: Vec<(super::registrar::Kind, String)>) {
        use super::registrar::Kind;
        if !differences.is_empty() {
            // The Master lost our registrations, and so also our parameter subscription.
            let _ = self.subscribe_params().await;
        }
        for (kind, name) in differences {
            if !self.registrar.is_wanted(kind, &name) {
                self.registrar.withdraw_surplus(kind, &name).await;
                continue;
            }
            tracing::debug!(?kind, name, "registering again");
            let answer = self.registrar.sync(kind, &name, true).await;
            let topic = self.subscriptions.lock().get(&name).cloned();
            if let (Kind::Subscriber, Ok(Some(publishers)), Some(topic)) = (kind, answer, topic) {
                topic.update(self, &publishers.to_strings());
            }
        }
    }
}

/// Waits for another generation than the known one of the Master with this run id.
async fn wait_graph(bus: &Ros1BusState, known: i32, run_id: &str, seconds: i32) -> Result<GraphAnswer, xmlrpc::Error> {
    let args = vec![known.into(), seconds.into(), run_id.into()];
    let time = Duration::from_secs(u64::from(seconds.unsigned_abs())) + GRACE;
    let reply = bus.master.call_raw(&bus.node, WAIT_GRAPH, args, time).await?;
    GraphAnswer::from_value(&reply.value).ok_or_else(|| unreadable(WAIT_GRAPH))
}

fn unreadable(method: &str) -> xmlrpc::Error {
    xmlrpc::Error::Http { peer: "the ROS Master".to_owned(), reason: format!("its answer to {method} cannot be read") }
}

/// Gets the graph with the methods that every Master has; these do not include the use of parameters.
async fn poll_graph(bus: &Ros1BusState) -> Result<Graph, xmlrpc::Error> {
    let before = bus.graph.borrow().clone();
    let call = |method: &'static str, args: Vec<Value>| async move {
        bus.master.call_raw(&bus.node, method, args, GRACE).await
    };
    let state = call("getSystemState", vec![]).await?.value;
    let types = call("getTopicTypes", vec![]).await?.value;
    let Some([publishers, subscribers, services]) = state.as_array() else {
        return Err(unreadable("getSystemState"));
    };
    let types: BTreeMap<String, String> =
        pairs(&types).filter_map(|(topic, name)| Some((topic.to_owned(), name.as_str()?.to_owned()))).collect();
    let mut graph = Graph::default();
    for (list, publishing) in [(publishers, true), (subscribers, false)] {
        for (name, nodes) in pairs(list) {
            let topic = graph.topics.entry(name.to_owned()).or_insert_with(|| TopicNodes {
                type_name: types.get(name).map_or("*", String::as_str).to_owned(),
                ..TopicNodes::default()
            });
            if publishing {
                topic.publishers = nodes.to_strings();
            } else {
                topic.subscribers = nodes.to_strings();
            }
        }
    }
    for (name, nodes) in pairs(services) {
        if let Some(node) = nodes.to_strings().into_iter().next() {
            graph.services.insert(name.to_owned(), node);
        }
    }
    let in_topics = graph.topics.values().flat_map(|topic| topic.publishers.iter().chain(&topic.subscribers));
    let mut names: Vec<String> = in_topics.chain(graph.services.values()).cloned().collect();
    names.sort();
    names.dedup();
    for name in names {
        let uri = match before.nodes.get(&name) {
            // Our own name may belong to another node by now.
            Some(uri) if name != bus.node => uri.clone(),
            _ => match call("lookupNode", vec![name.as_str().into()]).await?.value {
                Value::String(uri) if !uri.is_empty() => uri,
                _ => continue,
            },
        };
        graph.nodes.insert(name, uri);
    }
    graph.generation = before.generation;
    if graph != *before {
        graph.generation += 1;
    }
    Ok(graph)
}

/// Iterates over a list of `[name, value]`.
fn pairs(list: &Value) -> impl Iterator<Item = (&str, &Value)> {
    let elements = list.as_array().unwrap_or_default();
    elements.iter().filter_map(|pair| match pair.as_array()? {
        [Value::String(name), value] => Some((name.as_str(), value)),
        _ => None,
    })
}
