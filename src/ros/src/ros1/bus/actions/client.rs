//! Goals that this side has sent, followed over actionlib's topics.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tokio::time::timeout;

use crate::bus::{
    ActionClient, BusError, CallFate, GoalEnd, GoalEvents, Graph, Matched, Outcome, Publisher,
    Subscription,
};
use crate::codec::Time;
use crate::ros1::actions::messages::{self, GoalId, Status};
use crate::ros1::bus::Inner;
use crate::ros1::bus::actions::answers::Answers;
use crate::schema::ActionDef;

/// A goal that the server has stopped speaking of is lost.
const LOST_AFTER: Duration = Duration::from_secs(5);
/// So is one that it has never spoken of, after much longer: the clients of actionlib wait for that without end, since a server may be slow, or another
/// one may take the goal in its place.
const NEVER_TAKEN: Duration = Duration::from_secs(60);
/// How long a cancel waits for a server that has taken the goal and is not connected for cancels yet.
const CANCEL_WAITS: Duration = Duration::from_secs(10);
/// A server that publishes no results for so long is gone.
const GONE_AFTER: Duration = Duration::from_secs(3);

/// One action.
pub(in crate::ros1) struct Client {
    shared: Arc<Shared>,
    tasks: [AbortHandle; 2],
}

struct Shared {
    bus: Arc<Inner>,
    name: String,
    type_name: String,
    goals: Mutex<HashMap<String, Goal>>,
    ends: OnceLock<Ends>,
    answers: Answers,
    state: watch::Sender<State>,
}

/// What this side publishes.
struct Ends {
    goal: Box<dyn Publisher>,
    cancel: Box<dyn Publisher>,
}

#[derive(Debug, Clone, PartialEq)]
enum State {
    Opening,
    /// Its topics are advertised and subscribed to.
    Open,
    /// The server's status has been heard.
    Heard,
    /// The topics cannot be used.
    Failed(String),
}

struct Goal {
    /// When the server last spoke of it, or when it was sent.
    seen: Instant,
    /// For how long the server may say nothing of it.
    patience: Duration,
    events: Arc<dyn GoalEvents>,
}

impl Goal {
    fn sent(now: Instant, events: Arc<dyn GoalEvents>) -> Self {
        Self {
            seen: now,
            patience: NEVER_TAKEN,
            events,
        }
    }

    fn is_heard_of(&mut self, now: Instant) {
        self.seen = now;
        self.patience = LOST_AFTER;
    }

    fn is_lost(&self, now: Instant) -> bool {
        now.duration_since(self.seen) > self.patience
    }
}

/// What the server publishes.
struct Heard {
    feedback: Subscription,
    result: Subscription,
    status: Subscription,
}

impl Client {
    /// Opens the action's topics in the background.
    pub(in crate::ros1) fn open(bus: &Arc<Inner>, name: &str, of: &Arc<ActionDef>) -> Self {
        let shared = Arc::new(Shared {
            bus: bus.clone(),
            name: name.to_owned(),
            type_name: of.name.clone(),
            goals: Mutex::default(),
            ends: OnceLock::new(),
            answers: Answers::default(),
            state: watch::Sender::new(State::Opening),
        });
        let (following, of) = (shared.clone(), of.clone());
        let follow = bus.spawn(async move {
            match following.open(&of).await {
                Ok(heard) => following.follow(heard).await,
                Err(error) => following.fail_all(&error.to_string()),
            }
        });
        let tasks = [follow, bus.spawn(watch_server(shared.clone()))];
        Self { shared, tasks }
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        for task in &self.tasks {
            task.abort();
        }
        // Whoever has sent them needs them no longer.
        let goals = std::mem::take(&mut *self.shared.goals.lock());
        if let Some(ends) = self.shared.ends.get() {
            for id in goals.into_keys() {
                ends.cancel.publish(cancel(&id));
            }
        }
    }
}

#[async_trait]
impl ActionClient for Client {
    async fn ready(&self, patience: Duration) -> Result<(), BusError> {
        let shared = &self.shared;
        let ready = async {
            let mut state = shared.state.subscribe();
            let heard = state.wait_for(|state| matches!(state, State::Heard | State::Failed(_)));
            // The sender lives as long as `self`.
            if let Ok(State::Failed(reason)) = heard.await.as_deref() {
                return Err(BusError::CallFailed {
                    service: format!("action {}", shared.name),
                    reason: reason.clone(),
                    fate: CallFate::NotTaken,
                });
            }
            shared.takes_goals().await;
            shared.answers.reach_us(&shared.bus, &shared.name).await;
            Ok(())
        };
        let ready = async {
            tokio::select! {
                biased;
                other = shared.has_other_type() => Err(other),
                ready = ready => ready,
            }
        };
        match timeout(patience, ready).await {
            Ok(ready) => ready,
            // It may take goals all the same, and only not have said how they stand.
            Err(_) if shared.is_connected() => Ok(()),
            Err(_) => Err(BusError::Timeout {
                what: format!("action {}", shared.name),
                after: patience,
            }),
        }
    }

    fn send(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        let Some(ends) = self.shared.ends.get() else {
            return events.ended(Err(format!("action {} is not ready", self.shared.name)));
        };
        let known = Goal::sent(Instant::now(), events);
        self.shared.goals.lock().insert(id.to_owned(), known);
        let stamp = Time::now();
        let id = GoalId {
            stamp,
            id: id.to_owned(),
        };
        ends.goal.publish(messages::write_goal(stamp, &id, &goal));
    }

    /// The server hears of it as soon as it is connected.
    fn cancel(&self, id: &str) {
        let shared = &self.shared;
        let Some(ends) = shared.ends.get() else {
            return;
        };
        if !shared.goals.lock().contains_key(id) {
            return;
        }
        let matched = ends.cancel.matched();
        if matched.borrow().connected() > 0 {
            return ends.cancel.publish(cancel(id));
        }
        let (waiting, id) = (shared.clone(), id.to_owned());
        shared.bus.spawn(async move {
            // Not for ever: a server need not care for cancels.
            let _ = timeout(CANCEL_WAITS, crate::bus::reaches(matched, 1)).await;
            let under_way = waiting.goals.lock().contains_key(&id);
            if let Some(ends) = waiting.ends.get().filter(|_| under_way) {
                ends.cancel.publish(cancel(&id));
            }
        });
    }
}

fn cancel(id: &str) -> Bytes {
    messages::write_cancel(&GoalId {
        stamp: Time::default(),
        id: id.to_owned(),
    })
}

impl Shared {
    async fn open(&self, of: &ActionDef) -> Result<Heard, BusError> {
        let topics = super::Topics::of(&self.bus, &self.name, of)?;
        let heard = Heard {
            feedback: topics.subscribe("feedback").await?,
            result: topics.subscribe("result").await?,
            status: topics.subscribe("status").await?,
        };
        let ends = Ends {
            goal: topics.advertise("goal", false).await?,
            cancel: topics.advertise("cancel", false).await?,
        };
        // Set once, here.
        let _ = self.ends.set(ends);
        self.state.send_replace(State::Open);
        Ok(heard)
    }

    async fn follow(&self, mut heard: Heard) {
        loop {
            tokio::select! {
                // Feedback came before the result that it belongs to.
                biased;
                Some(message) = heard.feedback.messages.recv() => self.feedback(&message.bytes),
                Some(message) = heard.result.messages.recv() => self.result(&message.bytes),
                Some(message) = heard.status.messages.recv() => self.status(&message.bytes),
                else => return self.fail_all("the connection to this ROS system was closed"),
            }
        }
    }

    fn matched(&self) -> Option<watch::Receiver<Matched>> {
        Some(self.ends.get()?.goal.matched())
    }

    /// Whether somebody takes goals here who also sends results. Who only observes goals does not, and a server that is on its way
    /// in or out, registered for one of both, does not either: it has no type yet, or no longer.
    fn has_server(&self, matched: &Matched, graph: &Graph) -> bool {
        let nodes = graph.actions.get(&self.name);
        nodes.is_some_and(|nodes| nodes.servers.iter().any(|node| matched.has_node(node)))
    }

    fn is_connected(&self) -> bool {
        self.matched()
            .is_some_and(|matched| self.has_server(&matched.borrow(), &self.bus.graph.borrow()))
    }

    /// Returns when its servers turn out to have another type.
    async fn has_other_type(&self) -> BusError {
        let mut graph = self.bus.graph.subscribe();
        loop {
            let other = graph
                .borrow_and_update()
                .other_action(&self.name, &self.type_name);
            if let Some(other) = other {
                return other;
            }
            if graph.changed().await.is_err() {
                return BusError::Closed;
            }
        }
    }

    /// Returns once all are connected who are registered to take goals, a server among them.
    async fn takes_goals(&self) {
        let Some(mut matched) = self.matched() else {
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
                let has_other_type = graph.other_action(&self.name, &self.type_name).is_some();
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

    fn feedback(&self, bytes: &Bytes) {
        let Some((state, body)) = messages::read_state(bytes) else {
            return;
        };
        let events = match self.goals.lock().get_mut(&state.goal.id) {
            Some(goal) => {
                goal.is_heard_of(Instant::now());
                goal.events.clone()
            }
            None => return,
        };
        events.feedback(body);
    }

    fn result(&self, bytes: &Bytes) {
        let Some((state, body)) = messages::read_state(bytes) else {
            return;
        };
        let Some(goal) = self.goals.lock().remove(&state.goal.id) else {
            return;
        };
        let outcome = match state.status {
            Status::Succeeded => Outcome::Succeeded,
            Status::Preempted | Status::Recalled => Outcome::Canceled,
            Status::Aborted => Outcome::Aborted,
            Status::Rejected => Outcome::Rejected,
            _ => Outcome::Unknown,
        };
        goal.events.ended(Ok(GoalEnd {
            outcome,
            text: state.text,
            result: body,
        }));
    }

    fn status(&self, bytes: &Bytes) {
        let Some(states) = messages::read_states(bytes) else {
            return;
        };
        self.state.send_if_modified(|state| {
            let first = *state == State::Open;
            if first {
                *state = State::Heard;
            }
            first
        });
        let now = Instant::now();
        let mut lost = Vec::new();
        let mut goals = self.goals.lock();
        for (id, goal) in goals.iter_mut() {
            if states.iter().any(|state| state.goal.id == *id) {
                goal.is_heard_of(now);
            } else if goal.is_lost(now) {
                lost.push(id.clone());
            }
        }
        let lost: Vec<_> = lost.iter().filter_map(|id| goals.remove(id)).collect();
        drop(goals);
        for goal in lost {
            let reason = "the action server no longer knows the goal";
            goal.events.ended(Err(reason.to_owned()));
        }
    }

    fn end_all(&self, reason: &str) {
        let goals = std::mem::take(&mut *self.goals.lock());
        for goal in goals.into_values() {
            goal.events.ended(Err(reason.to_owned()));
        }
    }

    fn fail_all(&self, reason: &str) {
        self.state.send_replace(State::Failed(reason.to_owned()));
        self.end_all(reason);
    }
}

/// Ends the goals of a server that has gone.
async fn watch_server(shared: Arc<Shared>) {
    let mut graph = shared.bus.graph.subscribe();
    let topic = format!("{}/result", shared.name);
    let there = |graph: &Arc<crate::bus::Graph>| {
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
        shared.end_all(&format!("action server {} is gone", shared.name));
        if graph.wait_for(there).await.is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Nobody;

    impl GoalEvents for Nobody {
        fn feedback(&self, _: Bytes) {}

        fn ended(&self, _: Result<GoalEnd, String>) {}
    }

    #[test]
    fn a_goal_that_nobody_took_yet_is_waited_for_longer_than_one_that_was_dropped() {
        let begin = Instant::now();
        let after = |seconds| begin + Duration::from_secs(seconds);
        let mut goal = Goal::sent(begin, Arc::new(Nobody));
        assert!(!goal.is_lost(after(30)) && goal.is_lost(after(61)));
        goal.is_heard_of(after(30));
        assert!(!goal.is_lost(after(34)) && goal.is_lost(after(36)));
    }
}
