//! Supervises the nodes of one servant: handles exits and restarts.

use std::collections::HashMap;
use std::sync::Arc;

use api::Phase;
use futures_util::StreamExt;
use futures_util::future::BoxFuture;
use futures_util::stream::FuturesUnordered;
use reach::describe_exit;
use servant::engine::{NodeEvent, NodeExit, ServantHandle};
use servant::spec::NodeSpec;
use tokio::sync::broadcast::error::RecvError;
use tokio::time::Instant;

use super::ChoreographerInner;
use crate::decide::nodes::{EndedNode, NodeExitAction, NodeExitContext, NodeReport, decide_after_exit};
use crate::lives::handle::{Failure, Handle};

/// Number of a node's log lines attached to its failure.
const LOG_LINES: usize = 20;

type NodeExitFuture<'a> = BoxFuture<'a, (NodeSpec, Instant, Result<NodeExit, servant::Error>)>;

/// Supervisor of the servant's nodes. A node with `respawn` is restarted by the engine.
pub(crate) struct NodeSupervisor<'a> {
    inner: &'a ChoreographerInner,
    handle: &'a Handle,
    container: &'a Arc<dyn ServantHandle>,
    running: FuturesUnordered<NodeExitFuture<'a>>,
    pausing: FuturesUnordered<BoxFuture<'a, NodeSpec>>,
    /// Failures in a row by node.
    failures: HashMap<String, u32>,
    events: tokio::sync::broadcast::Receiver<NodeEvent>,
    /// Last exits of the nodes that the engine restarts.
    ends: HashMap<String, String>,
    /// Number of nodes that run or will run again.
    alive: usize,
}

impl<'a> NodeSupervisor<'a> {
    pub(crate) fn new(
        inner: &'a ChoreographerInner,
        handle: &'a Handle,
        container: &'a Arc<dyn ServantHandle>,
    ) -> NodeSupervisor<'a> {
        let nodes = NodeSupervisor {
            inner,
            handle,
            container,
            running: FuturesUnordered::new(),
            pausing: FuturesUnordered::new(),
            failures: HashMap::new(),
            events: container.events(),
            ends: HashMap::new(),
            alive: handle.revision.plan.nodes.len(),
        };
        if handle.is_linked() {
            return nodes;
        }
        for node in handle.revision.plan.nodes.iter().filter(|node| !node.respawn) {
            nodes.watch(node.clone());
        }
        nodes
    }

    fn watch(&self, node: NodeSpec) {
        let container = self.container;
        let began = Instant::now();
        self.running.push(Box::pin(async move {
            let exit = container.wait_node(&node.name).await;
            (node, began, exit)
        }));
    }

    /// Waits until the servant has lost a node that it cannot do without.
    pub(crate) async fn supervise(&mut self) -> Failure {
        loop {
            tokio::select! {
                Some((node, began, exit)) = self.running.next() => {
                    if let Err(failure) = self.on_exit(node, began, exit).await {
                        return failure;
                    }
                }
                Some(node) = self.pausing.next() => {
                    if let Err(failure) = self.restart(node).await {
                        return failure;
                    }
                }
                event = self.events.recv() => match event {
                    Ok(event) => self.on_node_event(event),
                    Err(RecvError::Lagged(_)) => {}
                    Err(RecvError::Closed) => std::future::pending().await,
                },
            }
        }
    }

    /// Handles an event of the engine.
    fn on_node_event(&mut self, event: NodeEvent) {
        let (node, exit) = match event {
            NodeEvent::Exited { node, code, signal, out_of_memory } => {
                (node, NodeExit { code, signal, out_of_memory, exec_error: None })
            }
            NodeEvent::ExecFailed { node, reason } => {
                (node, NodeExit { code: None, signal: None, out_of_memory: false, exec_error: Some(reason) })
            }
            NodeEvent::Respawning { node } => {
                let nodes = &self.handle.revision.plan.nodes;
                let delay = nodes.iter().find(|one| one.name == node);
                let delay = delay.map_or(0.0, |node| node.respawn_delay);
                let how = self.ends.remove(&node);
                let how = how.as_deref().unwrap_or("ended");
                let message = format!("{node} {how} and is restarted after {delay} s");
                let event = NodeReport { kind: "node-respawned", message };
                return self.report(&node, &event);
            }
            NodeEvent::Started { node } => return self.handle.note_start(&node),
        };
        if exit.out_of_memory {
            self.handle.note_out_of_memory();
        }
        let respawns = self.handle.revision.plan.nodes.iter();
        if respawns.filter(|one| one.respawn).any(|one| one.name == node) {
            let how = describe_exit(&exit, &self.handle.limits());
            self.ends.insert(node, how);
        }
    }

    async fn on_exit(
        &mut self,
        node: NodeSpec,
        began: Instant,
        exit: Result<NodeExit, servant::Error>,
    ) -> Result<(), Failure> {
        // The engine lost it: the container's own state says why.
        let Ok(exit) = exit else { return Ok(()) };
        if exit.out_of_memory {
            self.handle.note_out_of_memory();
        }
        let how = describe_exit(&exit, &self.handle.limits());
        let crew = NodeExitContext {
            linked: self.handle.is_linked(),
            ready: self.handle.life().phase >= Phase::Ready,
            restarts: self.handle.revision.plan.restart,
            alive: self.alive,
        };
        let end = EndedNode {
            node: &node.name,
            how: &how,
            failed: exit.code != Some(0),
            out_of_memory: exit.out_of_memory,
            ran: began.elapsed(),
            failures: self.failures.get(&node.name).copied().unwrap_or_default(),
        };
        match decide_after_exit(crew, end) {
            NodeExitAction::Nothing => Ok(()),
            NodeExitAction::Without(event) => {
                self.alive -= 1;
                self.report(&node.name, &event);
                Ok(())
            }
            NodeExitAction::Restart { after, failures, event } => {
                self.report(&node.name, &event);
                self.handle.set_down(&node.name, Some((failures, after)));
                self.failures.insert(node.name.clone(), failures);
                self.pausing.push(Box::pin(async move {
                    tokio::time::sleep(after).await;
                    node
                }));
                Ok(())
            }
            NodeExitAction::Fail { event, reason } => {
                event.iter().for_each(|event| self.report(&node.name, event));
                Err(self.failure(&node, reason).await)
            }
        }
    }

    async fn restart(&mut self, node: NodeSpec) -> Result<(), Failure> {
        self.handle.set_down(&node.name, None);
        if self.handle.is_linked() {
            // A stub took over while it paused.
            return Ok(());
        }
        match self.container.start_node(node.clone()).await {
            Ok(()) => {
                if self.handle.is_linked() {
                    // A stub took over just now.
                    let _ = self.container.end_node(&node.name, libc::SIGINT).await;
                }
                self.watch(node);
                Ok(())
            }
            Err(error) => Err(self.failure(&node, format!("cannot restart {}: {error}", node.name)).await),
        }
    }

    async fn failure(&mut self, node: &NodeSpec, reason: String) -> Failure {
        let lines = self.container.logs(LOG_LINES, Some(&node.name)).await;
        Failure::Broken { reason, log: lines.into_iter().map(|line| line.line).collect() }
    }

    fn report(&self, node: &str, event: &NodeReport) {
        let message = format!("servant {}: {}", self.handle.id, event.message);
        let about = self.handle.event_context();
        let span = tracing::error_span!("node", node);
        span.in_scope(|| self.inner.journal.warning(event.kind, &message, &about));
    }
}
