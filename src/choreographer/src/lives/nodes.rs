//! The nodes of one servant: who ended, and who is started again.

use std::collections::HashMap;
use std::sync::Arc;

use api::Phase;
use futures_util::StreamExt;
use futures_util::future::BoxFuture;
use futures_util::stream::FuturesUnordered;
use reach::how_it_ended;
use servant::engine::{NodeEvent, NodeExit, Servant};
use servant::spec::NodeSpec;
use tokio::sync::broadcast::error::RecvError;
use tokio::time::Instant;

use super::Inner;
use crate::decide::nodes::{Crew, Ended, Event, Next, after};
use crate::lives::handle::{Failure, Handle};

/// Lines of a node's log that explain its failure.
const LOG_LINES: usize = 20;

type Exit<'a> = BoxFuture<'a, (NodeSpec, Instant, Result<NodeExit, servant::Error>)>;

/// The servant's nodes: who ended, and who is started again. A node that asked for `respawn` is the engine's.
pub(crate) struct Nodes<'a> {
    inner: &'a Inner,
    handle: &'a Handle,
    container: &'a Arc<dyn Servant>,
    running: FuturesUnordered<Exit<'a>>,
    pausing: FuturesUnordered<BoxFuture<'a, NodeSpec>>,
    /// How often in a row a node has failed.
    failures: HashMap<String, u32>,
    events: tokio::sync::broadcast::Receiver<NodeEvent>,
    /// How those that the engine starts again ended last.
    ends: HashMap<String, String>,
    /// Nodes that still run or will run again.
    alive: usize,
}

impl<'a> Nodes<'a> {
    pub(crate) fn new(
        inner: &'a Inner,
        handle: &'a Handle,
        container: &'a Arc<dyn Servant>,
    ) -> Nodes<'a> {
        let nodes = Nodes {
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
        for node in handle
            .revision
            .plan
            .nodes
            .iter()
            .filter(|node| !node.respawn)
        {
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

    /// Comes back when the servant has lost a node that it cannot do without.
    pub(crate) async fn supervise(&mut self) -> Failure {
        loop {
            tokio::select! {
                Some((node, began, exit)) = self.running.next() => {
                    if let Err(failure) = self.ended(node, began, exit).await {
                        return failure;
                    }
                }
                Some(node) = self.pausing.next() => {
                    if let Err(failure) = self.restart(node).await {
                        return failure;
                    }
                }
                event = self.events.recv() => match event {
                    Ok(event) => self.happened(event),
                    Err(RecvError::Lagged(_)) => {}
                    Err(RecvError::Closed) => std::future::pending().await,
                },
            }
        }
    }

    /// Takes in what the engine tells of its own accord.
    fn happened(&mut self, event: NodeEvent) {
        let (node, exit) = match event {
            NodeEvent::Exited {
                node,
                code,
                signal,
                out_of_memory,
            } => (
                node,
                NodeExit {
                    code,
                    signal,
                    out_of_memory,
                    exec_error: None,
                },
            ),
            NodeEvent::ExecFailed { node, reason } => (
                node,
                NodeExit {
                    code: None,
                    signal: None,
                    out_of_memory: false,
                    exec_error: Some(reason),
                },
            ),
            NodeEvent::Respawning { node } => {
                let nodes = &self.handle.revision.plan.nodes;
                let delay = nodes.iter().find(|one| one.name == node);
                let delay = delay.map_or(0.0, |node| node.respawn_delay);
                let how = self.ends.remove(&node);
                let how = how.as_deref().unwrap_or("ended");
                let message = format!("{node} {how} and is started again after {delay} s");
                return self.report(&Event {
                    kind: "node-respawned",
                    message,
                });
            }
            NodeEvent::Started { node } => return self.handle.note_start(&node),
        };
        if exit.out_of_memory {
            self.handle.note_out_of_memory();
        }
        let respawns = self.handle.revision.plan.nodes.iter();
        if respawns
            .filter(|one| one.respawn)
            .any(|one| one.name == node)
        {
            let how = how_it_ended(&exit, &self.handle.limits());
            self.ends.insert(node, how);
        }
    }

    async fn ended(
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
        let how = how_it_ended(&exit, &self.handle.limits());
        let crew = Crew {
            linked: self.handle.is_linked(),
            ready: self.handle.life().phase >= Phase::Ready,
            restarts: self.handle.revision.plan.restart,
            alive: self.alive,
        };
        let end = Ended {
            node: &node.name,
            how: &how,
            failed: exit.code != Some(0),
            out_of_memory: exit.out_of_memory,
            ran: began.elapsed(),
            failures: self.failures.get(&node.name).copied().unwrap_or_default(),
        };
        match after(crew, end) {
            Next::Nothing => Ok(()),
            Next::Without(event) => {
                self.alive -= 1;
                self.report(&event);
                Ok(())
            }
            Next::Restart {
                after,
                failures,
                event,
            } => {
                self.report(&event);
                self.handle.set_down(&node.name, Some((failures, after)));
                self.failures.insert(node.name.clone(), failures);
                self.pausing.push(Box::pin(async move {
                    tokio::time::sleep(after).await;
                    node
                }));
                Ok(())
            }
            Next::Fail { event, reason } => {
                event.iter().for_each(|event| self.report(event));
                Err(self.failure(&node, reason).await)
            }
        }
    }

    async fn restart(&mut self, node: NodeSpec) -> Result<(), Failure> {
        self.handle.set_down(&node.name, None);
        if self.handle.is_linked() {
            // A stub took its place while it paused.
            return Ok(());
        }
        match self.container.start_node(node.clone()).await {
            Ok(()) => {
                if self.handle.is_linked() {
                    // Or just now.
                    let _ = self.container.end_node(&node.name, libc::SIGINT).await;
                }
                self.watch(node);
                Ok(())
            }
            Err(error) => Err(self
                .failure(
                    &node,
                    format!("could not start {} again: {error}", node.name),
                )
                .await),
        }
    }

    async fn failure(&mut self, node: &NodeSpec, reason: String) -> Failure {
        let lines = self.container.logs(LOG_LINES, Some(&node.name)).await;
        Failure::Broken {
            reason,
            log: lines.into_iter().map(|line| line.line).collect(),
        }
    }

    fn report(&self, event: &Event) {
        let message = format!("servant {}: {}", self.handle.id, event.message);
        let about = self.handle.about();
        self.inner.journal.warning(event.kind, &message, &about);
    }
}
