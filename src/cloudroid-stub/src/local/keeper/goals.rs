//! Goals of ROS 2's actions, which are made of calls. A goal is one request, from when it is sent until its result: it is given to a
//! side, or to both, and each is asked for the result as soon as it has accepted.
//!
//! ```text
//!   client                keeper                        a side that is given the goal
//!     │── send_goal ────────▶│── send_goal ────────────────▶│
//!     │◀─ first acceptance ──│◀─ accepted ──────────────────│
//!     │── get_result ───────▶│── get_result ───────────────▶│
//!     │◀─ first result ──────│◀─ result ────────────────────│
//!     │── cancel_goal ──────▶│── to all that were given it ▶│
//! ```
//! A side that does not know a goal says so at once, which is no result. So one that was given a goal before is asked for the result
//! first: it may be at it still, though the link forgot.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use link::clock;
use qos::{Failure, Key, RequestId, Side};
use ros::bus::{Message, WireFormat};
use tokio::sync::oneshot;

use super::goal_messages::{self as messages, ALL, GoalId};
use super::{Keeper, Payload};

/// Results are kept so long for those who ask for them late, and so many of them.
const KEPT: Duration = Duration::from_secs(900);
const MOST: usize = 1000;

/// A goal as it was sent.
#[derive(Debug)]
pub struct Sent {
    id: GoalId,
    action: Arc<str>,
    /// The request by which it was sent.
    request: Bytes,
}

impl Sent {
    fn part(&self, part: &str) -> String {
        part_of(&self.action, part)
    }
}

fn part_of(action: &str, part: &str) -> String {
    format!("{action}/_action/{part}")
}

/// Goals under way, and ended ones whose results are kept.
#[derive(Default)]
pub(super) struct Goals(HashMap<GoalId, Goal>);

struct Goal {
    request: RequestId,
    action: Arc<str>,
    /// Who has sent it, until it is accepted or not.
    sender: Option<oneshot::Sender<Bytes>>,
    /// Whoever has sent it wants it to end.
    canceled: bool,
    /// How often each side was given it.
    given: [u32; 2],
    /// Who waits for its result.
    waiting: Vec<oneshot::Sender<Bytes>>,
    result: Option<Bytes>,
    /// What a side has answered that had forgotten it.
    forgotten: Option<Bytes>,
    ended: Option<Instant>,
}

impl Goal {
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

impl Goals {
    fn begin(&mut self, now: Instant, id: GoalId, goal: Goal) {
        let old = |goal: &Goal| goal.ended.is_some_and(|ended| now - ended > KEPT);
        self.0.retain(|_, goal| !old(goal));
        if self.0.len() >= MOST {
            let ended = self
                .0
                .iter()
                .filter_map(|(id, goal)| Some((goal.ended?, *id)));
            if let Some((_, oldest)) = ended.min() {
                self.0.remove(&oldest);
            }
        }
        self.0.insert(id, goal);
    }

    /// Nobody will end this one: whoever sent it is told that it is not accepted, or what a side has said that had forgotten it.
    pub(super) fn fail(&mut self, request: RequestId) {
        let failed = self.0.iter().find(|(_, goal)| goal.request == request);
        let Some(goal) = failed.map(|(id, _)| *id).and_then(|id| self.0.remove(&id)) else {
            return;
        };
        if let Some(sender) = goal.sender {
            let _ = sender.send(messages::answer(false, clock::now()));
        }
        if let Some(forgotten) = goal.forgotten {
            for waiting in goal.waiting {
                let _ = waiting.send(forgotten.clone());
            }
        }
    }
}

/// By what feedback of a goal is recognised.
pub(super) fn key_of_feedback(topic: &str, message: &Message) -> Option<Key> {
    let of_action =
        message.wire_type.format == WireFormat::Cdr && topic.ends_with("/_action/feedback");
    let id = messages::id_of(&message.bytes).filter(|_| of_action)?;
    Some(key_of(&id))
}

fn key_of(id: &GoalId) -> Key {
    Key::Goal(format!("{:032x}", u128::from_be_bytes(*id)).into())
}

impl Keeper {
    /// The application sends a goal. An action's server has no way to say why it does not take one.
    pub async fn send_goal(&self, action: &Arc<str>, request: Bytes) -> Result<Bytes, String> {
        let Some(id) = messages::id_of(&request) else {
            return Err(format!("a goal of {action} has no id"));
        };
        let (sender, answer) = oneshot::channel();
        let sent = Sent {
            id,
            action: action.clone(),
            request,
        };
        let is_new = self.with(|state, now| {
            if state
                .goals
                .0
                .get(&id)
                .is_some_and(|goal| goal.ended.is_none())
            {
                return false;
            }
            state.ledger.told(now, action);
            let payload = Payload::Goal(Arc::new(sent));
            let request = state.governor.goal(now, action, key_of(&id), payload);
            state
                .goals
                .begin(now, id, Goal::new(request, action, sender));
            true
        });
        let refused = || messages::answer(false, clock::now());
        match is_new {
            true => Ok(answer.await.unwrap_or_else(|_| refused())),
            false => Ok(refused()),
        }
    }

    /// The application wants the result of a goal.
    pub async fn get_result(&self, action: &Arc<str>, request: Bytes) -> Result<Bytes, String> {
        let (sender, answer) = oneshot::channel();
        let known = self.with(|state, _| {
            let goal = state.goals.0.get_mut(&messages::id_of(&request)?)?;
            match &goal.result {
                Some(result) => drop(sender.send(result.clone())),
                None => goal.waiting.push(sender),
            }
            Some(())
        });
        match known {
            Some(()) => answer
                .await
                .map_err(|_| "nobody can tell the result of this goal any more".to_owned()),
            // Sent before this stub began.
            None => self.pass(&part_of(action, "get_result"), request).await,
        }
    }

    /// The application wants a goal, or all, to end.
    pub async fn cancel_goal(&self, action: &Arc<str>, request: Bytes) -> Result<Bytes, String> {
        let wanted = messages::id_of(&request).unwrap_or(ALL);
        let (ids, sides) = self.with(|state, _| {
            let (mut ids, mut sides) = (Vec::new(), [false; 2]);
            let concerned = state.goals.0.iter_mut().filter(|(id, goal)| {
                goal.action == *action && goal.ended.is_none() && (wanted == ALL || **id == wanted)
            });
            for (id, goal) in concerned {
                goal.canceled = true;
                ids.push(*id);
                for side in [Side::Cloud, Side::Local] {
                    sides[side.index()] |= goal.given[side.index()] > 0;
                }
            }
            (ids, sides)
        });
        let service = part_of(action, "cancel_goal");
        if ids.is_empty() {
            return self.pass(&service, request).await;
        }
        if sides == [false; 2] {
            // It is cancelled as soon as somebody has taken it.
            return Ok(messages::canceled(&ids));
        }
        let given = [Side::Cloud, Side::Local].into_iter();
        let given = given.filter(|side| sides[side.index()]);
        let mut answers: FuturesUnordered<_> = given
            .map(|side| tokio::spawn(self.ask(side, &service, request.clone())))
            .collect();
        let mut last = Err("nobody has the goals any more".to_owned());
        while let Some(answer) = answers.next().await {
            match answer {
                Ok(Ok(answer)) if messages::cancels(&answer) => return Ok(answer),
                Ok(Ok(answer)) => last = Ok(answer),
                Ok(Err(failure)) if last.is_err() => last = Err(failure.text().to_owned()),
                _ => {}
            }
        }
        last
    }

    /// Has a side carry out a goal.
    pub(super) fn give_goal(&self, side: Side, request: RequestId, sent: &Arc<Sent>) {
        let round = {
            let mut state = self.state.lock();
            let Some(goal) = state.goals.0.get_mut(&sent.id) else {
                return;
            };
            let round = &mut goal.given[side.index()];
            *round += 1;
            *round
        };
        let carrying = Carrying {
            keeper: self.this.clone(),
            side,
            request,
            sent: Arc::clone(sent),
            round,
        };
        tokio::spawn(carrying.carry());
    }
}

/// One goal at one side.
struct Carrying {
    keeper: Weak<Keeper>,
    side: Side,
    request: RequestId,
    sent: Arc<Sent>,
    /// How often the side was given the goal, with this time.
    round: u32,
}

impl Carrying {
    async fn carry(self) {
        if let Err(failure) = self.to_its_end().await {
            self.failed(&failure);
        }
    }

    async fn to_its_end(&self) -> Result<(), Failure> {
        if self.round > 1 {
            let result = self.result().await?;
            if messages::is_result(&result) {
                self.ended(result);
                return Ok(());
            }
        }
        let answer = self.ask("send_goal", self.sent.request.clone()).await?;
        let is_wanted = match messages::is_accepted(&answer) {
            true => self.accepted(answer),
            false => return self.refused(answer),
        };
        if !is_wanted {
            let canceled = messages::cancel(&self.sent.id);
            self.ask("cancel_goal", canceled).await?;
        }
        let result = self.result().await?;
        if messages::is_result(&result) {
            self.ended(result);
            return Ok(());
        }
        self.with_goal(|goal| goal.forgotten = Some(result));
        let node = match self.side {
            Side::Cloud => "the node in the cloud",
            Side::Local => "the local original",
        };
        let reason = format!("{node} has forgotten the goal that it had accepted");
        Err(Failure::Unreachable(reason))
    }

    async fn ask(&self, part: &str, request: Bytes) -> Result<Bytes, Failure> {
        let ended = || Failure::Unreachable("the node is ending".to_owned());
        let asked = {
            let keeper = self.keeper.upgrade().ok_or_else(ended)?;
            keeper.ask(self.side, &self.sent.part(part), request)
        };
        asked.await
    }

    async fn result(&self) -> Result<Bytes, Failure> {
        let request = messages::get_result(&self.sent.id);
        self.ask("get_result", request).await
    }

    fn with_goal<T>(&self, change: impl FnOnce(&mut Goal) -> T) -> Option<T> {
        let keeper = self.keeper.upgrade()?;
        let mut state = keeper.state.lock();
        state.goals.0.get_mut(&self.sent.id).map(change)
    }

    /// It is carried out. False where whoever sent it wants it no more.
    fn accepted(&self, answer: Bytes) -> bool {
        if let Some(keeper) = self.keeper.upgrade() {
            keeper.with(|state, now| state.governor.accepted(now, self.request));
        }
        let is_wanted = self.with_goal(|goal| {
            if let Some(sender) = goal.sender.take() {
                let _ = sender.send(answer);
            }
            !goal.canceled
        });
        is_wanted.unwrap_or(false)
    }

    /// A refusal is an answer, unless the other side has accepted the goal.
    fn refused(&self, answer: Bytes) -> Result<(), Failure> {
        let refusal = Failure::Refused("the goal was not accepted".to_owned());
        let Some(keeper) = self.keeper.upgrade() else {
            return Ok(());
        };
        keeper.with(|state, now| {
            let goal = state.goals.0.get_mut(&self.sent.id);
            let Some(sender) = goal.and_then(|goal| goal.sender.take()) else {
                return Err(refusal);
            };
            state.goals.0.remove(&self.sent.id);
            let _ = sender.send(answer);
            let _ = state.governor.answered(now, self.side, self.request);
            Ok(())
        })
    }

    fn ended(&self, result: Bytes) {
        let Some(keeper) = self.keeper.upgrade() else {
            return;
        };
        keeper.with(|state, now| {
            // The first one is taken, whether the governor still knows of the goal or not.
            let _ = state.governor.answered(now, self.side, self.request);
            if let Some(goal) = state.goals.0.get_mut(&self.sent.id) {
                if let Some(sender) = goal.sender.take() {
                    let _ = sender.send(messages::answer(true, clock::now()));
                }
                goal.end(now, result);
            }
        });
    }

    fn failed(&self, failure: &Failure) {
        let Some(keeper) = self.keeper.upgrade() else {
            return;
        };
        keeper.with(|state, now| {
            let lost = matches!(failure, Failure::Unreachable(_))
                && self.side == Side::Cloud
                && !state.governor.sides().cloud;
            let goal = state.goals.0.get(&self.sent.id);
            let is_last = goal.is_some_and(|goal| goal.given[self.side.index()] == self.round);
            // A goal that was lost with the link is given to the cloud again.
            if is_last && !lost {
                let (side, request) = (self.side, self.request);
                state.governor.failed(now, side, request, failure);
            }
        });
    }
}

#[cfg(test)]
mod tests;
