//! Goals sent by this node, tracked over actionlib's topics.

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use ros_bus::{ActionClient, BusError, CallFate, GoalError, GoalEvents, Graph, MatchedPeers, Publisher, Subscription};
use ros_message::schema::ActionDef;
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tokio::time::timeout;

use crate::actions::goal_client::GoalClient;
use crate::bus::Ros1BusState;
use crate::bus::actions::answers::KnownResponders;

/// Time for which a cancel waits for a server that has accepted the goal but is not connected to the cancel topic yet.
const CANCEL_WAITS: Duration = Duration::from_secs(10);
/// Time without a publisher of results after which the server counts as gone.
const GONE_AFTER: Duration = Duration::from_secs(3);

/// A client of one action.
pub(crate) struct Ros1ActionClient {
    shared: Arc<ActionlibClientState>,
    tasks: [AbortHandle; 2],
}

struct ActionlibClientState {
    bus: Arc<Ros1BusState>,
    name: String,
    type_name: String,
    goals: GoalClient,
    ends: OnceLock<ActionClientPublishers>,
    answers: KnownResponders,
    state: watch::Sender<State>,
}

/// Publishers of the client.
struct ActionClientPublishers {
    goal: Box<dyn Publisher>,
    cancel: Box<dyn Publisher>,
}

#[derive(Debug)]
enum State {
    Opening,
    /// The topics are advertised and subscribed to.
    Open,
    /// A status message of the server has arrived.
    Heard,
    /// The topics cannot be used.
    Failed(GoalError),
}

/// Subscriptions to what the server publishes.
struct ActionClientSubscriptions {
    feedback: Subscription,
    result: Subscription,
    status: Subscription,
}

impl Ros1ActionClient {
    /// Opens the action's topics in the background.
    pub(crate) fn open(bus: &Arc<Ros1BusState>, name: &str, of: &Arc<ActionDef>) -> Self {
        let shared = Arc::new(ActionlibClientState {
            bus: bus.clone(),
            name: name.to_owned(),
            type_name: of.name.clone(),
            goals: GoalClient::default(),
            ends: OnceLock::new(),
            answers: KnownResponders::default(),
            state: watch::Sender::new(State::Opening),
        });
        let (following, of) = (shared.clone(), of.clone());
        let follow = bus.spawn(async move {
            match following.open(&of).await {
                Ok(heard) => following.follow(heard).await,
                Err(error) => following.fail_all(error.into()),
            }
        });
        let tasks = [follow, bus.spawn(watch_server(shared.clone()))];
        Self { shared, tasks }
    }
}

impl Drop for Ros1ActionClient {
    fn drop(&mut self) {
        for task in &self.tasks {
            task.abort();
        }
        // Nobody needs the goals any longer.
        let cancels = self.shared.goals.abandon();
        if let Some(ends) = self.shared.ends.get() {
            cancels.into_iter().for_each(|cancel| ends.cancel.publish(cancel));
        }
    }
}

#[async_trait]
impl ActionClient for Ros1ActionClient {
    async fn wait_for_server(&self, patience: Duration) -> Result<(), BusError> {
        let shared = &self.shared;
        let ready = async {
            let mut state = shared.state.subscribe();
            let heard = state.wait_for(|state| matches!(state, State::Heard | State::Failed(_)));
            // The sender lives as long as `self`.
            if let Ok(State::Failed(reason)) = heard.await.as_deref() {
                return Err(BusError::CallFailed {
                    service: format!("action {}", shared.name),
                    reason: reason.to_string(),
                    fate: CallFate::NotTaken,
                });
            }
            shared.wait_for_goal_subscribers().await;
            shared.answers.wait_until_connected(&shared.bus, &shared.name).await;
            Ok(())
        };
        let ready = async {
            tokio::select! {
                biased;
                other = shared.wait_for_type_mismatch() => Err(other),
                ready = ready => ready,
            }
        };
        match timeout(patience, ready).await {
            Ok(ready) => ready,
            // The server may accept goals all the same and only not have published its status.
            Err(_) if shared.is_connected() => Ok(()),
            Err(_) => Err(BusError::Timeout { what: format!("action {}", shared.name), after: patience }),
        }
    }

    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        let Some(ends) = self.shared.ends.get() else {
            return events.on_ended(Err(GoalError::NotReady(self.shared.name.clone())));
        };
        ends.goal.publish(self.shared.goals.begin(id, &goal, events));
    }

    /// Sends the cancel as soon as the server is connected.
    fn cancel_goal(&self, id: &str) {
        let shared = &self.shared;
        let Some(ends) = shared.ends.get() else {
            return;
        };
        let Some(cancel) = shared.goals.cancel(id) else {
            return;
        };
        let matched = ends.cancel.matched_subscribers();
        if matched.borrow().connected_count() > 0 {
            return ends.cancel.publish(cancel);
        }
        let (waiting, id) = (shared.clone(), id.to_owned());
        shared.bus.spawn(async move {
            // Bounded: a server need not subscribe to cancels.
            let _ = timeout(CANCEL_WAITS, ros_bus::wait_for_connected(matched, 1)).await;
            if let Some((ends, cancel)) = waiting.ends.get().zip(waiting.goals.cancel(&id)) {
                ends.cancel.publish(cancel);
            }
        });
    }
}

impl ActionlibClientState {
    async fn open(&self, of: &ActionDef) -> Result<ActionClientSubscriptions, BusError> {
        let topics = super::ActionTopicSet::new(&self.bus, &self.name, of)?;
        let heard = ActionClientSubscriptions {
            feedback: topics.subscribe("feedback").await?,
            result: topics.subscribe("result").await?,
            status: topics.subscribe("status").await?,
        };
        let ends = ActionClientPublishers {
            goal: topics.advertise("goal", false).await?,
            cancel: topics.advertise("cancel", false).await?,
        };
        // Set only here.
        let _ = self.ends.set(ends);
        self.state.send_replace(State::Open);
        Ok(heard)
    }

    async fn follow(&self, mut heard: ActionClientSubscriptions) {
        loop {
            tokio::select! {
                // Feedback arrived before the result it belongs to.
                biased;
                Some(message) = heard.feedback.messages.recv() => self.goals.on_feedback(&message.bytes),
                Some(message) = heard.result.messages.recv() => self.goals.on_result(&message.bytes),
                Some(message) = heard.status.messages.recv() => self.on_status(&message.bytes),
                else => return self.fail_all(BusError::Closed.into()),
            }
        }
    }

    fn goal_subscribers(&self) -> Option<watch::Receiver<MatchedPeers>> {
        Some(self.ends.get()?.goal.matched_subscribers())
    }

    /// Returns true if a connected subscriber of goals also publishes results. A node that only observes goals does
    /// not, and a server that is starting or stopping and is registered for one of both has no action type yet, or no
    /// longer.
    fn has_server(&self, matched: &MatchedPeers, graph: &Graph) -> bool {
        let nodes = graph.actions.get(&self.name);
        nodes.is_some_and(|nodes| nodes.servers.iter().any(|node| matched.has_node(node)))
    }

    fn is_connected(&self) -> bool {
        self.goal_subscribers().is_some_and(|matched| self.has_server(&matched.borrow(), &self.bus.graph.borrow()))
    }

    /// Returns the error once the servers turn out to have another type.
    async fn wait_for_type_mismatch(&self) -> BusError {
        let mut graph = self.bus.graph.subscribe();
        loop {
            let other = graph.borrow_and_update().action_type_mismatch(&self.name, &self.type_name);
            if let Some(other) = other {
                return other;
            }
            if graph.changed().await.is_err() {
                return BusError::Closed;
            }
        }
    }

    /// Waits until all nodes registered as subscribers of goals are connected, including a server.
    async fn wait_for_goal_subscribers(&self) {
        let Some(mut matched) = self.goal_subscribers() else {
            return;
        };
        let topic = format!("{}/goal", self.name);
        let mut graph = self.bus.graph.subscribe();
        loop {
            let complete = {
                let (matched, graph) = (matched.borrow_and_update(), graph.borrow_and_update());
                let servers = graph.topics.get(&topic).map(|nodes| &nodes.subscribers);
                let mut others = servers.into_iter().flatten();
                let others = others.all(|node| *node == self.bus.node || matched.has_node(node));
                let has_other_type = graph.action_type_mismatch(&self.name, &self.type_name).is_some();
                others && !has_other_type && self.has_server(&matched, &graph)
            };
            if complete {
                return;
            }
            tokio::select! {
                changed = matched.changed() => if changed.is_err() { return },
                changed = graph.changed() => if changed.is_err() { return },
            }
        }
    }

    fn on_status(&self, message: &[u8]) {
        if !self.goals.on_status(message) {
            return;
        }
        self.state.send_if_modified(|state| {
            let first = matches!(state, State::Open);
            if first {
                *state = State::Heard;
            }
            first
        });
    }

    fn fail_all(&self, reason: GoalError) {
        self.state.send_replace(State::Failed(reason.clone()));
        self.goals.end_all(&reason);
    }
}

/// Ends the goals when the server has gone.
async fn watch_server(shared: Arc<ActionlibClientState>) {
    let mut graph = shared.bus.graph.subscribe();
    let topic = format!("{}/result", shared.name);
    let there = |graph: &Arc<ros_bus::Graph>| {
        let nodes = graph.topics.get(&topic);
        nodes.is_some_and(|nodes| !nodes.publishers.is_empty())
    };
    loop {
        if graph.wait_for(|graph| !there(graph)).await.is_err() {
            return;
        }
        if timeout(GONE_AFTER, graph.wait_for(there)).await.is_ok() {
            continue;
        }
        shared.goals.end_all(&GoalError::ServerGone(shared.name.clone()));
        if graph.wait_for(there).await.is_err() {
            return;
        }
    }
}
