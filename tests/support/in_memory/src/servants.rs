//! A servant: its nodes are tasks.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, SystemTime};

use async_trait::async_trait;
use parking_lot::Mutex;
use ros::bus::Graph;
use ros::sizes::Inputs;
use servant::Error;
use servant::engine::{
    ContainerState, Enforced, LogLine, LogStart, NodeEvent, NodeExit, Servant, Usage,
};
use servant::spec::{Limits, NodeSpec, Spec, UNLIMITED};
use tokio::sync::{broadcast, mpsc, watch};

use crate::engine::World;
use crate::memory_bus::MemorySystem;
use crate::process::Process;

/// Events that a slow listener may be behind, and lines that may wait for a reader.
const AHEAD: usize = 256;

/// A servant of a [`MemoryEngine`](crate::MemoryEngine).
pub struct MemoryServant {
    id: String,
    world: Weak<World>,
    state: watch::Sender<ContainerState>,
    events: broadcast::Sender<NodeEvent>,
    limits: watch::Sender<Limits>,
    nodes: watch::Sender<BTreeMap<String, Node>>,
    log: watch::Sender<Vec<LogLine>>,
    oom_kills: Mutex<u64>,
    /// Tasks of nodes.
    tasks: watch::Sender<usize>,
    pub(crate) graph: watch::Sender<Arc<Graph>>,
    /// How large what its robot sends is.
    pub inputs: Inputs,
    /// What rosbridge clients gave its nodes and had of them so far: inputs and outputs.
    pub flow: Mutex<(u64, u64)>,
    /// What these clients were told of it.
    pub reported: Mutex<Vec<String>>,
    /// Its shim answers nothing while this is so.
    pub stuck: watch::Sender<bool>,
    /// Where services of its nodes are called.
    pub(crate) system: Arc<MemorySystem>,
}

/// What is known of a node.
#[derive(Default)]
struct Node {
    starts: u32,
    /// Of the one that runs: to be told of a signal, or killed for memory.
    running: Option<mpsc::UnboundedSender<NodeExit>>,
    exit: Option<NodeExit>,
    held: u64,
    /// It is not started again, and nothing ends with it.
    for_good: bool,
}

/// Counts one more task in, until it is dropped.
struct Task(Arc<MemoryServant>);

impl Task {
    fn begin(servant: &Arc<MemoryServant>) -> Task {
        servant.tasks.send_modify(|tasks| *tasks += 1);
        Task(Arc::clone(servant))
    }
}

impl Drop for Task {
    fn drop(&mut self) {
        self.0.tasks.send_modify(|tasks| *tasks -= 1);
    }
}

fn exit(code: Option<i32>, signal: Option<i32>) -> NodeExit {
    NodeExit {
        code,
        signal,
        out_of_memory: false,
        exec_error: None,
    }
}

impl MemoryServant {
    pub(crate) fn new(spec: &Spec, world: Weak<World>) -> Arc<MemoryServant> {
        Arc::new(MemoryServant {
            id: spec.id.clone(),
            world,
            state: watch::Sender::new(ContainerState::Running),
            events: broadcast::Sender::new(AHEAD),
            limits: watch::Sender::new(spec.limits),
            nodes: watch::Sender::default(),
            log: watch::Sender::default(),
            oom_kills: Mutex::default(),
            tasks: watch::Sender::default(),
            graph: watch::Sender::default(),
            inputs: Inputs::default(),
            flow: Mutex::default(),
            reported: Mutex::default(),
            stuck: watch::Sender::new(false),
            system: Arc::default(),
        })
    }

    /// Ends it as a container that broke.
    pub fn fail(&self, reason: &str) {
        self.end(ContainerState::Failed {
            reason: reason.to_owned(),
        });
    }

    /// Ends it while nobody watches, as its nodes would.
    fn end(&self, state: ContainerState) {
        let first = self.state.send_if_modified(|known| {
            let first = !known.is_over();
            if first {
                *known = state;
            }
            first
        });
        if first {
            self.nodes.send_modify(|nodes| {
                for node in nodes.values_mut().filter(|node| node.running.is_some()) {
                    node.running = None;
                    node.exit = Some(exit(None, Some(libc::SIGKILL)));
                }
            });
        }
    }

    fn ended(&self) -> Error {
        let reason = match &*self.state.borrow() {
            ContainerState::Stopped { reason } | ContainerState::Failed { reason } => {
                reason.clone()
            }
            _ => "it does not run".to_owned(),
        };
        Error::Ended {
            id: self.id.clone(),
            reason,
        }
    }

    /// Its shim answers.
    async fn answers(&self) {
        let mut stuck = self.stuck.subscribe();
        let _ = stuck.wait_for(|is_stuck| !is_stuck).await;
    }

    fn check_runs(&self) -> Result<(), Error> {
        match self.state.borrow().is_over() {
            true => Err(self.ended()),
            false => Ok(()),
        }
    }

    pub(crate) fn print(&self, node: &str, line: &str) {
        self.log.send_modify(|log| {
            log.push(LogLine {
                number: Some(log.len() as u64),
                time: SystemTime::now(),
                node: node.to_owned(),
                stream: "stdout".to_owned(),
                line: line.to_owned(),
            });
        });
    }

    /// Whether the servant has so much left; else the node is killed.
    pub(crate) fn allocate(&self, name: &str, bytes: u64) -> bool {
        let limit = self.limits.borrow().memory.unwrap_or(u64::MAX);
        let mut fits = true;
        self.nodes.send_modify(|nodes| {
            let held: u64 = nodes.values().map(|node| node.held).sum();
            let Some(node) = nodes.get_mut(name) else {
                return;
            };
            fits = held + bytes <= limit;
            if fits {
                node.held += bytes;
            } else if let Some(running) = &node.running {
                *self.oom_kills.lock() += 1;
                let _ = running.send(NodeExit {
                    out_of_memory: true,
                    ..exit(None, Some(libc::SIGKILL))
                });
            }
        });
        fits
    }

    /// Starts a node and looks after it.
    pub(crate) fn run(self: &Arc<Self>, node: NodeSpec) -> Result<(), Error> {
        let path = node.argv.first().cloned().unwrap_or_default();
        let world = self.world.upgrade().ok_or_else(|| self.ended())?;
        let Some(program) = world.program(&path) else {
            let reason = format!("there is no program {path}");
            self.over(
                &node.name,
                NodeExit {
                    exec_error: Some(reason.clone()),
                    ..exit(None, None)
                },
                NodeEvent::ExecFailed {
                    node: node.name.clone(),
                    reason: reason.clone(),
                },
            );
            return Err(Error::Refused {
                id: self.id.clone(),
                reason,
            });
        };
        let (kill, mut killed) = mpsc::unbounded_channel();
        let mut start = 0;
        self.nodes.send_modify(|nodes| {
            let known = nodes.entry(node.name.clone()).or_default();
            known.starts += 1;
            (known.running, known.exit, start) = (Some(kill), None, known.starts);
        });
        let name = node.name.clone();
        let _ = self.events.send(NodeEvent::Started { node: name });
        let servant = Arc::clone(self);
        let task = Task::begin(self);
        world.runtime.spawn(async move {
            let _task = task;
            let process = Process {
                servant: Arc::clone(&servant),
                node: node.clone(),
                start,
            };
            let mut state = servant.state.subscribe();
            let exit = tokio::select! {
                biased;
                _ = state.wait_for(ContainerState::is_over) => return,
                Some(exit) = killed.recv() => exit,
                code = program(process) => exit(Some(code), None),
            };
            servant.exited(node, exit).await;
        });
        Ok(())
    }

    async fn exited(self: &Arc<Self>, node: NodeSpec, exit: NodeExit) {
        let name = node.name.clone();
        let event = NodeEvent::Exited {
            node: name.clone(),
            code: exit.code,
            signal: exit.signal,
            out_of_memory: exit.out_of_memory,
        };
        let for_good = self.over(&name, exit, event);
        if for_good || self.state.borrow().is_over() {
            return;
        }
        if node.required {
            let reason = format!("{name} ended, which it needs");
            return self.end(ContainerState::Stopped { reason });
        }
        if node.respawn {
            let _ = self.events.send(NodeEvent::Respawning { node: name });
            let delay = Duration::from_secs_f64(node.respawn_delay);
            let mut state = self.state.subscribe();
            let over = state.wait_for(ContainerState::is_over);
            let wanted = tokio::time::timeout(delay, over).await.is_err()
                && self
                    .nodes
                    .borrow()
                    .get(&node.name)
                    .is_some_and(|known| !known.for_good);
            if wanted {
                let _ = self.run(node);
            }
        }
    }

    /// Notes the end of a node; whether it is for good.
    fn over(&self, name: &str, exit: NodeExit, event: NodeEvent) -> bool {
        self.graph.send_modify(|graph| {
            let mut next = Graph::clone(graph);
            next.generation += 1;
            next.nodes.remove(name);
            for ends in next.topics.values_mut() {
                ends.publishers.retain(|node| node != name);
            }
            next.services.retain(|_, node| node != name);
            *graph = Arc::new(next);
        });
        let mut for_good = false;
        self.nodes.send_modify(|nodes| {
            let known = nodes.entry(name.to_owned()).or_default();
            (known.running, known.exit, known.held) = (None, Some(exit), 0);
            for_good = known.for_good;
        });
        let _ = self.events.send(event);
        for_good
    }
}

#[async_trait]
impl Servant for MemoryServant {
    fn id(&self) -> &str {
        &self.id
    }

    fn state(&self) -> watch::Receiver<ContainerState> {
        self.state.subscribe()
    }

    fn events(&self) -> broadcast::Receiver<NodeEvent> {
        self.events.subscribe()
    }

    fn enforced(&self) -> Enforced {
        Enforced {
            limits: *self.limits.borrow(),
            ..Enforced::default()
        }
    }

    async fn set_limits(&self, limits: Limits) -> Result<Enforced, Error> {
        self.answers().await;
        self.check_runs()?;
        let held: u64 = self.nodes.borrow().values().map(|node| node.held).sum();
        if limits.memory.is_some_and(|memory| memory < held) {
            return Err(Error::Refused {
                id: self.id.clone(),
                reason: format!("{held} bytes of memory are in use"),
            });
        }
        self.limits.send_modify(|known| {
            let lifted = |limit: &mut Option<u64>| *limit = limit.filter(|it| *it != UNLIMITED);
            *known = limits.or(known);
            lifted(&mut known.memory);
            lifted(&mut known.memory_high);
            lifted(&mut known.pids);
            lifted(&mut known.io_read);
            lifted(&mut known.io_write);
        });
        Ok(self.enforced())
    }

    async fn usage(&self) -> Result<Usage, Error> {
        self.check_runs()?;
        let nodes = self.nodes.borrow();
        let running = nodes.values().filter(|node| node.running.is_some());
        Ok(Usage {
            memory: nodes.values().map(|node| node.held).sum(),
            pids: running.count() as u64,
            oom_kills: *self.oom_kills.lock(),
            ..Usage::default()
        })
    }

    fn nodes(&self) -> Vec<String> {
        self.nodes.borrow().keys().cloned().collect()
    }

    async fn start_node(&self, node: NodeSpec) -> Result<(), Error> {
        self.check_runs()?;
        let world = self.world.upgrade().ok_or_else(|| self.ended())?;
        let this = world.servant(&self.id).ok_or_else(|| self.ended())?;
        let running = |nodes: &BTreeMap<String, Node>| {
            let known = nodes.get(&node.name);
            known.is_some_and(|known| known.running.is_some())
        };
        if running(&self.nodes.borrow()) {
            return Err(Error::Refused {
                id: self.id.clone(),
                reason: format!("{} runs already", node.name),
            });
        }
        this.run(node)
    }

    async fn signal_node(&self, node: &str, signal: i32) -> Result<(), Error> {
        self.answers().await;
        let nodes = self.nodes.borrow();
        let known = nodes.get(node).ok_or_else(|| Error::NoNode {
            id: self.id.clone(),
            node: node.to_owned(),
        })?;
        match &known.running {
            // None of them sets a handler.
            Some(running) => {
                let _ = running.send(exit(None, Some(signal)));
                Ok(())
            }
            None => Err(Error::Refused {
                id: self.id.clone(),
                reason: format!("{node} does not run"),
            }),
        }
    }

    async fn end_node(&self, node: &str, signal: i32) -> Result<(), Error> {
        self.nodes.send_modify(|nodes| {
            if let Some(known) = nodes.get_mut(node) {
                known.for_good = true;
            }
        });
        self.signal_node(node, signal).await
    }

    async fn wait_node(&self, node: &str) -> Result<NodeExit, Error> {
        let mut nodes = self.nodes.subscribe();
        let no_node = || Error::NoNode {
            id: self.id.clone(),
            node: node.to_owned(),
        };
        let ended = nodes.wait_for(|nodes| {
            let known = nodes.get(node);
            known.is_none_or(|known| known.exit.is_some())
        });
        let nodes = ended.await.map_err(|_| self.ended())?;
        let known = nodes.get(node).ok_or_else(no_node)?;
        known.exit.clone().ok_or_else(no_node)
    }

    async fn logs(&self, last: usize, node: Option<&str>) -> Vec<LogLine> {
        let mut lines = self.log.borrow().clone();
        lines.retain(|line| node.is_none_or(|node| node == line.node));
        lines.split_off(lines.len().saturating_sub(last))
    }

    fn follow(&self, from: LogStart) -> mpsc::Receiver<LogLine> {
        let (sender, receiver) = mpsc::channel(AHEAD);
        let (mut log, mut state) = (self.log.subscribe(), self.state.subscribe());
        let printed = log.borrow().len();
        let mut next = match from {
            LogStart::First => 0,
            LogStart::Last(count) => printed.saturating_sub(count),
            LogStart::Now => printed,
        };
        tokio::spawn(async move {
            loop {
                let over = state.borrow_and_update().is_over();
                let lines: Vec<LogLine> = log.borrow_and_update()[next..].to_vec();
                next += lines.len();
                for line in lines {
                    if sender.send(line).await.is_err() {
                        return;
                    }
                }
                if over {
                    return;
                }
                tokio::select! {
                    changed = log.changed() => if changed.is_err() { return },
                    changed = state.changed() => if changed.is_err() { return },
                    () = sender.closed() => return,
                }
            }
        });
        receiver
    }

    async fn stop(&self) -> Result<(), Error> {
        self.answers().await;
        self.end(ContainerState::Stopped {
            reason: "it was stopped".to_owned(),
        });
        let mut tasks = self.tasks.subscribe();
        let _ = tasks.wait_for(|tasks| *tasks == 0).await;
        if let Some(world) = self.world.upgrade() {
            world.forget(&self.id);
        }
        Ok(())
    }
}
