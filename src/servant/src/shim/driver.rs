//! The shim's event loop. All events enter one queue; this task alone changes the servant's state.

mod coming_up;
mod ending;
mod exec;
mod node_life;

use std::collections::BTreeMap;
use std::os::fd::OwnedFd;

use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::Pid;
use tokio::net::{UnixListener, UnixStream};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;
use tokio::task::LocalSet;

use super::Resident;
use super::begin::PreparedShim;
use super::clients::DaemonConnections;
use super::command_error::CommandError;
use super::execs::ExecTable;
use super::input::{ShimEvent, StopStage};
use super::link::InitLink;
use super::nodes::NodeTable;
use super::streams::Streams;
use crate::engine::{ContainerState, EnforcedLimits, NodeEvent};
use crate::protocol::{Command, ShimMessage, Snapshot};
use crate::spec::Limits;
use crate::{Error, logs};

struct Driver {
    begun: PreparedShim,
    inputs: mpsc::UnboundedSender<ShimEvent>,
    queue: mpsc::UnboundedReceiver<ShimEvent>,
    clients: DaemonConnections,
    nodes: NodeTable,
    execs: ExecTable,
    link: InitLink,
    streams: Streams,
    resident: Box<dyn Resident>,
    state: ContainerState,
    /// Pid and pidfd of init, once it exists.
    init: Option<(i32, OwnedFd)>,
    stopping: Option<StopStage>,
    /// Final state, once it is decided.
    verdict: Option<ContainerState>,
    oom_seen: u64,
    /// Clients and requests that wait for the result of a start, by its number.
    waiting: BTreeMap<u32, (u64, u64)>,
    /// Signals for nodes that are being started.
    early_signals: Vec<(String, i32)>,
}

/// Runs until the servant has ended.
pub(super) fn drive(begun: PreparedShim, resident: Box<dyn Resident>) -> Result<(), Error> {
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
    fn new(begun: PreparedShim, resident: Box<dyn Resident>) -> Result<Self, Error> {
        let (inputs, queue) = mpsc::unbounded_channel();
        let clients = DaemonConnections::new(inputs.clone());
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
        let rate = begun.launch.quotas().log_rate;
        let log = logs::LogWriter::create(&log, logs::ROTATE_AT, rate).map_err(Error::file("make", &log))?;
        let init = begun.init.try_clone().map_err(Error::call("dup of init's socket"))?;
        watch_signals(&inputs).map_err(Error::call("watching signals"))?;
        let _ = inputs.send(ShimEvent::Connected(control));
        Ok(Self {
            clients,
            nodes: NodeTable::default(),
            execs: ExecTable::new(inputs.clone()),
            link: InitLink::new(init).map_err(Error::call("watching init's socket"))?,
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
        if let Err(error) = self.bring_up().await {
            let reason = error.to_string();
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

    /// Handles an event; returns true when the servant has ended.
    async fn handle(&mut self, input: ShimEvent) -> bool {
        match input {
            ShimEvent::Connected(stream) => self.clients.add(stream, &self.hello()),
            ShimEvent::Disconnected(client) => self.clients.remove(client),
            ShimEvent::Request(client, request, descriptors) => {
                if let Some(outcome) = self.execute(client, request.id, request.command, descriptors).await {
                    self.clients.answer(client, request.id, outcome);
                }
            }
            ShimEvent::Init(reply, fd) => self.on_init_reply(reply, fd).await,
            ShimEvent::Reaped(pid, status) => {
                if self.init.as_ref().is_some_and(|(init, _)| *init == pid) {
                    self.on_init_exit(status);
                    return true;
                }
            }
            ShimEvent::ExecLeft(number) => self.end_exec(number).await,
            ShimEvent::Respawn(name) => self.respawn(&name).await,
            ShimEvent::Patience(stage) if self.stopping == Some(stage) => self.next_stage().await,
            ShimEvent::Patience(_) => {}
            ShimEvent::Terminate => self.stop("the shim was asked to end").await,
        }
        false
    }

    /// Executes a command; returns `None` if the reply comes later.
    async fn execute(
        &mut self,
        client: u64,
        request: u64,
        command: Command,
        descriptors: Vec<OwnedFd>,
    ) -> Option<Result<(), CommandError>> {
        match command {
            Command::Stop => {
                self.stop("stopped").await;
                Some(Ok(()))
            }
            _ if self.stopping.is_some() || self.init.is_none() => Some(Err(CommandError::Ending)),
            Command::StartNode(node) => {
                let name = node.name.clone();
                if let Err(error) = self.nodes.add(node) {
                    return Some(Err(error.into()));
                }
                let (number, spec) = self.nodes.start(&name)?;
                self.waiting.insert(number, (client, request));
                self.request_start(number, &spec).await;
                None
            }
            Command::SignalNode { node, signal, last } => {
                if last {
                    self.nodes.retire(&node);
                }
                if self.nodes.is_starting(&node) {
                    self.early_signals.push((node, signal));
                    return Some(Ok(()));
                }
                Some(self.signal(&node, signal).await)
            }
            Command::Exec(spec) => match self.start_exec(&spec, descriptors).await {
                Ok(number) => {
                    self.waiting.insert(number, (client, request));
                    None
                }
                Err(error) => Some(Err(error)),
            },
            Command::SetLimits(limits) => {
                let enforced = self.set_limits(&limits);
                self.begun.enforced = enforced.clone();
                self.clients.report(&ShimMessage::Enforced { enforced: enforced.clone() });
                let unmet = enforced.unmet_limits(&limits);
                Some(if unmet.is_empty() { Ok(()) } else { Err(CommandError::Limits(unmet)) })
            }
        }
    }

    /// Sets the servant's limits, and those of the shim that depend on them.
    fn set_limits(&self, limits: &Limits) -> EnforcedLimits {
        let enforced = self.begun.cgroup.set_limits(limits);
        let of_shim = self.begun.launch.shim_limits_for(&enforced.limits);
        EnforcedLimits { shim: self.begun.shim_cgroup.set_limits(&of_shim).limits, ..enforced }
    }

    fn set_state(&mut self, state: ContainerState) {
        self.state = state;
        let state = self.snapshot();
        self.clients.report(&ShimMessage::State { state });
    }

    fn snapshot(&self) -> Snapshot {
        let running = self.state == ContainerState::Running;
        let init = self.init.as_ref().filter(|_| running);
        Snapshot { state: self.state.clone(), init_pid: init.map(|(pid, _)| *pid) }
    }

    fn report_node(&self, event: NodeEvent) {
        let status = self.nodes.status(event.node());
        self.clients.report(&ShimMessage::Node { event, status });
    }

    fn hello(&self) -> ShimMessage {
        ShimMessage::Hello {
            shim: self.begun.identity,
            state: self.snapshot(),
            nodes: self.nodes.statuses(),
            enforced: EnforcedLimits { ..self.begun.enforced.clone() },
            can_exec: true,
        }
    }
}

/// Forwards exits of children and SIGTERM as events.
fn watch_signals(inputs: &mpsc::UnboundedSender<ShimEvent>) -> std::io::Result<()> {
    let mut children = signal(SignalKind::child())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let inputs = inputs.clone();
    tokio::task::spawn_local(async move {
        loop {
            // First without waiting: a child may have exited before the signal was watched.
            while let Ok(status) = waitpid(None::<Pid>, Some(WaitPidFlag::WNOHANG)) {
                let (pid, raw) = match status {
                    WaitStatus::Exited(pid, code) => (pid, code << 8),
                    WaitStatus::Signaled(pid, signal, _) => (pid, signal as i32),
                    WaitStatus::StillAlive => break,
                    _ => continue,
                };
                let _ = inputs.send(ShimEvent::Reaped(pid.as_raw(), raw));
            }
            tokio::select! {
                _ = children.recv() => {}
                _ = terminate.recv() => {
                    let _ = inputs.send(ShimEvent::Terminate);
                }
            }
        }
    });
    Ok(())
}
