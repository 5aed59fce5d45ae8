//! The shim's event loop. Everything that happens enters one queue; this one task changes the servant's state.

mod coming_up;
mod ending;
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
use super::begin::Begun;
use super::clients::Clients;
use super::input::{Input, StopStage};
use super::link::Link;
use super::nodes::Nodes;
use super::streams::Streams;
use crate::engine::{ContainerState, Enforced, NodeEvent};
use crate::protocol::{Command, FromShim, Snapshot};
use crate::spec::Limits;
use crate::{Error, logs};

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
        let rate = begun.launch.quotas().log_rate;
        let log =
            logs::Writer::create(&log, logs::ROTATE_AT, rate).map_err(Error::file("make", &log))?;
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
            Command::SetLimits(limits) => {
                let enforced = self.set_limits(&limits);
                self.begun.enforced = enforced.clone();
                self.clients.report(&FromShim::Enforced {
                    enforced: enforced.clone(),
                });
                Some(match enforced.unmet(&limits).as_slice() {
                    [] => Ok(()),
                    unmet => Err(format!("cannot be set: {}", unmet.join(", "))),
                })
            }
        }
    }

    /// The servant's limits, and with them what the shim may take beside it.
    fn set_limits(&self, limits: &Limits) -> Enforced {
        let enforced = self.begun.cgroup.set(limits);
        let of_shim = self.begun.launch.limits_of_shim(&enforced.limits);
        Enforced {
            shim: self.begun.shim_cgroup.set(&of_shim).limits,
            ..enforced
        }
    }

    fn set_state(&mut self, state: ContainerState) {
        self.state = state;
        let state = self.told();
        self.clients.report(&FromShim::State { state });
    }

    fn told(&self) -> Snapshot {
        let running = self.state == ContainerState::Running;
        let init = self.init.as_ref().filter(|_| running);
        Snapshot {
            state: self.state.clone(),
            init_pid: init.map(|(pid, _)| *pid),
        }
    }

    fn report_node(&self, event: NodeEvent) {
        let status = self.nodes.status(event.node());
        self.clients.report(&FromShim::Node { event, status });
    }

    fn hello(&self) -> FromShim {
        FromShim::Hello {
            shim: self.begun.identity,
            state: self.told(),
            nodes: self.nodes.statuses(),
            enforced: Enforced {
                ..self.begun.enforced.clone()
            },
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
