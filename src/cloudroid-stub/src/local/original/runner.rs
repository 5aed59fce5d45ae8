//! Runs the process of a local original: starts it, watches until it is ready, restarts it after a crash, and ends it.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use qos::LocalState;
use ros::bus::{Bus, Graph, wait_for_connected};
use tokio::process::Child;
use tokio::sync::mpsc;
use tokio::time::{sleep, timeout};

use super::{
    Expected, ExpectedInterface, OriginalCommand, OriginalEvent, OriginalSetup, Publishers, SETTLE, Sources, call,
};
use crate::local::private_system::PrivateSystem;
use crate::local::process::{self, OriginalProgram};
use crate::local::remembered::RememberedSettings;
use crate::node_interface;

/// First and longest pause after crashes, and the run time that resets the pause.
const BACKOFF: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(10));
const FORGIVEN: Duration = Duration::from_secs(30);

/// Runs the process.
pub(super) struct OriginalRunner {
    pub(super) setting: OriginalSetup,
    pub(super) system: Arc<PrivateSystem>,
    pub(super) robot: Arc<dyn Bus>,
    pub(super) publishers: Publishers,
    pub(super) sources: Sources,
    pub(super) expected: Expected,
    pub(super) remembered: Arc<RememberedSettings>,
    pub(super) news: mpsc::UnboundedSender<OriginalEvent>,
}

impl OriginalRunner {
    /// Executes commands until the handle is dropped.
    pub(super) async fn run(self, mut orders: mpsc::UnboundedReceiver<OriginalCommand>) {
        while let Some(order) = orders.recv().await {
            if matches!(order, OriginalCommand::Start) {
                let Some(program) = &self.setting.program else {
                    self.report(LocalState::Missing);
                    continue;
                };
                self.run_until_stopped(program, &mut orders).await;
                self.report(LocalState::Stopped);
            }
        }
    }

    /// Runs the process from start to stop, through all crashes.
    async fn run_until_stopped(
        &self,
        program: &OriginalProgram,
        orders: &mut mpsc::UnboundedReceiver<OriginalCommand>,
    ) {
        let mut pause = BACKOFF.0;
        loop {
            let born = Instant::now();
            self.report(LocalState::Starting);
            let reason = match self.spawn(program).await {
                Ok(mut child) => tokio::select! {
                    reason = self.watch(&mut child) => reason,
                    () = wait_for_stop(orders) => {
                        process::terminate(&mut child).await;
                        self.system.process_exited(&self.setting.node).await;
                        return;
                    }
                },
                Err(error) => format!("{error:#}"),
            };
            self.system.process_exited(&self.setting.node).await;
            let _ = self.news.send(OriginalEvent::Crashed(reason));
            if born.elapsed() > FORGIVEN {
                pause = BACKOFF.0;
            }
            tokio::select! {
                () = sleep(pause) => {}
                () = wait_for_stop(orders) => return,
            }
            pause = (pause * 2).min(BACKOFF.1);
        }
    }

    async fn spawn(&self, program: &OriginalProgram) -> anyhow::Result<Child> {
        // Parameters may have changed since the last start.
        self.system.copy_parameters(&*self.robot).await?;
        program.spawn(&self.system.environment())
    }

    /// Reports when the process is ready; returns the reason when it ends.
    async fn watch(&self, child: &mut Child) -> String {
        tokio::select! {
            status = child.wait() => return process::describe_exit(status),
            () = self.report_ready() => {}
        }
        process::describe_exit(child.wait().await)
    }

    /// Reports that the original is ready when it can receive requests and has received the node's settings, or after
    /// the time allowed for each.
    async fn report_ready(&self) {
        let node = &self.setting.node;
        self.system.wait_for_node(node).await;
        let expected = self.expected.lock().clone();
        let _ = timeout(SETTLE, self.system.wait_for_interface(node, &expected)).await;
        let connected = timeout(self.setting.patience, self.wait_connected(&expected));
        if connected.await.is_err() {
            self.warn_of_missing_subscriptions(&expected);
        }
        let bus = self.system.bus();
        let ask = |service: &str, request| call(bus.clone(), service, request);
        let mut telling = std::pin::pin!(self.remembered.replay(ask));
        let told = timeout(self.setting.patience, &mut telling).await;
        self.report(LocalState::Ready);
        if told.is_err() {
            telling.await;
        }
    }

    /// Warns about requests that the node has not subscribed to in time.
    fn warn_of_missing_subscriptions(&self, expected: &ExpectedInterface) {
        let (node, graph) = (&self.setting.node, self.system.graph());
        let nodes = self.system.nodes_of(&graph, node);
        let is_deaf = |topic: &&String| !any_subscribes(&graph, &nodes, topic);
        let deaf: Vec<_> = expected.awaited.iter().filter(is_deaf).collect();
        if !deaf.is_empty() {
            tracing::warn!(
                node,
                "the local original has run for {:?} and does not subscribe to {deaf:?} yet: it is treated as ready, \
                    and messages are lost until it subscribes; see its output for what it waits for",
                self.setting.patience
            );
        }
    }

    /// Returns when the node has subscribed to its requests and all its registrations so far are connected.
    async fn wait_connected(&self, expected: &ExpectedInterface) {
        let node = &self.setting.node;
        let requests: Vec<_> = {
            let inputs = self.publishers.lock();
            let due = inputs.iter().filter(|(topic, _)| expected.is_required_input(topic));
            due.map(|(_, input)| input.matched_subscribers()).collect()
        };
        for end in requests {
            wait_for_connected(end, 1).await;
        }
        let graph = self.system.graph();
        let nodes = self.system.nodes_of(&graph, node);
        let ends: Vec<_> = {
            let inputs = self.publishers.lock();
            let due = inputs.iter().filter(|(topic, _)| any_subscribes(&graph, &nodes, topic));
            due.map(|(_, input)| input.matched_subscribers()).collect()
        };
        for end in ends {
            wait_for_connected(end, 1).await;
        }
        let sources = self.sources.lock().clone();
        for (topic, source) in sources {
            let mut nodes = nodes.iter();
            if nodes.any(|node| node_interface::publishes(&graph, node, &topic)) {
                wait_for_connected(source, 1).await;
            }
        }
    }

    fn report(&self, state: LocalState) {
        let _ = self.news.send(OriginalEvent::State(state));
    }
}

/// Returns whether one of these nodes subscribes to the topic.
fn any_subscribes(graph: &Graph, nodes: &BTreeSet<String>, topic: &str) -> bool {
    let mut nodes = nodes.iter();
    nodes.any(|node| node_interface::subscribes(graph, node, topic))
}

/// Waits for the command to stop, or for the handle to be dropped.
async fn wait_for_stop(orders: &mut mpsc::UnboundedReceiver<OriginalCommand>) {
    while let Some(order) = orders.recv().await {
        if matches!(order, OriginalCommand::Stop) {
            return;
        }
    }
}
