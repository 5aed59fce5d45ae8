//! Follows the graph: by the long poll of our own Master, by asking every second elsewhere.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::time::sleep;

use super::Inner;
use super::master_client::to_bus_error;
use crate::bus::{BusError, Graph, TopicNodes};
use crate::ros1::actions;
use crate::ros1::master::graph::{WAIT_GRAPH, from_value, wire_generation};
use crate::ros1::xmlrpc::{self, Value};

/// One long poll, seconds, and the grace for its answer. A Master that ends is seen at once, by its connection; asking
/// again is all that an idle servant costs, so it is seldom.
const POLL: i32 = 240;
const GRACE: Duration = Duration::from_secs(10);
/// Between two looks at a Master without the long poll.
const PERIOD: Duration = Duration::from_secs(1);
/// Between attempts to reach a Master that is gone, at first and at last.
const PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(2);
/// A Master may be silent so long before it is told: one that ends takes its bus with it, a moment later.
const SILENCE: Duration = Duration::from_secs(3);

/// A graph is read, compared and shown as a whole. A node that changes a large one again and again would have us do little else; so
/// there is a rest for each of its parts before the next look, many times as long as it took, and at most so long.
const REST: Duration = Duration::from_micros(25);
const LONGEST_REST: Duration = Duration::from_secs(1);

/// How long to rest after a look at this graph.
fn rest(graph: &Graph) -> Duration {
    let ends = |nodes: &TopicNodes| nodes.publishers.len() + nodes.subscribers.len();
    let parts = graph.topics.values().map(ends).sum::<usize>()
        + graph.services.len()
        + graph.nodes.len()
        + graph.parameters.len()
        + graph.sought.len();
    let parts = u32::try_from(parts).unwrap_or(u32::MAX);
    REST.saturating_mul(parts).min(LONGEST_REST)
}

/// Since when the Master has not answered, and whether that was told.
#[derive(Default)]
struct Silence {
    since: Option<Instant>,
    told: bool,
}

impl Silence {
    fn goes_on(&mut self, error: &xmlrpc::Error) {
        let since = *self.since.get_or_insert_with(Instant::now);
        tracing::debug!(%error, "the ROS Master does not answer; trying again");
        if !self.told && since.elapsed() >= SILENCE {
            self.told = true;
            tracing::warn!(%error, "the ROS Master has not answered for {SILENCE:?}; trying on");
        }
    }
}

/// Follows one bus's graph.
pub(super) struct Watcher {
    bus: Arc<Inner>,
    /// The Master has our long poll.
    waits: bool,
    known: i32,
    run_id: String,
}

/// Gets the graph for the first time.
pub(super) async fn start(bus: Arc<Inner>) -> Result<Watcher, BusError> {
    let mut watcher = Watcher {
        bus,
        waits: true,
        known: -1,
        run_id: String::new(),
    };
    watcher.look().await.map_err(to_bus_error)?;
    Ok(watcher)
}

/// The graph at this moment.
pub(super) async fn fetch(bus: &Arc<Inner>) -> Result<Graph, BusError> {
    let graph = match wait(bus, -1, 0).await {
        Ok((graph, _)) => graph,
        Err(xmlrpc::Error::Fault { .. }) => ask(bus).await.map_err(to_bus_error)?,
        Err(error) => return Err(to_bus_error(error)),
    };
    Ok(graph)
}

impl Watcher {
    /// Follows for ever.
    pub(super) async fn run(mut self) {
        let mut pause = PAUSE;
        let mut silence = Silence::default();
        loop {
            if !self.waits {
                sleep(PERIOD).await;
            }
            match self.look().await {
                Ok(rest) => {
                    pause = PAUSE;
                    silence = Silence::default();
                    sleep(rest).await;
                }
                Err(error) => {
                    silence.goes_on(&error);
                    // Whoever answers next may be another Master.
                    self.known = -1;
                    self.waits = true;
                    sleep(pause).await;
                    pause = (pause * 2).min(LONGEST_PAUSE);
                }
            }
        }
    }

    /// Looks at the graph; how long to rest before the next look.
    async fn look(&mut self) -> Result<Duration, xmlrpc::Error> {
        let first = self.known == -1;
        let graph = if self.waits {
            match wait(&self.bus, self.known, POLL).await {
                Ok((graph, run_id)) => {
                    if !self.run_id.is_empty() && self.run_id != run_id {
                        tracing::info!(run_id, "the ROS Master was replaced");
                    }
                    self.run_id = run_id;
                    graph
                }
                Err(xmlrpc::Error::Fault { .. }) => {
                    self.waits = false;
                    ask(&self.bus).await?
                }
                Err(error) => return Err(error),
            }
        } else {
            ask(&self.bus).await?
        };
        self.known = wire_generation(graph.generation);
        if first && self.waits {
            // It may be another Master than the one that was told.
            let _ = self.bus.report_that_it_lends().await;
        }
        let rest = rest(&graph);
        self.take(graph).await;
        Ok(rest)
    }

    /// Brings everything in line with the graph, then shows it.
    async fn take(&self, mut graph: Graph) {
        graph.actions = actions::of_topics(&graph.topics);
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
        bus.correct(differences).await;
    }
}

impl Inner {
    /// Makes the Master agree with what is wanted here.
    async fn correct(self: &Arc<Self>, differences: Vec<(super::registrar::Kind, String)>) {
        use super::registrar::Kind;
        if !differences.is_empty() {
            // The Master forgot us, so also that we watch its parameters.
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

async fn wait(bus: &Inner, known: i32, seconds: i32) -> Result<(Graph, String), xmlrpc::Error> {
    let args = vec![known.into(), seconds.into()];
    let time = Duration::from_secs(u64::from(seconds.unsigned_abs())) + GRACE;
    let reply = bus.master.raw(&bus.node, WAIT_GRAPH, args, time).await?;
    from_value(&reply.value).ok_or_else(|| unreadable(WAIT_GRAPH))
}

fn unreadable(method: &str) -> xmlrpc::Error {
    xmlrpc::Error::Http {
        peer: "the ROS Master".to_owned(),
        reason: format!("its answer to {method} cannot be read"),
    }
}

/// The graph by the methods that every Master has. Parameter uses are not to be had from it.
async fn ask(bus: &Inner) -> Result<Graph, xmlrpc::Error> {
    let before = bus.graph.borrow().clone();
    let call = |method: &'static str, args: Vec<Value>| async move {
        bus.master.raw(&bus.node, method, args, GRACE).await
    };
    let state = call("getSystemState", vec![]).await?.value;
    let types = call("getTopicTypes", vec![]).await?.value;
    let Some([publishers, subscribers, services]) = state.as_array() else {
        return Err(unreadable("getSystemState"));
    };
    let types: BTreeMap<String, String> = pairs(&types)
        .filter_map(|(topic, name)| Some((topic.to_owned(), name.as_str()?.to_owned())))
        .collect();
    let mut graph = Graph::default();
    for (list, publishing) in [(publishers, true), (subscribers, false)] {
        for (name, nodes) in pairs(list) {
            let topic = graph
                .topics
                .entry(name.to_owned())
                .or_insert_with(|| TopicNodes {
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
    let in_topics = graph
        .topics
        .values()
        .flat_map(|topic| topic.publishers.iter().chain(&topic.subscribers));
    let mut names: Vec<String> = in_topics.chain(graph.services.values()).cloned().collect();
    names.sort();
    names.dedup();
    for name in names {
        let uri = match before.nodes.get(&name) {
            // Our own may be somebody else's by now.
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

/// The elements of a list of `[name, value]`.
fn pairs(list: &Value) -> impl Iterator<Item = (&str, &Value)> {
    let elements = list.as_array().unwrap_or_default();
    elements.iter().filter_map(|pair| match pair.as_array()? {
        [Value::String(name), value] => Some((name.as_str(), value)),
        _ => None,
    })
}
