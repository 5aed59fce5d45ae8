//! The ROS Master and parameter server (<http://wiki.ros.org/ROS/Master_API>), as a library.
//!
//! In: XML-RPC calls of nodes on a listener, and notifications that a process exited. Out: answers, `publisherUpdate`
//! and `paramUpdate` calls to nodes, and the [`Graph`] for those who wait for it. It runs on one thread and keeps
//! everything in memory.

mod api;
mod changes;
pub(crate) mod graph;
pub(crate) mod lending;
mod notify;
mod params;
mod probe;
mod registry;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::hash::{BuildHasher as _, RandomState};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use parking_lot::Mutex;
use ros_bus::net::{LoopbackSockets, Sockets};
use ros_bus::{Graph, ParamValue, ParameterUse};
use tokio::net::TcpListener;
use tokio::sync::watch;

use crate::actions;
use crate::xmlrpc::{self, ServerLimits, Value};
use changes::GraphChanges;
use graph::{GraphAnswer, GraphPart, wire_generation};
use lending::LenderSlot;
use notify::{Notice, Notifier};
use params::Params;
use registry::Registry;

/// Maximum number of parameter keys whose use is recorded.
const MAX_USES: usize = 10_000;
/// Maximum number of nodes recorded per key and kind of use.
const MAX_USERS: usize = 100;
/// Time over which parameter uses are collected before waiters for the graph are notified: nodes use parameters by the
/// hundred when they start, and each answer contains the whole graph.
const USES_TOGETHER: Duration = Duration::from_millis(100);
/// Maximum number of recorded services that were looked up in vain.
const MAX_SOUGHT: usize = 1000;

/// Options of a Master.
#[derive(Debug, Clone)]
pub struct MasterOptions {
    /// Own URI, as returned by `getUri`.
    pub uri: String,
    /// Parameters set before the first node arrives. `/run_id`, `/rosdistro` and `/rosversion` are added if missing:
    /// roslaunch waits for them.
    pub parameters: BTreeMap<String, ParamValue>,
    /// Limits of its XML-RPC server.
    pub limits: ServerLimits,
}

impl Default for MasterOptions {
    fn default() -> Self {
        Self { uri: "http://localhost:11311/".to_owned(), parameters: BTreeMap::new(), limits: ServerLimits::default() }
    }
}

/// A Master; clones are handles to the same one.
#[derive(Clone)]
pub struct Master {
    inner: Arc<MasterCore>,
}

struct MasterCore {
    uri: String,
    run_id: String,
    limits: ServerLimits,
    state: Mutex<State>,
    /// Number of changes of what [`Master::graph`] shows.
    generation: watch::Sender<u64>,
    notifier: Notifier,
    lending: LenderSlot,
    sockets: OnceLock<Arc<dyn Sockets>>,
}

#[derive(Default)]
struct State {
    registry: Registry,
    params: Params,
    uses: HashMap<String, ParameterUse>,
    /// True if a recorded use has not been published yet.
    uses_changed: bool,
    sought: BTreeMap<String, Vec<String>>,
    changes: GraphChanges,
}

impl Master {
    /// Creates a Master without nodes. A parameter that no XML-RPC value can hold is left out, with a warning in the
    /// log.
    pub fn new(options: MasterOptions) -> Self {
        let mut params = Params::default();
        for (key, value) in options.parameters {
            let reason = match Value::try_from(value) {
                Ok(value) => {
                    let set = params.set(&crate::names::canonical(&key), value);
                    set.err().map(|error| error.to_string())
                }
                Err(error) => Some(error.to_string()),
            };
            if let Some(reason) = reason {
                tracing::warn!(key, reason, "an initial parameter was left out");
            }
        }
        let run_id = match params.get("/run_id") {
            Some(Value::String(id)) => id.clone(),
            _ => new_run_id(),
        };
        // The line ends are roscore's, which sets these from the output of commands.
        for (key, value) in [("/run_id", run_id.as_str()), ("/rosdistro", "noetic\n"), ("/rosversion", "1.16.0\n")] {
            if params.get(key).is_none() {
                let _ = params.set(key, Value::from(value));
            }
        }
        let state = State { params, ..State::default() };
        Self {
            inner: Arc::new(MasterCore {
                uri: options.uri,
                run_id,
                limits: options.limits,
                state: Mutex::new(state),
                generation: watch::Sender::new(0),
                notifier: Notifier::default(),
                lending: LenderSlot::default(),
                sockets: OnceLock::new(),
            }),
        }
    }

    /// Serves nodes until dropped. `sockets` is used to call nodes back; only the first call's is used.
    pub async fn serve(&self, listener: TcpListener, sockets: Arc<dyn Sockets>) {
        let _ = self.inner.sockets.set(sockets);
        let handler = Arc::new(api::Api { master: self.inner.clone() });
        xmlrpc::serve(listener, handler, self.inner.limits.clone()).await;
    }

    /// Drops the registrations of nodes whose address nobody listens on any more, after any process on the nodes' host
    /// has exited. Returns their names.
    pub async fn on_process_exit(&self) -> Vec<String> {
        probe::drop_dead(&self.inner).await
    }

    /// Returns the graph of registered nodes.
    pub fn graph(&self) -> Graph {
        self.inner.graph()
    }

    /// Returns the generation of the graph, updated as it grows.
    pub fn generation(&self) -> watch::Receiver<u64> {
        self.inner.generation.subscribe()
    }

    /// Returns the id of this Master since its first start; also parameter `/run_id`.
    pub fn run_id(&self) -> &str {
        &self.inner.run_id
    }
}

impl State {
    /// Copies a part of the graph into another; returns false if it is there no more.
    fn copy_part(&self, part: &GraphPart, to: &mut Graph) -> bool {
        fn insert<T>(to: &mut BTreeMap<String, T>, name: &str, value: Option<T>) -> bool {
            let is_there = value.is_some();
            to.extend(value.map(|value| (name.to_owned(), value)));
            is_there
        }
        let registry = &self.registry;
        match part {
            GraphPart::Topic(name) => insert(&mut to.topics, name, registry.topic(name)),
            GraphPart::Service(name) => insert(&mut to.services, name, registry.service_node(name).map(str::to_owned)),
            GraphPart::Node(name) => insert(&mut to.nodes, name, registry.node_api(name).map(str::to_owned)),
            GraphPart::Parameter(key) => insert(&mut to.parameters, key, self.uses.get(key).cloned()),
            GraphPart::Sought(service) => insert(&mut to.sought, service, self.sought.get(service).cloned()),
        }
    }
}

impl MasterCore {
    fn sockets(&self) -> Arc<dyn Sockets> {
        let sockets = self.sockets.get().cloned();
        sockets.unwrap_or_else(|| Arc::new(LoopbackSockets))
    }

    fn graph(&self) -> Graph {
        let state = self.state.lock();
        let owned = |(name, text): (&str, &str)| (name.to_owned(), text.to_owned());
        let uses = state.uses.iter();
        let topics = state.registry.topics();
        let topics = topics.map(|(name, topic)| (name.to_owned(), topic)).collect();
        Graph {
            generation: *self.generation.borrow(),
            actions: actions::find_actions(&topics),
            topics,
            services: state.registry.services().map(owned).collect(),
            nodes: state.registry.nodes().map(owned).collect(),
            parameters: uses.map(|(key, used)| (key.clone(), used.clone())).collect(),
            sought: state.sought.clone(),
            ends: BTreeMap::new(),
            enclaves: BTreeMap::new(),
        }
    }

    /// Returns the graph for a caller that knows a generation of this Master's: what has changed since, or the whole.
    fn graph_answer(&self, known: Option<i32>) -> GraphAnswer {
        let run_id = self.run_id.clone();
        let differences = known.and_then(|known| {
            let state = self.state.lock();
            let now = *self.generation.borrow();
            // The wire has the low bits of a generation.
            let age = u64::from(wire_generation(now).wrapping_sub(known) as u32 & 0x7fff_ffff);
            let parts = state.changes.parts_since(now.checked_sub(age)?)?;
            let mut answer = GraphAnswer {
                run_id: run_id.clone(),
                graph: Graph { generation: now, ..Graph::default() },
                since: Some(known),
                gone: BTreeSet::new(),
            };
            for part in parts {
                if !state.copy_part(&part, &mut answer.graph) {
                    answer.gone.insert(part);
                }
            }
            Some(answer)
        });
        differences.unwrap_or_else(|| GraphAnswer { run_id, graph: self.graph(), since: None, gone: BTreeSet::new() })
    }

    fn is_known(&self, api: &str) -> bool {
        self.state.lock().registry.is_known(api)
    }

    /// Changes the state and notifies the nodes concerned.
    fn update<T>(self: &Arc<Self>, by: impl FnOnce(&mut State, &mut Vec<Notice>) -> T) -> T {
        let mut notices = Vec::new();
        let mut state = self.state.lock();
        let before = state.registry.version();
        let result = by(&mut state, &mut notices);
        // Both while the state is locked: neither notices nor generations may overtake each other.
        if state.registry.version() != before {
            let changed = state.registry.take_changed();
            self.record_changes(&mut state, changed);
            self.bump_generation();
        }
        Notifier::send(self, notices);
        drop(state);
        result
    }

    /// Records that these parts change with the next generation; they have changed already.
    fn record_changes(&self, state: &mut State, parts: impl IntoIterator<Item = GraphPart>) {
        let next = *self.generation.borrow() + 1;
        state.changes.record(next, parts);
    }

    fn bump_generation(&self) {
        self.generation.send_modify(|generation| *generation += 1);
    }

    /// Records that `node` used a parameter.
    fn record_use(self: &Arc<Self>, state: &mut State, key: &str, node: &str, written: bool) {
        if state.uses.len() >= MAX_USES && !state.uses.contains_key(key) {
            return;
        }
        let used = state.uses.entry(key.to_owned()).or_default();
        let nodes = if written { &mut used.written_by } else { &mut used.read_by };
        if nodes.len() < MAX_USERS && nodes.iter().all(|known| known != node) {
            nodes.push(node.to_owned());
            self.record_changes(state, [GraphPart::Parameter(key.to_owned())]);
            if !std::mem::replace(&mut state.uses_changed, true) {
                let master = Arc::clone(self);
                tokio::spawn(async move {
                    tokio::time::sleep(USES_TOGETHER).await;
                    let mut state = master.state.lock();
                    state.uses_changed = false;
                    master.bump_generation();
                });
            }
        }
    }

    /// Returns the approximate size of the graph in bytes; only the parameters can exceed their share.
    fn graph_weight(&self) -> usize {
        let state = self.state.lock();
        let uses = state.uses.iter().map(|(key, used)| {
            let users = used.read_by.iter().chain(&used.written_by);
            let names = users.map(|node| size_of::<Value>() + node.len());
            3 * size_of::<Value>() + size_of::<String>() + key.len() + names.sum::<usize>()
        });
        uses.sum()
    }
}

/// Records that `node` looked up a service in vain; returns true if that is new.
fn record_sought(sought: &mut BTreeMap<String, Vec<String>>, service: &str, node: &str) -> bool {
    if sought.len() >= MAX_SOUGHT && !sought.contains_key(service) {
        return false;
    }
    let nodes = sought.entry(service.to_owned()).or_default();
    let news = nodes.len() < MAX_USERS && nodes.iter().all(|known| known != node);
    if news {
        nodes.push(node.to_owned());
    }
    news
}

/// Creates a run id in the shape of a UUID, as roslaunch does; random enough to distinguish two Masters.
fn new_run_id() -> String {
    let random = || RandomState::new().hash_one(std::process::id());
    let (high, low) = (random(), random());
    format!(
        "{:08x}-{:04x}-{:04x}-{:04x}-{:012x}",
        high >> 32,
        (high >> 16) & 0xffff,
        high & 0xffff,
        low >> 48,
        low & 0xffff_ffff_ffff
    )
}

#[cfg(test)]
mod tests;
