//! The life of nodes: asked of init, told by init, started again or not.

use std::os::fd::{AsRawFd, OwnedFd};
use std::time::Duration;

use init::{Reply, Scope, Stage, StartRequest};

use super::Driver;
use crate::engine::{ContainerState, NodeEvent, NodeExit};
use crate::process;
use crate::shim::input::Input;
use crate::shim::input::StopStage;
use crate::shim::nodes::{self, Consequence};
use crate::spec::NodeSpec;

impl Driver {
    pub(super) async fn signal(&self, node: &str, signal: i32) -> Result<(), String> {
        let pid = self.nodes.inside(node)?;
        self.link
            .signal(pid, signal, Scope::Group)
            .await
            .map_err(|error| error.to_string())
    }

    pub(super) async fn start_node(&mut self, name: &str) {
        if let Some((number, spec)) = self.nodes.start(name) {
            self.ask_for(number, &spec).await;
        }
    }

    pub(super) async fn ask_for(&mut self, number: u32, spec: &NodeSpec) {
        if let Err(reason) = self.ask_init(number, spec).await {
            self.start_failed(number, reason).await;
        }
    }

    pub(super) async fn ask_init(&mut self, number: u32, spec: &NodeSpec) -> Result<(), String> {
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

    pub(super) async fn respawn(&mut self, name: &str) {
        if self.stopping.is_none() && self.nodes.respawns(name) {
            self.start_node(name).await;
        }
    }

    pub(super) async fn init_said(&mut self, reply: Reply, fd: Option<OwnedFd>) {
        match reply {
            Reply::Ready => {}
            Reply::Started { id, pid } => {
                // Gone already: then its number on the host is of no use to anybody.
                let host = fd.as_ref().and_then(process::pid_of).unwrap_or(0);
                if let Some(event) = self.nodes.started(id, pid, host) {
                    self.report_node(event.clone());
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
                    self.report_node(event.clone());
                    self.follow_up(event.node(), consequence, &exit).await;
                }
            }
        }
    }

    pub(super) fn answer_start(&mut self, number: u32, outcome: Result<(), String>) {
        if let Some((client, request)) = self.waiting.remove(&number) {
            self.clients.answer(client, request, outcome);
        }
    }

    pub(super) async fn deliver_early_signals(&mut self, started: &str) {
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
    pub(super) fn was_out_of_memory(&mut self, status: i32) -> bool {
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

    pub(super) async fn start_failed(&mut self, number: u32, reason: String) {
        if let Some((event, consequence)) = self.nodes.failed(number, reason.clone()) {
            self.report_node(event.clone());
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

    pub(super) async fn follow_up(
        &mut self,
        node: &str,
        consequence: Consequence,
        exit: &NodeExit,
    ) {
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
                self.report_node(NodeEvent::Respawning { node: node.into() });
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

    pub(super) fn verdict_on(&self, node: &str, exit: &NodeExit) -> ContainerState {
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

    pub(super) fn memory_limit(&self) -> String {
        match self.begun.enforced.limits.memory {
            // As `api::Size` writes it, so that it reads as in the configuration and in the event.
            Some(bytes) if bytes % (1 << 20) == 0 => {
                format!("out of memory, the limit is {}M", bytes >> 20)
            }
            Some(bytes) => format!("out of memory, the limit is {bytes} bytes"),
            None => "out of memory".into(),
        }
    }
}

fn describe(errno: i32, stage: Stage) -> String {
    let error = std::io::Error::from_raw_os_error(errno);
    match stage {
        Stage::Execute => format!("its program could not be executed: {error}"),
        Stage::Directory => format!("its working directory could not be entered: {error}"),
        Stage::Fork => format!("fork: {error}"),
        Stage::Request | Stage::Prepare => {
            format!("init could not prepare it: {error}")
        }
    }
}
