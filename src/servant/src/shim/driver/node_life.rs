//! Life cycle of nodes: requested from init, reported by init, restarted or not.

use std::os::fd::{AsRawFd, OwnedFd};
use std::time::Duration;

use init::{InitReply, Scope, StartRequest};

use super::Driver;
use crate::engine::{ContainerState, NodeEvent, NodeExit};
use crate::process;
use crate::shim::command_error::{CommandError, StartError};
use crate::shim::input::ShimEvent;
use crate::shim::input::StopStage;
use crate::shim::nodes::{self, Consequence};
use crate::spec::NodeSpec;

impl Driver {
    pub(super) async fn signal(&self, node: &str, signal: i32) -> Result<(), CommandError> {
        let pid = self.nodes.pid_inside(node)?;
        Ok(self.link.signal(pid, signal, Scope::Group).await?)
    }

    pub(super) async fn start_node(&mut self, name: &str) {
        if let Some((number, spec)) = self.nodes.start(name) {
            self.request_start(number, &spec).await;
        }
    }

    pub(super) async fn request_start(&mut self, number: u32, spec: &NodeSpec) {
        if let Err(error) = self.send_start_request(number, spec).await {
            self.on_start_failed(number, error).await;
        }
    }

    pub(super) async fn send_start_request(&mut self, number: u32, spec: &NodeSpec) -> Result<(), StartError> {
        let open = |stream| self.streams.open(&spec.name, stream);
        let (out, err) = (open("stdout")?, open("stderr")?);
        let mut environment = self.begun.launch.spec.environment.clone();
        environment.extend(spec.environment.clone());
        let environment: Vec<String> = environment.iter().map(|(name, value)| format!("{name}={value}")).collect();
        let request =
            StartRequest { id: number, directory: &spec.directory, argv: &spec.argv, environment: &environment };
        let streams = [out.as_raw_fd(), err.as_raw_fd()];
        Ok(self.link.start(&request, &streams).await?)
    }

    pub(super) async fn respawn(&mut self, name: &str) {
        if self.stopping.is_none() && self.nodes.should_respawn(name) {
            self.start_node(name).await;
        }
    }

    pub(super) async fn on_init_reply(&mut self, reply: InitReply, fd: Option<OwnedFd>) {
        match reply {
            InitReply::Ready => {}
            InitReply::Started { id, pid } => {
                if self.execs.on_started(id, pid) {
                    self.answer_start(id, Ok(()));
                    return;
                }
                // It may be gone already: then its host pid is of no use.
                let host = fd.as_ref().and_then(process::pid_of).unwrap_or(0);
                if let Some(event) = self.nodes.on_started(id, pid, host) {
                    self.report_node(event.clone());
                    self.answer_start(id, Ok(()));
                    self.deliver_early_signals(event.node()).await;
                }
                if self.stopping.is_some() {
                    // It was being started when the stop began.
                    let _ = self.link.signal(pid, libc::SIGINT, Scope::Group).await;
                }
            }
            InitReply::Failed { id, errno, stage } => {
                self.on_start_failed(id, StartError::from_init(errno, stage)).await
            }
            InitReply::Exited { pid, status } => {
                self.resident.process_exited(pid);
                self.execs.on_exited(pid, status);
                let exit = nodes::parse_wait_status(status, self.was_out_of_memory(status));
                if let Some((event, consequence)) = self.nodes.on_exited(pid, exit.clone()) {
                    self.report_node(event.clone());
                    self.apply_consequence(event.node(), consequence, &exit).await;
                }
            }
        }
    }

    pub(super) fn answer_start(&mut self, number: u32, outcome: Result<(), CommandError>) {
        if let Some((client, request)) = self.waiting.remove(&number) {
            self.clients.answer(client, request, outcome);
        }
    }

    pub(super) async fn deliver_early_signals(&mut self, started: &str) {
        let (now, later) = std::mem::take(&mut self.early_signals).into_iter().partition(|(node, _)| node == started);
        self.early_signals = later;
        let now: Vec<(String, i32)> = now;
        for (node, signal) in now {
            // It may have ended already: then there is nothing to signal.
            let _ = self.signal(&node, signal).await;
        }
    }

    /// Returns whether this end coincides with an OOM kill counted by the kernel since the last one. A shell returns
    /// 137 for a child that was killed.
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

    pub(super) async fn on_start_failed(&mut self, number: u32, error: StartError) {
        if self.execs.remove_starting(number) {
            self.answer_start(number, Err(error.into()));
            return;
        }
        let reason = error.to_string();
        if let Some((event, consequence)) = self.nodes.on_exec_failed(number, reason.clone()) {
            self.report_node(event.clone());
            self.answer_start(number, Err(error.into()));
            self.early_signals.retain(|(node, _)| node != event.node());
            let exit = NodeExit { code: None, signal: None, out_of_memory: false, exec_error: Some(reason) };
            self.apply_consequence(event.node(), consequence, &exit).await;
        }
    }

    pub(super) async fn apply_consequence(&mut self, node: &str, consequence: Consequence, exit: &NodeExit) {
        if self.stopping.is_some() {
            // The last one has ended: there is nothing to wait for.
            if self.nodes.running_and_starting() == (vec![], 0) {
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
                    let _ = inputs.send(ShimEvent::Respawn(name));
                });
            }
            Consequence::EndServant => {
                let state = self.end_state_for(node, exit);
                self.verdict = Some(state);
                self.stop("").await;
            }
        }
    }

    pub(super) fn end_state_for(&self, node: &str, exit: &NodeExit) -> ContainerState {
        let how = match exit {
            NodeExit { exec_error: Some(reason), .. } => {
                return ContainerState::Failed {
                    reason: format!("required node {node} could not be started: {reason}"),
                };
            }
            NodeExit { out_of_memory: true, .. } => {
                let limit = self.memory_limit();
                return ContainerState::Failed { reason: format!("required node {node} was killed: {limit}") };
            }
            NodeExit { signal: Some(signal), .. } => format!("was killed by signal {signal}"),
            NodeExit { code, .. } => format!("exited with status {}", code.unwrap_or(0)),
        };
        ContainerState::Stopped { reason: format!("required node {node} {how}") }
    }

    pub(super) fn memory_limit(&self) -> String {
        match self.begun.enforced.limits.memory {
            Some(limit) => format!("out of memory, the limit is {limit}"),
            None => "out of memory".into(),
        }
    }
}
