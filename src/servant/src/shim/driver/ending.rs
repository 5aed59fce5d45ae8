//! Termination of a servant: first politely, then by force; and its final state.

use std::os::fd::AsFd;
use std::time::Duration;

use init::Scope;

use super::Driver;
use crate::engine::{ContainerState, NodeExit};
use crate::launch::{self, ExitRecord};
use crate::shim::command_error::StartError;
use crate::shim::input::{ShimEvent, StopStage};
use crate::shim::nodes;
use crate::{Error, sys};

/// Time for a killed pid namespace to disappear.
const KILL_TIMEOUT: Duration = Duration::from_secs(5);
/// Time for the rest of the log once nobody can write to it.
const DRAIN: Duration = Duration::from_secs(2);
/// Time for a cgroup to become empty.
const PATIENCE: Duration = Duration::from_secs(10);

impl Driver {
    /// Starts to stop the servant; a second call does nothing.
    pub(super) async fn stop(&mut self, reason: &str) {
        if self.stopping.is_some() || self.init.is_none() {
            return;
        }
        self.verdict.get_or_insert_with(|| ContainerState::Stopped { reason: reason.into() });
        let first =
            if self.nodes.running_and_starting() == (vec![], 0) { StopStage::Kill } else { StopStage::Interrupt };
        self.enter_stage(first).await;
    }

    pub(super) async fn next_stage(&mut self) {
        let next = match self.stopping {
            None | Some(StopStage::Interrupt) => StopStage::Terminate,
            Some(StopStage::Terminate) => StopStage::Kill,
            Some(StopStage::Kill | StopStage::KillAgain) => StopStage::KillAgain,
        };
        self.enter_stage(next).await;
    }

    pub(super) async fn enter_stage(&mut self, stage: StopStage) {
        if self.stopping.is_some_and(|now| now >= stage && now != StopStage::KillAgain) {
            return;
        }
        self.stopping = Some(stage);
        let patience = match stage {
            StopStage::Interrupt => {
                for (_, pid) in self.nodes.running_and_starting().0 {
                    let _ = self.link.signal(pid, libc::SIGINT, Scope::Group).await;
                }
                self.begun.launch.grace.interrupt
            }
            StopStage::Terminate => {
                let _ = self.link.signal(0, libc::SIGTERM, Scope::All).await;
                self.begun.launch.grace.terminate
            }
            StopStage::Kill | StopStage::KillAgain => {
                self.kill();
                KILL_TIMEOUT
            }
        };
        let inputs = self.inputs.clone();
        tokio::task::spawn_local(async move {
            tokio::time::sleep(patience).await;
            let _ = inputs.send(ShimEvent::Patience(stage));
        });
    }

    /// Kills init; the kernel then kills everything in its pid namespace, and notifies us when nothing is left.
    pub(super) fn kill(&mut self) {
        self.stopping = self.stopping.max(Some(StopStage::Kill));
        if let Some((_, pidfd)) = &self.init {
            // Fails if it is gone already: then its end is in the queue.
            let _ = sys::pidfd_send_signal(pidfd.as_fd(), libc::SIGKILL);
        }
    }

    pub(super) fn on_init_exit(&mut self, status: i32) {
        let asked = self.stopping.is_some();
        let out_of_memory = !asked && self.was_out_of_memory(status);
        let exit = nodes::parse_wait_status(status, out_of_memory);
        for (_, pid) in self.nodes.running_and_starting().0 {
            let exit = NodeExit { code: None, signal: Some(libc::SIGKILL), out_of_memory, exec_error: None };
            if let Some((event, _)) = self.nodes.on_exited(pid, exit) {
                self.report_node(event);
            }
        }
        for number in self.nodes.starting_numbers() {
            let error = StartError::InitEnded;
            if let Some((event, _)) = self.nodes.on_exec_failed(number, error.to_string()) {
                self.report_node(event);
                self.answer_start(number, Err(error.into()));
            }
        }
        for number in self.execs.clear() {
            self.answer_start(number, Err(StartError::InitEnded.into()));
        }
        let limit = self.memory_limit();
        self.verdict.get_or_insert_with(|| {
            let how = match exit {
                NodeExit { out_of_memory: true, .. } => format!("was killed: {limit}"),
                NodeExit { signal: Some(signal), .. } => format!("was killed by signal {signal}"),
                NodeExit { code, .. } => format!("exited with status {}", code.unwrap_or(0)),
            };
            ContainerState::Failed { reason: format!("its init {how}") }
        });
        self.init = None;
    }

    /// Cleans up everything but the directory.
    pub(super) async fn finish(&mut self) -> Result<(), Error> {
        // When the namespace is gone nobody holds the other ends of the pipes, unless they were sent out of it.
        let _ = tokio::time::timeout(DRAIN, self.streams.wait_drained()).await;
        let removed = self.begun.cgroup.destroy(PATIENCE);
        let fallback = ContainerState::Stopped { reason: "stopped".into() };
        let mut state = self.verdict.take().unwrap_or(fallback);
        if let Err(error) = &removed {
            state = ContainerState::Failed { reason: error.to_string() };
        }
        let exit = ExitRecord { state: state.clone(), nodes: self.nodes.statuses() };
        let written = launch::write_record(&self.begun.directory.join(launch::EXIT), &exit);
        // A daemon that has just connected is notified, too.
        while let Ok(input) = self.queue.try_recv() {
            if let ShimEvent::Connected(stream) = input {
                self.clients.add(stream, &self.hello());
            }
        }
        self.set_state(state);
        let _ = tokio::time::timeout(DRAIN, self.clients.flush()).await;
        removed.and(written)
    }
}
