//! A servant whose nodes are tasks.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, SystemTime};

use api::KeptLog;
use async_trait::async_trait;
use parking_lot::Mutex;
use ros::bus::Graph;
use ros::sizes::InputSizes;
use servant::Error;
use servant::engine::{ContainerState, EnforcedLimits, LogLine, LogStart, NodeEvent, NodeExit, ServantHandle, Usage};
use servant::spec::{Limits, NodeSpec, Size, Spec};
use tokio::sync::{broadcast, mpsc, watch};

use crate::engine::EngineState;
use crate::memory_bus::MemorySystem;
use crate::process::Process;

/// Capacity for events of a slow receiver, and for queued log lines.
const AHEAD: usize = 256;

/// A servant of a [`MemoryEngine`](crate::MemoryEngine).
pub struct MemoryServant {
    id: String,
    world: Weak<EngineState>,
    state: watch::Sender<ContainerState>,
    events: broadcast::Sender<NodeEvent>,
    limits: watch::Sender<Limits>,
    nodes: watch::Sender<BTreeMap<String, MemoryNodeState>>,
    log: watch::Sender<Vec<LogLine>>,
    oom_kills: Mutex<u64>,
    /// Number of running tasks of nodes.
    tasks: watch::Sender<usize>,
    pub(crate) graph: watch::Sender<Arc<Graph>>,
    /// Sizes of the messages that its robot sends.
    pub inputs: InputSizes,
    /// Messages between rosbridge clients and its nodes so far: inputs and outputs.
    pub flow: Mutex<(u64, u64)>,
    /// Reports to these clients.
    pub reported: Mutex<Vec<String>>,
    /// True while its shim does not respond.
    pub stuck: watch::Sender<bool>,
    /// ROS system in which services of its nodes are called.
    pub(crate) system: Arc<MemorySystem>,
}

/// State of a node.
#[derive(Default)]
struct MemoryNodeState {
    starts: u32,
    /// Sender for signals and out-of-memory kills of the running task; `None` if the node is not running.
    running: Option<mpsc::UnboundedSender<NodeExit>>,
    exit: Option<NodeExit>,
    held: u64,
    /// True if the node is not restarted and its end ends nothing else.
    for_good: bool,
}

/// Counts a running task until drop.
struct TaskGuard(Arc<MemoryServant>);

impl TaskGuard {
    fn begin(servant: &Arc<MemoryServant>) -> TaskGuard {
        servant.tasks.send_modify(|tasks| *tasks += 1);
        TaskGuard(Arc::clone(servant))
    }
}

impl Drop for TaskGuard {
    fn drop(&mut self) {
        self.0.tasks.send_modify(|tasks| *tasks -= 1);
    }
}

fn exit(code: Option<i32>, signal: Option<i32>) -> NodeExit {
    NodeExit { code, signal, out_of_memory: false, exec_error: None }
}

impl MemoryServant {
    pub(crate) fn new(spec: &Spec, world: Weak<EngineState>) -> Arc<MemoryServant> {
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
            inputs: InputSizes::default(),
            flow: Mutex::default(),
            reported: Mutex::default(),
            stuck: watch::Sender::new(false),
            system: Arc::default(),
        })
    }

    /// Hides its state, as a shim does that has not answered the next daemon, or tells it.
    pub fn hide_state(&self, is_hidden: bool) {
        self.state.send_replace(if is_hidden { ContainerState::Creating } else { ContainerState::Running });
    }

    /// Ends it like a broken container.
    pub fn fail(&self, reason: &str) {
        self.end(ContainerState::Failed { reason: reason.to_owned() });
    }

    /// Ends it like the end of its nodes, without a monitor.
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

    fn ended_error(&self) -> Error {
        let reason = match &*self.state.borrow() {
            ContainerState::Stopped { reason } | ContainerState::Failed { reason } => reason.clone(),
            _ => "it does not run".to_owned(),
        };
        Error::Ended { id: self.id.clone(), reason }
    }

    /// Waits until its shim responds.
    async fn wait_until_responsive(&self) {
        let mut stuck = self.stuck.subscribe();
        let _ = stuck.wait_for(|is_stuck| !is_stuck).await;
    }

    /// Ends it on request, and waits for the tasks of its nodes.
    async fn wait_until_ended(&self) {
        self.wait_until_responsive().await;
        self.end(ContainerState::Stopped { reason: "it was stopped".to_owned() });
        let mut tasks = self.tasks.subscribe();
        let _ = tasks.wait_for(|tasks| *tasks == 0).await;
    }

    fn check_runs(&self) -> Result<(), Error> {
        if self.state.borrow().is_over() { Err(self.ended_error()) } else { Ok(()) }
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

    /// Allocates memory; kills the node and returns false if the servant has too little left.
    pub(crate) fn allocate(&self, name: &str, bytes: u64) -> bool {
        let limit = self.limits.borrow().memory.map_or(u64::MAX, |size| size.0);
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
                let _ = running.send(NodeExit { out_of_memory: true, ..exit(None, Some(libc::SIGKILL)) });
            }
        });
        fits
    }

    /// Starts a node and monitors it.
    pub(crate) fn run(self: &Arc<Self>, node: NodeSpec) -> Result<(), Error> {
        let path = node.argv.first().cloned().unwrap_or_default();
        let world = self.world.upgrade().ok_or_else(|| self.ended_error())?;
        let Some(program) = world.program(&path) else {
            let reason = format!("there is no program {path}");
            self.record_node_end(
                &node.name,
                NodeExit { exec_error: Some(reason.clone()), ..exit(None, None) },
                NodeEvent::ExecFailed { node: node.name.clone(), reason: reason.clone() },
            );
            return Err(Error::Refused { id: self.id.clone(), reason });
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
        let task = TaskGuard::begin(self);
        world.runtime.spawn(async move {
            let _task = task;
            let process = Process { servant: Arc::clone(&servant), node: node.clone(), start };
            let mut state = servant.state.subscribe();
            let exit = tokio::select! {
                biased;
                _ = state.wait_for(ContainerState::is_over) => return,
                Some(exit) = killed.recv() => exit,
                code = program(process) => exit(Some(code), None),
            };
            servant.on_node_exit(node, exit).await;
        });
        Ok(())
    }

    async fn on_node_exit(self: &Arc<Self>, node: NodeSpec, exit: NodeExit) {
        let name = node.name.clone();
        let event = NodeEvent::Exited {
            node: name.clone(),
            code: exit.code,
            signal: exit.signal,
            out_of_memory: exit.out_of_memory,
        };
        let for_good = self.record_node_end(&name, exit, event);
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
                && self.nodes.borrow().get(&node.name).is_some_and(|known| !known.for_good);
            if wanted {
                let _ = self.run(node);
            }
        }
    }

    /// Records the end of a node; returns whether it ended for good.
    fn record_node_end(&self, name: &str, exit: NodeExit, event: NodeEvent) -> bool {
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
impl ServantHandle for MemoryServant {
    fn id(&self) -> &str {
        &self.id
    }

    fn state(&self) -> watch::Receiver<ContainerState> {
        self.state.subscribe()
    }

    fn events(&self) -> broadcast::Receiver<NodeEvent> {
        self.events.subscribe()
    }

    fn enforced_limits(&self) -> EnforcedLimits {
        EnforcedLimits { limits: *self.limits.borrow(), ..EnforcedLimits::default() }
    }

    async fn set_limits(&self, limits: Limits) -> Result<EnforcedLimits, Error> {
        self.wait_until_responsive().await;
        self.check_runs()?;
        let held: u64 = self.nodes.borrow().values().map(|node| node.held).sum();
        if limits.memory.is_some_and(|memory| memory < Size(held)) {
            return Err(Error::Refused { id: self.id.clone(), reason: format!("{held} bytes of memory are in use") });
        }
        let lifted = Limits { cpus: None, cpu_weight: None, ..Limits::unlimited(0.0) };
        self.limits.send_modify(|known| *known = limits.or(*known).without_equal(lifted));
        Ok(self.enforced_limits())
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
        let world = self.world.upgrade().ok_or_else(|| self.ended_error())?;
        let this = world.servant(&self.id).ok_or_else(|| self.ended_error())?;
        let running = |nodes: &BTreeMap<String, MemoryNodeState>| {
            let known = nodes.get(&node.name);
            known.is_some_and(|known| known.running.is_some())
        };
        if running(&self.nodes.borrow()) {
            return Err(Error::Refused { id: self.id.clone(), reason: format!("{} runs already", node.name) });
        }
        this.run(node)
    }

    async fn signal_node(&self, node: &str, signal: i32) -> Result<(), Error> {
        self.wait_until_responsive().await;
        let nodes = self.nodes.borrow();
        let known = nodes.get(node).ok_or_else(|| Error::NoNode { id: self.id.clone(), node: node.to_owned() })?;
        match &known.running {
            // No program sets a handler for it.
            Some(running) => {
                let _ = running.send(exit(None, Some(signal)));
                Ok(())
            }
            None => Err(Error::Refused { id: self.id.clone(), reason: format!("{node} does not run") }),
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
        let no_node = || Error::NoNode { id: self.id.clone(), node: node.to_owned() };
        let ended = nodes.wait_for(|nodes| {
            let known = nodes.get(node);
            known.is_none_or(|known| known.exit.is_some())
        });
        let nodes = ended.await.map_err(|_| self.ended_error())?;
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

    async fn keep_log(&self, about: KeptLog) -> Result<KeptLog, Error> {
        self.wait_until_ended().await;
        let world = self.world.upgrade().ok_or_else(|| self.ended_error())?;
        Ok(world.keep_log(about, self.log.borrow().clone()))
    }

    async fn stop(&self) -> Result<(), Error> {
        self.wait_until_ended().await;
        if let Some(world) = self.world.upgrade() {
            world.forget(&self.id);
        }
        Ok(())
    }
}
