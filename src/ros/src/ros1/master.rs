//! The ROS Master and parameter server (<http://wiki.ros.org/ROS/Master_API>), as a library.
//!
//! In: XML-RPC calls of nodes on a listener, and word that a process exited. Out: answers, `publisherUpdate` and
//! `paramUpdate` calls to nodes, and the [`Graph`] for whoever waits for it. It runs on one thread and keeps
//! everything in memory.

mod api;
pub(crate) mod graph;
pub(crate) mod lending;
mod notify;
mod params;
mod probe;
mod registry;

use std::collections::{BTreeMap, HashMap};
use std::hash::{BuildHasher as _, RandomState};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use parking_lot::Mutex;
use tokio::net::TcpListener;
use tokio::sync::watch;

use crate::bus::{Graph, ParamValue, ParameterUse};
use crate::net::{LoopbackSockets, Sockets};
use crate::ros1::actions;
use crate::ros1::xmlrpc::{self, Limits, Value};
use lending::Lending;
use notify::{Notice, Notifier};
use params::Params;
use registry::Registry;

/// Parameter keys whose use is remembered, at most.
const MAX_USES: usize = 10_000;
/// Nodes remembered per key and kind of use, at most.
const MAX_USERS: usize = 100;
/// Nodes touch parameters by the hundred when they start. Whoever waits for the graph hears of all that is touched within
/// this time at once: each answer holds the whole graph.
const USES_TOGETHER: Duration = Duration::from_millis(100);
/// Services remembered that were looked for in vain, at most.
const MAX_SOUGHT: usize = 1000;

/// What a Master starts with.
#[derive(Debug, Clone)]
pub struct MasterOptions {
    /// What it calls itself in `getUri`.
    pub uri: String,
    /// Set before the first node comes. `/run_id`, `/rosdistro` and `/rosversion` are added where missing:
    /// roslaunch waits for them.
    pub parameters: BTreeMap<String, ParamValue>,
    /// What its XML-RPC server grants.
    pub limits: Limits,
}

impl Default for MasterOptions {
    fn default() -> Self {
        Self {
            uri: "http://localhost:11311/".to_owned(),
            parameters: BTreeMap::new(),
            limits: Limits::default(),
        }
    }
}

/// A Master; clones are handles to the same one.
#[derive(Clone)]
pub struct Master {
    inner: Arc<Inner>,
}

struct Inner {
    uri: String,
    run_id: String,
    limits: Limits,
    state: Mutex<State>,
    /// Grows by one with every change of what [`Master::graph`] shows.
    generation: watch::Sender<u64>,
    notifier: Notifier,
    lending: Lending,
    sockets: OnceLock<Arc<dyn Sockets>>,
}

#[derive(Default)]
struct State {
    registry: Registry,
    params: Params,
    uses: HashMap<String, ParameterUse>,
    /// A use was noted that is yet to be told.
    uses_changed: bool,
    sought: BTreeMap<String, Vec<String>>,
}

impl Master {
    /// A Master that no node has found yet. A parameter that no XML-RPC value can hold is left out, with a
    /// warning in the log.
    pub fn new(options: MasterOptions) -> Self {
        let mut params = Params::default();
        for (key, value) in options.parameters {
            let set = Value::try_from(value).and_then(|value| {
                let key = crate::ros1::names::canonical(&key);
                params.set(&key, value).map_err(|error| error.to_string())
            });
            if let Err(reason) = set {
                tracing::warn!(key, reason, "an initial parameter was left out");
            }
        }
        let run_id = match params.get("/run_id") {
            Some(Value::String(id)) => id.clone(),
            _ => new_run_id(),
        };
        // The line ends are roscore's: it fills these from the output of commands.
        for (key, value) in [
            ("/run_id", run_id.as_str()),
            ("/rosdistro", "noetic\n"),
            ("/rosversion", "1.16.0\n"),
        ] {
            if params.get(key).is_none() {
                let _ = params.set(key, Value::from(value));
            }
        }
        let state = State {
            params,
            ..State::default()
        };
        Self {
            inner: Arc::new(Inner {
                uri: options.uri,
                run_id,
                limits: options.limits,
                state: Mutex::new(state),
                generation: watch::Sender::new(0),
                notifier: Notifier::default(),
                lending: Lending::default(),
                sockets: OnceLock::new(),
            }),
        }
    }

    /// Serves nodes until dropped. `sockets` is where nodes are called back; the first call's is kept.
    pub async fn serve(&self, listener: TcpListener, sockets: Arc<dyn Sockets>) {
        let _ = self.inner.sockets.set(sockets);
        let handler = Arc::new(api::Api {
            master: self.inner.clone(),
        });
        xmlrpc::serve(listener, handler, self.inner.limits.clone()).await;
    }

    /// To be called when any process of the nodes' host has exited: finds the nodes that nobody answers for any
    /// more and drops their registrations. Returns their names.
    pub async fn process_exited(&self) -> Vec<String> {
        probe::drop_dead(&self.inner).await
    }

    /// What nodes have registered.
    pub fn graph(&self) -> Graph {
        self.inner.graph()
    }

    /// The graph's generation, now and as it grows.
    pub fn generation(&self) -> watch::Receiver<u64> {
        self.inner.generation.subscribe()
    }

    /// What identifies this Master from its first start on; also parameter `/run_id`.
    pub fn run_id(&self) -> &str {
        &self.inner.run_id
    }
}

impl Inner {
    fn sockets(&self) -> Arc<dyn Sockets> {
        let sockets = self.sockets.get().cloned();
        sockets.unwrap_or_else(|| Arc::new(LoopbackSockets))
    }

    fn graph(&self) -> Graph {
        let state = self.state.lock();
        let owned = |(name, text): (&str, &str)| (name.to_owned(), text.to_owned());
        let uses = state.uses.iter();
        let topics = state.registry.topics();
        let topics = topics
            .map(|(name, topic)| (name.to_owned(), topic))
            .collect();
        Graph {
            generation: *self.generation.borrow(),
            actions: actions::of_topics(&topics),
            topics,
            services: state.registry.services().map(owned).collect(),
            nodes: state.registry.nodes().map(owned).collect(),
            parameters: uses
                .map(|(key, used)| (key.clone(), used.clone()))
                .collect(),
            sought: state.sought.clone(),
            ends: BTreeMap::new(),
            enclaves: BTreeMap::new(),
        }
    }

    fn is_known(&self, api: &str) -> bool {
        self.state.lock().registry.is_known(api)
    }

    /// Changes the registry; tells whom it concerns.
    fn change<T>(self: &Arc<Self>, by: impl FnOnce(&mut State, &mut Vec<Notice>) -> T) -> T {
        let mut notices = Vec::new();
        let mut state = self.state.lock();
        let before = state.registry.version();
        let result = by(&mut state, &mut notices);
        // Both while the state is locked: neither notices nor generations may overtake each other.
        if state.registry.version() != before {
            self.grow();
        }
        Notifier::send(self, notices);
        drop(state);
        result
    }

    fn grow(&self) {
        self.generation.send_modify(|generation| *generation += 1);
    }

    /// Remembers that `node` used a parameter.
    fn note_use(self: &Arc<Self>, state: &mut State, key: &str, node: &str, written: bool) {
        if state.uses.len() >= MAX_USES && !state.uses.contains_key(key) {
            return;
        }
        let used = state.uses.entry(key.to_owned()).or_default();
        let nodes = if written {
            &mut used.written_by
        } else {
            &mut used.read_by
        };
        if nodes.len() < MAX_USERS && nodes.iter().all(|known| known != node) {
            nodes.push(node.to_owned());
            if !std::mem::replace(&mut state.uses_changed, true) {
                let master = Arc::clone(self);
                tokio::spawn(async move {
                    tokio::time::sleep(USES_TOGETHER).await;
                    let mut state = master.state.lock();
                    state.uses_changed = false;
                    master.grow();
                });
            }
        }
    }

    /// About how many bytes the graph takes; more than its share have only the parameters.
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

/// Remembers that `node` looked for a service in vain; whether that is news.
fn note_sought(sought: &mut BTreeMap<String, Vec<String>>, service: &str, node: &str) -> bool {
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

/// Random enough to tell two Masters apart, in the shape of a UUID as roslaunch makes it.
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
