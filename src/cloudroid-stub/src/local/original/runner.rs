//! The process of a local original: started, watched until it is ready, started again after a crash, ended.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use qos::LocalState;
use ros::bus::{Bus, Graph, reaches};
use tokio::process::Child;
use tokio::sync::mpsc;
use tokio::time::{sleep, timeout};

use super::{Expected, Interface, News, Order, Publishers, SETTLE, Setting, Sources, call};
use crate::local::private_system::PrivateSystem;
use crate::local::process::{self, Program};
use crate::local::remembered::Remembered;
use crate::seen;

/// Pauses after crashes, at first and at last; and how long a life forgives them.
const BACKOFF: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(10));
const FORGIVEN: Duration = Duration::from_secs(30);

/// Who runs the process.
pub(super) struct Runner {
    pub(super) setting: Setting,
    pub(super) system: Arc<PrivateSystem>,
    pub(super) robot: Arc<dyn Bus>,
    pub(super) publishers: Publishers,
    pub(super) sources: Sources,
    pub(super) expected: Expected,
    pub(super) remembered: Arc<Remembered>,
    pub(super) news: mpsc::UnboundedSender<News>,
}

impl Runner {
    /// Obeys until nobody is left to give orders.
    pub(super) async fn run(self, mut orders: mpsc::UnboundedReceiver<Order>) {
        while let Some(order) = orders.recv().await {
            if matches!(order, Order::Start) {
                let Some(program) = &self.setting.program else {
                    self.report(LocalState::Missing);
                    continue;
                };
                self.live(program, &mut orders).await;
                self.report(LocalState::Stopped);
            }
        }
    }

    /// From start to stop, through all crashes.
    async fn live(&self, program: &Program, orders: &mut mpsc::UnboundedReceiver<Order>) {
        let mut pause = BACKOFF.0;
        loop {
            let born = Instant::now();
            self.report(LocalState::Starting);
            let reason = match self.spawn(program).await {
                Ok(mut child) => tokio::select! {
                    reason = self.watch(&mut child) => reason,
                    () = stopped(orders) => {
                        process::end(&mut child).await;
                        self.system.process_exited(&self.setting.node).await;
                        return;
                    }
                },
                Err(error) => format!("{error:#}"),
            };
            self.system.process_exited(&self.setting.node).await;
            let _ = self.news.send(News::Crashed(reason));
            if born.elapsed() > FORGIVEN {
                pause = BACKOFF.0;
            }
            tokio::select! {
                () = sleep(pause) => {}
                () = stopped(orders) => return,
            }
            pause = (pause * 2).min(BACKOFF.1);
        }
    }

    async fn spawn(&self, program: &Program) -> anyhow::Result<Child> {
        // They may have changed since the last start.
        self.system.copy_parameters(&*self.robot).await?;
        program.spawn(&self.system.environment())
    }

    /// Tells when it is ready; gives the reason when it ends.
    async fn watch(&self, child: &mut Child) -> String {
        tokio::select! {
            status = child.wait() => return process::ended(status),
            () = self.attend() => {}
        }
        process::ended(child.wait().await)
    }

    /// Tells that it is ready once it can be given requests and has been told what the node was told before, or had time for either.
    async fn attend(&self) {
        let node = &self.setting.node;
        self.system.registered(node).await;
        let expected = self.expected.lock().clone();
        let _ = timeout(SETTLE, self.system.registers(node, &expected)).await;
        let connected = timeout(self.setting.patience, self.connects(&expected));
        if connected.await.is_err() {
            self.warn_of_deaf(&expected);
        }
        let bus = self.system.bus();
        let ask = |service: &str, request| call(bus.clone(), service, request);
        let mut telling = std::pin::pin!(self.remembered.tell(ask));
        let told = timeout(self.setting.patience, &mut telling).await;
        self.report(LocalState::Ready);
        if told.is_err() {
            telling.await;
        }
    }

    /// Names requests that the node does not listen to although it had time to.
    fn warn_of_deaf(&self, expected: &Interface) {
        let (node, graph) = (&self.setting.node, self.system.graph());
        let nodes = self.system.nodes_of(&graph, node);
        let is_deaf = |topic: &&String| !listens(&graph, &nodes, topic);
        let deaf: Vec<_> = expected.awaited.iter().filter(is_deaf).collect();
        if !deaf.is_empty() {
            tracing::warn!(
                node,
                "the local original has run for {:?} and does not listen to {deaf:?}: it is taken for ready, and what is sent there until it \
                 listens is lost; see what it waits for in its own output",
                self.setting.patience
            );
        }
    }

    /// Returns once its node listens to its requests, and whatever it has registered by then is connected.
    async fn connects(&self, expected: &Interface) {
        let node = &self.setting.node;
        let requests: Vec<_> = {
            let inputs = self.publishers.lock();
            let due = inputs
                .iter()
                .filter(|(topic, _)| expected.must_listen_to(topic));
            due.map(|(_, input)| input.matched()).collect()
        };
        for end in requests {
            reaches(end, 1).await;
        }
        let graph = self.system.graph();
        let nodes = self.system.nodes_of(&graph, node);
        let ends: Vec<_> = {
            let inputs = self.publishers.lock();
            let due = inputs
                .iter()
                .filter(|(topic, _)| listens(&graph, &nodes, topic));
            due.map(|(_, input)| input.matched()).collect()
        };
        for end in ends {
            reaches(end, 1).await;
        }
        let sources = self.sources.lock().clone();
        for (topic, source) in sources {
            let mut nodes = nodes.iter();
            if nodes.any(|node| seen::publishes(&graph, node, &topic)) {
                reaches(source, 1).await;
            }
        }
    }

    fn report(&self, state: LocalState) {
        let _ = self.news.send(News::State(state));
    }
}

/// Whether one of these nodes listens to the topic.
fn listens(graph: &Graph, nodes: &BTreeSet<String>, topic: &str) -> bool {
    let mut nodes = nodes.iter();
    nodes.any(|node| seen::subscribes(graph, node, topic))
}

/// Waits for the order to stop, or for nobody being left to give it.
async fn stopped(orders: &mut mpsc::UnboundedReceiver<Order>) {
    while let Some(order) = orders.recv().await {
        if matches!(order, Order::Stop) {
            return;
        }
    }
}
