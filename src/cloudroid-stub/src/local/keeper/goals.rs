//! Goals of ROS 2's actions, which consist of service calls. A goal is one request, from its sending to its result: it
//! is given to one side, or to both, and each is asked for the result as soon as it has accepted the goal.
//!
//! ```text
//!   client                keeper                        a side that is given the goal
//!     │── send_goal ────────▶│── send_goal ────────────────▶│
//!     │◀─ first acceptance ──│◀─ accepted ──────────────────│
//!     │── get_result ───────▶│── get_result ───────────────▶│
//!     │◀─ first result ──────│◀─ result ────────────────────│
//!     │── cancel_goal ──────▶│── to all that were given it ▶│
//! ```
//!
//! A side that does not know a goal says so at once, which is no result. So a side that was given a goal before is
//! asked for its result first: it may still be executing it, although the link was lost.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use link::clock;
use qos::{CorrelationKey, Failure, RequestId, Responder};
use ros::bus::{FailureReason, SerializedMessage, WireFormat};
use tokio::sync::oneshot;

use super::goal_messages::{self as messages, ALL, GoalId};
use super::{Keeper, Payload};

/// Time for which results are kept for late requests, and their largest number.
const RESULT_EXPIRY: Duration = Duration::from_secs(900);
const MAX_RESULTS: usize = 1000;

/// A goal as it was sent.
#[derive(Debug)]
pub struct GoalRequest {
    id: GoalId,
    action: Arc<str>,
    /// Request that sent the goal.
    request: Bytes,
}

impl GoalRequest {
    fn service_name(&self, part: &str) -> String {
        action_service(&self.action, part)
    }
}

fn action_service(action: &str, part: &str) -> String {
    format!("{action}/_action/{part}")
}

/// Goals in progress, and ended goals whose results are kept.
#[derive(Default)]
pub(super) struct KeeperGoals(HashMap<GoalId, KeeperGoal>);

struct KeeperGoal {
    request: RequestId,
    action: Arc<str>,
    /// Receiver of the response to the goal, until it is accepted or refused.
    sender: Option<oneshot::Sender<Bytes>>,
    /// Set if the sender wants to cancel the goal.
    canceled: bool,
    /// Number of times that each side was given the goal.
    given: [u32; 2],
    /// Callers that wait for the result.
    waiting: Vec<oneshot::Sender<Bytes>>,
    result: Option<Bytes>,
    /// Response of a side that had forgotten the goal.
    forgotten: Option<Bytes>,
    ended: Option<Instant>,
}

impl KeeperGoal {
    fn new(request: RequestId, action: &Arc<str>, sender: oneshot::Sender<Bytes>) -> Self {
        Self {
            request,
            action: action.clone(),
            sender: Some(sender),
            canceled: false,
            given: [0; 2],
            waiting: Vec::new(),
            result: None,
            forgotten: None,
            ended: None,
        }
    }

    fn end(&mut self, now: Instant, result: Bytes) {
        if self.result.is_none() {
            for waiting in self.waiting.drain(..) {
                let _ = waiting.send(result.clone());
            }
            self.result = Some(result);
            self.ended = Some(now);
        }
    }
}

impl KeeperGoals {
    fn insert(&mut self, now: Instant, id: GoalId, goal: KeeperGoal) {
        let old = |goal: &KeeperGoal| goal.ended.is_some_and(|ended| now - ended > RESULT_EXPIRY);
        self.0.retain(|_, goal| !old(goal));
        if self.0.len() >= MAX_RESULTS {
            let ended = self.0.iter().filter_map(|(id, goal)| Some((goal.ended?, *id)));
            if let Some((_, oldest)) = ended.min() {
                self.0.remove(&oldest);
            }
        }
        self.0.insert(id, goal);
    }

    /// Fails a goal that no side will end: its sender is told that it is not accepted, or gets the response of a side
    /// that had forgotten it.
    pub(super) fn fail(&mut self, request: RequestId) {
        let failed = self.0.iter().find(|(_, goal)| goal.request == request);
        let Some(goal) = failed.map(|(id, _)| *id).and_then(|id| self.0.remove(&id)) else {
            return;
        };
        if let Some(sender) = goal.sender {
            let _ = sender.send(messages::goal_response(false, clock::now()));
        }
        if let Some(forgotten) = goal.forgotten {
            for waiting in goal.waiting {
                let _ = waiting.send(forgotten.clone());
            }
        }
    }
}

/// Returns the key by which feedback is matched with its goal.
pub(super) fn feedback_key(topic: &str, message: &SerializedMessage) -> Option<CorrelationKey> {
    let of_action = message.wire_type.format == WireFormat::Cdr && topic.ends_with("/_action/feedback");
    let id = messages::goal_id(&message.bytes).filter(|_| of_action)?;
    Some(goal_key(&id))
}

fn goal_key(id: &GoalId) -> CorrelationKey {
    CorrelationKey::Goal(format!("{:032x}", u128::from_be_bytes(*id)).into())
}

impl Keeper {
    /// Handles a goal of the application. An action server cannot give a reason for a refusal.
    pub async fn send_goal(&self, action: &Arc<str>, request: Bytes) -> Result<Bytes, FailureReason> {
        let Some(id) = messages::goal_id(&request) else {
            return Err(FailureReason::new(format!("a goal of {action} has no id")));
        };
        let (sender, answer) = oneshot::channel();
        let sent = GoalRequest { id, action: action.clone(), request };
        let is_new = self.update(|state, now| {
            if state.goals.0.get(&id).is_some_and(|goal| goal.ended.is_none()) {
                return false;
            }
            state.ledger.record_input(now, action);
            let payload = Payload::Goal(Arc::new(sent));
            let request = state.governor.goal(now, action, goal_key(&id), payload);
            state.goals.insert(now, id, KeeperGoal::new(request, action, sender));
            true
        });
        let refused = || messages::goal_response(false, clock::now());
        if is_new { Ok(answer.await.unwrap_or_else(|_| refused())) } else { Ok(refused()) }
    }

    /// Handles a request of the application for a goal's result.
    pub async fn get_result(&self, action: &Arc<str>, request: Bytes) -> Result<Bytes, FailureReason> {
        let (sender, answer) = oneshot::channel();
        let known = self.update(|state, _| {
            let goal = state.goals.0.get_mut(&messages::goal_id(&request)?)?;
            match &goal.result {
                Some(result) => drop(sender.send(result.clone())),
                None => goal.waiting.push(sender),
            }
            Some(())
        });
        match known {
            Some(()) => answer.await.map_err(|_| FailureReason::new("the result of this goal is no longer available")),
            // The goal was sent before this stub started.
            None => self.forward(&action_service(action, "get_result"), request).await,
        }
    }

    /// Handles a request of the application to cancel a goal, or all.
    pub async fn cancel_goal(&self, action: &Arc<str>, request: Bytes) -> Result<Bytes, FailureReason> {
        let wanted = messages::goal_id(&request).unwrap_or(ALL);
        let (ids, sides) = self.update(|state, _| {
            let (mut ids, mut sides) = (Vec::new(), [false; 2]);
            let concerned = state.goals.0.iter_mut().filter(|(id, goal)| {
                goal.action == *action && goal.ended.is_none() && (wanted == ALL || **id == wanted)
            });
            for (id, goal) in concerned {
                goal.canceled = true;
                ids.push(*id);
                for side in [Responder::Cloud, Responder::Local] {
                    sides[side.index()] |= goal.given[side.index()] > 0;
                }
            }
            (ids, sides)
        });
        let service = action_service(action, "cancel_goal");
        if ids.is_empty() {
            return self.forward(&service, request).await;
        }
        if sides == [false; 2] {
            // It is cancelled as soon as a side has accepted it.
            return Ok(messages::cancel_response(&ids));
        }
        let given = [Responder::Cloud, Responder::Local].into_iter();
        let given = given.filter(|side| sides[side.index()]);
        let mut answers: FuturesUnordered<_> =
            given.map(|side| tokio::spawn(self.call_side(side, &service, request.clone()))).collect();
        let mut last = Err(FailureReason::new("the goals are no longer known"));
        while let Some(answer) = answers.next().await {
            match answer {
                Ok(Ok(answer)) if messages::has_canceled_goals(&answer) => return Ok(answer),
                Ok(Ok(answer)) => last = Ok(answer),
                Ok(Err(failure)) if last.is_err() => {
                    last = Err(FailureReason::new(failure.text()));
                }
                _ => {}
            }
        }
        last
    }

    /// Has a side execute a goal.
    pub(super) fn give_goal(&self, side: Responder, request: RequestId, sent: &Arc<GoalRequest>) {
        let round = {
            let mut state = self.state.lock();
            let Some(goal) = state.goals.0.get_mut(&sent.id) else {
                return;
            };
            let round = &mut goal.given[side.index()];
            *round += 1;
            *round
        };
        let carrying = GoalRun { keeper: self.this.clone(), side, request, sent: Arc::clone(sent), round };
        tokio::spawn(carrying.run());
    }
}

/// The execution of one goal by one side.
struct GoalRun {
    keeper: Weak<Keeper>,
    side: Responder,
    request: RequestId,
    sent: Arc<GoalRequest>,
    /// Number of times that the side was given the goal, including this one.
    round: u32,
}

impl GoalRun {
    async fn run(self) {
        if let Err(failure) = self.run_to_end().await {
            self.on_failed(&failure);
        }
    }

    async fn run_to_end(&self) -> Result<(), Failure> {
        if self.round > 1 {
            let result = self.fetch_result().await?;
            if messages::is_result(&result) {
                self.on_result(result);
                return Ok(());
            }
        }
        let answer = self.call("send_goal", self.sent.request.clone()).await?;
        let is_wanted = if messages::is_accepted(&answer) {
            self.on_accepted(answer)
        } else {
            return self.on_refused(answer);
        };
        if !is_wanted {
            let canceled = messages::cancel_request(&self.sent.id);
            self.call("cancel_goal", canceled).await?;
        }
        let result = self.fetch_result().await?;
        if messages::is_result(&result) {
            self.on_result(result);
            return Ok(());
        }
        self.with_goal(|goal| goal.forgotten = Some(result));
        let node = match self.side {
            Responder::Cloud => "the node in the cloud",
            Responder::Local => "the local original",
        };
        let reason = format!("{node} has lost the goal that it had accepted");
        Err(Failure::Unreachable(reason))
    }

    async fn call(&self, part: &str, request: Bytes) -> Result<Bytes, Failure> {
        let ended = || Failure::Unreachable("the node is ending".to_owned());
        let asked = {
            let keeper = self.keeper.upgrade().ok_or_else(ended)?;
            keeper.call_side(self.side, &self.sent.service_name(part), request)
        };
        asked.await
    }

    async fn fetch_result(&self) -> Result<Bytes, Failure> {
        let request = messages::result_request(&self.sent.id);
        self.call("get_result", request).await
    }

    fn with_goal<T>(&self, change: impl FnOnce(&mut KeeperGoal) -> T) -> Option<T> {
        let keeper = self.keeper.upgrade()?;
        let mut state = keeper.state.lock();
        state.goals.0.get_mut(&self.sent.id).map(change)
    }

    /// Handles an acceptance; false if the sender has cancelled the goal.
    fn on_accepted(&self, answer: Bytes) -> bool {
        if let Some(keeper) = self.keeper.upgrade() {
            keeper.update(|state, now| state.governor.on_goal_accepted(now, self.request));
        }
        let is_wanted = self.with_goal(|goal| {
            if let Some(sender) = goal.sender.take() {
                let _ = sender.send(answer);
            }
            !goal.canceled
        });
        is_wanted.unwrap_or(false)
    }

    /// Handles a refusal, which is an answer unless the other side has accepted the goal.
    fn on_refused(&self, answer: Bytes) -> Result<(), Failure> {
        let refusal = Failure::Refused("the goal was not accepted".to_owned());
        let Some(keeper) = self.keeper.upgrade() else {
            return Ok(());
        };
        keeper.update(|state, now| {
            let goal = state.goals.0.get_mut(&self.sent.id);
            let Some(sender) = goal.and_then(|goal| goal.sender.take()) else {
                return Err(refusal);
            };
            state.goals.0.remove(&self.sent.id);
            let _ = sender.send(answer);
            let _ = state.governor.on_result(now, self.side, self.request);
            Ok(())
        })
    }

    fn on_result(&self, result: Bytes) {
        let Some(keeper) = self.keeper.upgrade() else {
            return;
        };
        keeper.update(|state, now| {
            // The first result is used, whether the governor still knows the goal or not.
            let _ = state.governor.on_result(now, self.side, self.request);
            if let Some(goal) = state.goals.0.get_mut(&self.sent.id) {
                if let Some(sender) = goal.sender.take() {
                    let _ = sender.send(messages::goal_response(true, clock::now()));
                }
                goal.end(now, result);
            }
        });
    }

    fn on_failed(&self, failure: &Failure) {
        let Some(keeper) = self.keeper.upgrade() else {
            return;
        };
        keeper.update(|state, now| {
            let lost = matches!(failure, Failure::Unreachable(_))
                && self.side == Responder::Cloud
                && !state.governor.sides().cloud;
            let goal = state.goals.0.get(&self.sent.id);
            let is_last = goal.is_some_and(|goal| goal.given[self.side.index()] == self.round);
            // A goal that was lost with the link is given to the cloud again.
            if is_last && !lost {
                let (side, request) = (self.side, self.request);
                state.governor.on_failure(now, side, request, failure);
            }
        });
    }
}

#[cfg(test)]
mod tests;
