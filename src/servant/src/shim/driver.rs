//! The shim's event loop. Everything that happens enters one queue; this one task changes the servant's state.

use std::collections::BTreeMap;
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::time::Duration;

use init::{Reply, Scope, Stage, StartRequest};
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::Pid;
use tokio::io::AsyncReadExt;
use tokio::net::unix::pipe;
use tokio::net::{UnixListener, UnixStream};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;
use tokio::task::LocalSet;

use super::begin::Begun;
use super::clients::Clients;
use super::create::Creator;
use super::link::Link;
use super::nodes::{self, Consequence, Nodes};
use super::streams::Streams;
use super::{Resident, ResidentContext, memory, privileges};
use crate::engine::{ContainerState, Enforced, NodeEvent, NodeExit};
use crate::launch::{self, Exit};
use crate::protocol::{Command, FromShim, Request};
use crate::spec::NodeSpec;
use crate::{Error, cgroup, logs, process, sys};

/// How long libcontainer and init may take. Generous: a loaded machine is no failure.
const CREATION: Duration = Duration::from_secs(60);
/// How long a killed pid namespace may take to be gone.
const KILLED: Duration = Duration::from_secs(5);
/// How long the rest of the log may take once nobody can write to it.
const DRAIN: Duration = Duration::from_secs(2);
/// How long a cgroup may take to become empty.
const PATIENCE: Duration = Duration::from_secs(10);

/// What happens.
#[derive(Debug)]
pub(super) enum Input {
    /// A daemon connected.
    Connected(UnixStream),
    /// It asked.
    Request(u64, Request),
    /// It left.
    Disconnected(u64),
    /// Init said something.
    Init(Reply, Option<OwnedFd>),
    /// A child of ours was reaped: init, or what the creator left.
    Reaped(i32, i32),
    /// A node's delay is over.
    Respawn(String),
    /// A stage of the stop has lasted long enough.
    Patience(StopStage),
    /// We were asked to end.
    Terminate,
}

/// The stages of a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum StopStage {
    Interrupt,
    Terminate,
    Kill,
    /// Killed, and yet not gone.
    Insist,
}

struct Driver {
    begun: Begun,
    inputs: mpsc::UnboundedSender<Input>,
    queue: mpsc::UnboundedReceiver<Input>,
    clients: Clients,
    nodes: Nodes,
    link: Link,
    streams: Streams,
    resident: Box<dyn Resident>,
    state: ContainerState,
    /// The init process, once there is one.
    init: Option<(i32, OwnedFd)>,
    stopping: Option<StopStage>,
    /// How it is to end, once that is decided.
    verdict: Option<ContainerState>,
    oom_seen: u64,
    /// Who waits for the answer to a start, by its number.
    waiting: BTreeMap<u32, (u64, u64)>,
    /// Signals for nodes that are being started.
    early_signals: Vec<(String, i32)>,
}

/// Runs until the servant has ended.
pub(super) fn drive(begun: Begun, resident: Box<dyn Resident>) -> Result<(), Error> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .enable_time()
        .event_interval(31)
        .build()
        .map_err(Error::call("making an event loop"))?;
    LocalSet::new().block_on(&runtime, async {
        let mut driver = Driver::new(begun, resident)?;
        driver.run().await;
        driver.finish().await
    })
}

impl Driver {
    fn new(begun: Begun, resident: Box<dyn Resident>) -> Result<Self, Error> {
        let (inputs, queue) = mpsc::unbounded_channel();
        let clients = Clients::new(inputs.clone());
        let listener = begun.listener.try_clone().and_then(|listener| {
            listener.set_nonblocking(true)?;
            UnixListener::from_std(listener)
        });
        clients.accept(listener.map_err(Error::call("listening for daemons"))?);
        let control = begun.control.try_clone().and_then(|control| {
            control.set_nonblocking(true)?;
            UnixStream::from_std(control)
        });
        let control = control.map_err(Error::call("talking to the daemon"))?;
        let log = begun.directory.join(logs::FILE);
        let log = logs::Writer::create(&log, logs::ROTATE_AT).map_err(Error::file("make", &log))?;
        let init = begun
            .init
            .try_clone()
            .map_err(Error::call("dup of init's socket"))?;
        watch_signals(&inputs).map_err(Error::call("watching signals"))?;
        let _ = inputs.send(Input::Connected(control));
        Ok(Self {
            clients,
            nodes: Nodes::default(),
            link: Link::new(init).map_err(Error::call("watching init's socket"))?,
            streams: Streams::new(log),
            resident,
            state: ContainerState::Creating,
            init: None,
            stopping: None,
            verdict: None,
            oom_seen: 0,
            waiting: BTreeMap::new(),
            early_signals: Vec::new(),
            begun,
            inputs,
            queue,
        })
    }

    async fn run(&mut self) {
        if let Err(reason) = self.come_up().await {
            self.verdict = Some(ContainerState::Failed { reason });
            self.kill();
            if self.init.is_none() {
                return;
            }
        }
        while let Some(input) = self.queue.recv().await {
            if self.handle(input).await {
                return;
            }
        }
    }

    /// Resident, container, nodes.
    async fn come_up(&mut self) -> Result<(), String> {
        let context = ResidentContext {
            id: self.begun.launch.spec.id.clone(),
            config: self.begun.launch.spec.resident.clone(),
            directory: self.begun.directory.clone(),
        };
        // The creator works meanwhile, in its own process.
        let resident = self.resident.start(&context).await;
        let created = self.creation().await;
        if let Ok(pid) = created {
            // Our unreaped child, so that the number is surely its own.
            let pidfd = sys::pidfd_open(pid).map_err(|error| format!("pidfd of init: {error}"))?;
            self.init = Some((pid, pidfd));
        }
        let init = created?;
        resident.map_err(|error| format!("its resident did not start: {error}"))?;
        privileges::drop_all_but_kill().map_err(|error| error.to_string())?;
        let ready = tokio::time::timeout(CREATION, self.link.receive()).await;
        match ready {
            Ok(Ok(Some((Reply::Ready, _)))) => {}
            Ok(Ok(other)) => return Err(format!("init did not come up but said {other:?}")),
            Ok(Err(error)) => return Err(format!("init did not come up: {error}")),
            Err(_) => {
                return Err(format!(
                    "init did not come up within {} s",
                    CREATION.as_secs()
                ));
            }
        }
        self.listen_to_init();
        self.set_state(ContainerState::Running { init_pid: init });
        for node in self.begun.launch.spec.nodes.clone() {
            let name = node.name.clone();
            self.nodes.add(node)?;
            self.start_node(&name).await;
        }
        // What was needed to get here is not needed to stay.
        self.begun.launch.spec.layers = Vec::new();
        self.begun.launch.spec.nodes = Vec::new();
        self.begun.launch.spec.resident = serde_json::Value::Null;
        memory::give_back();
        Ok(())
    }

    /// Waits for the creator; init's pid on the host.
    async fn creation(&mut self) -> Result<i32, String> {
        let report = self
            .begun
            .creator
            .report
            .try_clone()
            .map_err(|error| error.to_string())?;
        let set = nix::fcntl::FcntlArg::F_SETFL(nix::fcntl::OFlag::O_NONBLOCK);
        nix::fcntl::fcntl(&report, set).map_err(|error| error.to_string())?;
        let mut report =
            pipe::Receiver::from_owned_fd(report).map_err(|error| error.to_string())?;
        let mut text = Vec::new();
        let read = async {
            // A complaint may be followed by others, up to its end; success is said once.
            while !Creator::has_succeeded(&text)
                && report
                    .read_buf(&mut text)
                    .await
                    .is_ok_and(|length| length > 0)
            {}
        };
        let in_time = tokio::time::timeout(CREATION, read).await.is_ok();
        match Creator::outcome(&String::from_utf8_lossy(&text)) {
            Err(_) if !in_time && text.is_empty() => Err(format!(
                "it was not created within {} s",
                CREATION.as_secs()
            )),
            outcome => outcome,
        }
    }

    fn listen_to_init(&self) {
        let (link, inputs) = (self.link.clone(), self.inputs.clone());
        tokio::task::spawn_local(async move {
            // Its end is told by the kernel, as that of a child.
            while let Ok(Some((reply, fd))) = link.receive().await {
                if inputs.send(Input::Init(reply, fd)).is_err() {
                    return;
                }
            }
        });
    }

    /// True when the servant has ended.
    async fn handle(&mut self, input: Input) -> bool {
        match input {
            Input::Connected(stream) => self.clients.add(stream, &self.hello()),
            Input::Disconnected(client) => self.clients.remove(client),
            Input::Request(client, request) => {
                if let Some(outcome) = self.obey(client, request.id, request.command).await {
                    self.clients.answer(client, request.id, outcome);
                }
            }
            Input::Init(reply, fd) => self.init_said(reply, fd).await,
            Input::Reaped(pid, status) => {
                if self.init.as_ref().is_some_and(|(init, _)| *init == pid) {
                    self.init_ended(status);
                    return true;
                }
            }
            Input::Respawn(name) => self.respawn(&name).await,
            Input::Patience(stage) if self.stopping == Some(stage) => self.next_stage().await,
            Input::Patience(_) => {}
            Input::Terminate => self.stop("the shim was asked to end").await,
        }
        false
    }

    /// None: the answer comes later.
    async fn obey(
        &mut self,
        client: u64,
        request: u64,
        command: Command,
    ) -> Option<Result<(), String>> {
        match command {
            Command::Stop => {
                self.stop("stopped").await;
                Some(Ok(()))
            }
            _ if self.stopping.is_some() || self.init.is_none() => Some(Err("it is ending".into())),
            Command::StartNode(node) => {
                let name = node.name.clone();
                if let Err(reason) = self.nodes.add(node) {
                    return Some(Err(reason));
                }
                let (number, spec) = self.nodes.start(&name)?;
                self.waiting.insert(number, (client, request));
                self.ask_for(number, &spec).await;
                None
            }
            Command::SignalNode { node, signal } if self.nodes.is_starting(&node) => {
                self.early_signals.push((node, signal));
                Some(Ok(()))
            }
            Command::SignalNode { node, signal } => Some(self.signal(&node, signal).await),
            Command::SetLimits(limits) => {
                let enforced = self.begun.cgroup.set(&limits);
                self.begun.enforced = enforced.clone();
                self.clients.tell(&FromShim::Enforced {
                    enforced: enforced.clone(),
                });
                Some(match cgroup::unmet(&limits, &enforced).as_slice() {
                    [] => Ok(()),
                    unmet => Err(format!("cannot be set: {}", unmet.join(", "))),
                })
            }
        }
    }

    async fn signal(&self, node: &str, signal: i32) -> Result<(), String> {
        let pid = self.nodes.inside(node)?;
        self.link
            .signal(pid, signal, Scope::Group)
            .await
            .map_err(|error| error.to_string())
    }

    async fn start_node(&mut self, name: &str) {
        if let Some((number, spec)) = self.nodes.start(name) {
            self.ask_for(number, &spec).await;
        }
    }

    async fn ask_for(&mut self, number: u32, spec: &NodeSpec) {
        if let Err(reason) = self.ask_init(number, spec).await {
            self.start_failed(number, reason).await;
        }
    }

    async fn ask_init(&mut self, number: u32, spec: &NodeSpec) -> Result<(), String> {
        let open = |stream| {
            self.streams
                .open(&spec.name, stream)
                .map_err(|error| error.to_string())
        };
        let (out, err) = (open("stdout")?, open("stderr")?);
        let mut environment = self.begun.launch.spec.environment.clone();
        environment.extend(spec.environment.clone());
        let environment: Vec<String> = environment
            .iter()
            .map(|(name, value)| format!("{name}={value}"))
            .collect();
        let request = StartRequest {
            id: number,
            identity: None,
            directory: &spec.directory,
            argv: &spec.argv,
            environment: &environment,
        };
        let streams = [out.as_raw_fd(), err.as_raw_fd()];
        self.link
            .start(&request, streams)
            .await
            .map_err(|error| error.to_string())
    }

    async fn respawn(&mut self, name: &str) {
        if self.stopping.is_none() {
            self.start_node(name).await;
        }
    }

    async fn init_said(&mut self, reply: Reply, fd: Option<OwnedFd>) {
        match reply {
            Reply::Ready => {}
            Reply::Started { id, pid } => {
                // Gone already: then its number on the host is of no use to anybody.
                let host = fd.as_ref().and_then(process::pid_of).unwrap_or(0);
                if let Some(event) = self.nodes.started(id, pid, host) {
                    self.tell_node(event.clone());
                    self.answer_start(id, Ok(()));
                    self.deliver_early_signals(event.node()).await;
                }
                if self.stopping.is_some() {
                    // It was on its way when the stop began.
                    let _ = self.link.signal(pid, libc::SIGINT, Scope::Group).await;
                }
            }
            Reply::Failed { id, errno, stage } => {
                self.start_failed(id, describe(errno, stage)).await
            }
            Reply::Exited { pid, status } => {
                self.resident.process_exited(pid);
                let exit = nodes::exit_of(status, self.was_out_of_memory(status));
                if let Some((event, consequence)) = self.nodes.exited(pid, exit.clone()) {
                    self.tell_node(event.clone());
                    self.follow_up(event.node(), consequence, &exit).await;
                }
            }
        }
    }

    fn answer_start(&mut self, number: u32, outcome: Result<(), String>) {
        if let Some((client, request)) = self.waiting.remove(&number) {
            self.clients.answer(client, request, outcome);
        }
    }

    async fn deliver_early_signals(&mut self, started: &str) {
        let (now, later) = std::mem::take(&mut self.early_signals)
            .into_iter()
            .partition(|(node, _)| node == started);
        self.early_signals = later;
        let now: Vec<(String, i32)> = now;
        for (node, signal) in now {
            // It has ended already: then there is nobody to signal.
            let _ = self.signal(&node, signal).await;
        }
    }

    /// Whether this end goes with a kill that the kernel has counted since the last one. A shell tells 137 for a child that was
    /// killed.
    fn was_out_of_memory(&mut self, status: i32) -> bool {
        let killed = libc::WIFSIGNALED(status) && libc::WTERMSIG(status) == libc::SIGKILL
            || libc::WIFEXITED(status) && libc::WEXITSTATUS(status) == 128 + libc::SIGKILL;
        if !killed {
            return false;
        }
        let counted = self.begun.cgroup.oom_kills();
        let more = counted > self.oom_seen;
        self.oom_seen = counted;
        more
    }

    async fn start_failed(&mut self, number: u32, reason: String) {
        if let Some((event, consequence)) = self.nodes.failed(number, reason.clone()) {
            self.tell_node(event.clone());
            self.answer_start(number, Err(reason.clone()));
            self.early_signals.retain(|(node, _)| node != event.node());
            let exit = NodeExit {
                code: None,
                signal: None,
                out_of_memory: false,
                exec_error: Some(reason),
            };
            self.follow_up(event.node(), consequence, &exit).await;
        }
    }

    async fn follow_up(&mut self, node: &str, consequence: Consequence, exit: &NodeExit) {
        if self.stopping.is_some() {
            // The last one has gone: no reason to wait on.
            if self.nodes.alive() == (vec![], 0) {
                self.enter_stage(StopStage::Kill).await;
            }
            return;
        }
        match consequence {
            Consequence::None => {}
            Consequence::Respawn(delay) => {
                self.tell_node(NodeEvent::Respawning { node: node.into() });
                let (inputs, name) = (self.inputs.clone(), node.to_owned());
                tokio::task::spawn_local(async move {
                    tokio::time::sleep(Duration::from_secs_f64(delay)).await;
                    let _ = inputs.send(Input::Respawn(name));
                });
            }
            Consequence::EndServant => {
                let state = self.verdict_on(node, exit);
                self.verdict = Some(state);
                self.stop("").await;
            }
        }
    }

    fn verdict_on(&self, node: &str, exit: &NodeExit) -> ContainerState {
        let how = match exit {
            NodeExit {
                exec_error: Some(reason),
                ..
            } => {
                return ContainerState::Failed {
                    reason: format!("required node {node} could not be started: {reason}"),
                };
            }
            NodeExit {
                out_of_memory: true,
                ..
            } => {
                let limit = self.memory_limit();
                return ContainerState::Failed {
                    reason: format!("required node {node} was killed: {limit}"),
                };
            }
            NodeExit {
                signal: Some(signal),
                ..
            } => format!("was killed by signal {signal}"),
            NodeExit { code, .. } => format!("exited with status {}", code.unwrap_or(0)),
        };
        ContainerState::Stopped {
            reason: format!("required node {node} {how}"),
        }
    }

    fn memory_limit(&self) -> String {
        match self.begun.enforced.limits.memory {
            Some(bytes) => format!("out of memory, the limit is {bytes} bytes"),
            None => "out of memory".into(),
        }
    }

    /// Begins to end the servant; a second call changes nothing.
    async fn stop(&mut self, reason: &str) {
        if self.stopping.is_some() || self.init.is_none() {
            return;
        }
        self.verdict.get_or_insert_with(|| ContainerState::Stopped {
            reason: reason.into(),
        });
        let first = if self.nodes.alive() == (vec![], 0) {
            StopStage::Kill
        } else {
            StopStage::Interrupt
        };
        self.enter_stage(first).await;
    }

    async fn next_stage(&mut self) {
        let next = match self.stopping {
            None | Some(StopStage::Interrupt) => StopStage::Terminate,
            Some(StopStage::Terminate) => StopStage::Kill,
            Some(StopStage::Kill | StopStage::Insist) => StopStage::Insist,
        };
        self.enter_stage(next).await;
    }

    async fn enter_stage(&mut self, stage: StopStage) {
        if self
            .stopping
            .is_some_and(|now| now >= stage && now != StopStage::Insist)
        {
            return;
        }
        self.stopping = Some(stage);
        let patience = match stage {
            StopStage::Interrupt => {
                for (_, pid) in self.nodes.alive().0 {
                    let _ = self.link.signal(pid, libc::SIGINT, Scope::Group).await;
                }
                self.begun.launch.grace.interrupt
            }
            StopStage::Terminate => {
                let _ = self.link.signal(0, libc::SIGTERM, Scope::All).await;
                self.begun.launch.grace.terminate
            }
            StopStage::Kill | StopStage::Insist => {
                self.kill();
                KILLED
            }
        };
        let inputs = self.inputs.clone();
        tokio::task::spawn_local(async move {
            tokio::time::sleep(patience).await;
            let _ = inputs.send(Input::Patience(stage));
        });
    }

    /// Kills init; the kernel then kills everything in its pid namespace, and tells us when nothing is left.
    fn kill(&mut self) {
        self.stopping = self.stopping.max(Some(StopStage::Kill));
        if let Some((_, pidfd)) = &self.init {
            // Gone already: then its end is in the queue.
            let _ = sys::pidfd_send_signal(pidfd.as_fd(), libc::SIGKILL);
        }
    }

    fn init_ended(&mut self, status: i32) {
        let asked = self.stopping.is_some();
        let out_of_memory = !asked && self.was_out_of_memory(status);
        let exit = nodes::exit_of(status, out_of_memory);
        for (_, pid) in self.nodes.alive().0 {
            let exit = NodeExit {
                code: None,
                signal: Some(libc::SIGKILL),
                out_of_memory,
                exec_error: None,
            };
            if let Some((event, _)) = self.nodes.exited(pid, exit) {
                self.tell_node(event);
            }
        }
        for number in self.nodes.starting() {
            let reason = "its init ended before it was executed".to_owned();
            if let Some((event, _)) = self.nodes.failed(number, reason.clone()) {
                self.tell_node(event);
                self.answer_start(number, Err(reason));
            }
        }
        let limit = self.memory_limit();
        self.verdict.get_or_insert_with(|| {
            let how = match exit {
                NodeExit {
                    out_of_memory: true,
                    ..
                } => format!("was killed: {limit}"),
                NodeExit {
                    signal: Some(signal),
                    ..
                } => format!("was killed by signal {signal}"),
                NodeExit { code, .. } => format!("exited with status {}", code.unwrap_or(0)),
            };
            ContainerState::Failed {
                reason: format!("its init {how}"),
            }
        });
        self.init = None;
    }

    /// Leaves nothing but the directory.
    async fn finish(&mut self) -> Result<(), Error> {
        // With the namespace gone nobody holds the other ends of the pipes, unless they were sent out of it.
        let _ = tokio::time::timeout(DRAIN, self.streams.drained()).await;
        let removed = self.begun.cgroup.destroy(PATIENCE);
        let fallback = ContainerState::Stopped {
            reason: "stopped".into(),
        };
        let mut state = self.verdict.take().unwrap_or(fallback);
        if let Err(error) = &removed {
            state = ContainerState::Failed {
                reason: error.to_string(),
            };
        }
        let exit = Exit {
            state: state.clone(),
            nodes: self.nodes.statuses(),
        };
        let written = launch::write(&self.begun.directory.join(launch::EXIT), &exit);
        // A daemon that connected just now is told, too.
        while let Ok(input) = self.queue.try_recv() {
            if let Input::Connected(stream) = input {
                self.clients.add(stream, &self.hello());
            }
        }
        self.set_state(state);
        let _ = tokio::time::timeout(DRAIN, self.clients.flush()).await;
        removed.and(written)
    }

    fn set_state(&mut self, state: ContainerState) {
        self.state = state.clone();
        self.clients.tell(&FromShim::State { state });
    }

    fn tell_node(&self, event: NodeEvent) {
        let status = self.nodes.status(event.node());
        self.clients.tell(&FromShim::Node { event, status });
    }

    fn hello(&self) -> FromShim {
        FromShim::Hello {
            shim: self.begun.identity,
            state: self.state.clone(),
            nodes: self.nodes.statuses(),
            enforced: Enforced {
                ..self.begun.enforced.clone()
            },
        }
    }
}

fn describe(errno: i32, stage: Stage) -> String {
    let error = std::io::Error::from_raw_os_error(errno);
    match stage {
        Stage::Execute => format!("its program could not be executed: {error}"),
        Stage::Directory => format!("its working directory could not be entered: {error}"),
        Stage::Fork => format!("fork: {error}"),
        Stage::Request | Stage::Prepare | Stage::Identity => {
            format!("init could not prepare it: {error}")
        }
    }
}

/// Children end, and somebody may ask us to.
fn watch_signals(inputs: &mpsc::UnboundedSender<Input>) -> std::io::Result<()> {
    let mut children = signal(SignalKind::child())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let inputs = inputs.clone();
    tokio::task::spawn_local(async move {
        loop {
            // First without waiting: a child may have ended before we watched.
            while let Ok(status) = waitpid(None::<Pid>, Some(WaitPidFlag::WNOHANG)) {
                let (pid, raw) = match status {
                    WaitStatus::Exited(pid, code) => (pid, code << 8),
                    WaitStatus::Signaled(pid, signal, _) => (pid, signal as i32),
                    WaitStatus::StillAlive => break,
                    _ => continue,
                };
                let _ = inputs.send(Input::Reaped(pid.as_raw(), raw));
            }
            tokio::select! {
                _ = children.recv() => {}
                _ = terminate.recv() => {
                    let _ = inputs.send(Input::Terminate);
                }
            }
        }
    });
    Ok(())
}
