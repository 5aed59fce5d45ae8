//! Requests and responses of an action server, independent of the transport: DDS ([`super::Ros2ActionServer`]), or a
//! component that represents servers elsewhere.
//!
//! ```text
//!  send_goal ──▶ begin ─▶ answer             get_result ──▶ result
//!  cancel_goal ─▶ parse_cancel ─▶ cancel     publish_feedback, end_goal ─▶ GoalServerTopics
//! ```

mod goals;

use std::sync::Arc;
use std::time::Instant;

use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::{GoalEnd, GoalOutcome};
use ros_message::codec::{Time, default_message};
use ros_message::schema::ActionDef;
use tokio::sync::Notify;
use tokio::time::sleep_until;

pub use self::goals::GoalRefusal;
use self::goals::GoalTable;
use super::GoalId;
use super::messages::{self, ActionGoalStatus, CancelCode, GoalInfo};

/// Topics to which a server publishes. Must not block.
pub trait GoalServerTopics: Send + Sync + 'static {
    /// Publishes the feedback of one goal.
    fn publish_feedback(&self, message: Bytes);
    /// Publishes the statuses of all goals; late subscribers are given the last one.
    fn publish_status(&self, message: Bytes);
}

/// One action and its goals.
pub struct GoalServer<T> {
    name: String,
    of: Arc<ActionDef>,
    topics: T,
    goals: Mutex<GoalTable>,
    /// Held while statuses are published, so that the last ones published are current.
    telling: Mutex<()>,
    /// Notified when a goal has ended.
    ended: Notify,
    /// Notified when a result is requested.
    asked: Notify,
}

/// A goal that was received and not answered yet.
#[derive(Debug, Clone, Copy)]
pub struct PendingGoal {
    id: GoalId,
    accepted: Time,
}

impl PendingGoal {
    /// Returns the goal id as text.
    pub fn id(&self) -> String {
        self.id.to_string()
    }
}

/// Goals to be cancelled.
#[derive(Debug)]
pub struct CancelRequest {
    /// Each with whether it was asked to cancel before.
    goals: Vec<(GoalInfo, bool)>,
    /// Answer if none of them is cancelled.
    otherwise: CancelCode,
}

impl CancelRequest {
    /// Returns the ids of the goals that were not asked to cancel before.
    pub fn new_ids(&self) -> impl Iterator<Item = String> + '_ {
        let newly = self.goals.iter().filter(|(_, before)| !before);
        newly.map(|(goal, _)| goal.id.to_string())
    }
}

/// Outcome of a cancel request.
#[derive(Debug)]
pub struct CancelOutcome {
    /// Serialized response to the request.
    pub answer: Bytes,
    /// Ids of the goals that began to cancel.
    pub newly: Vec<String>,
}

impl<T: GoalServerTopics> GoalServer<T> {
    /// Creates a server without goals. Results kept for late requests are charged to `budget`.
    pub fn new(name: &str, of: &Arc<ActionDef>, topics: T, budget: Budget) -> Arc<Self> {
        let server = Arc::new(Self {
            name: name.to_owned(),
            of: of.clone(),
            topics,
            goals: Mutex::new(GoalTable::new(budget)),
            telling: Mutex::default(),
            ended: Notify::new(),
            asked: Notify::new(),
        });
        server.publish_statuses();
        server
    }

    /// Returns the action's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the topics to which it publishes.
    pub fn topics(&self) -> &T {
        &self.topics
    }

    /// Receives a goal; returns it with the serialized goal message. An error is the reason for rejecting it;
    /// [`rejected_response`] is then the answer to its sender.
    pub fn begin(&self, request: &[u8]) -> Result<(PendingGoal, Bytes), GoalRefusal> {
        let id = messages::read_id(request).filter(|id| *id != GoalId::NONE);
        let Some((id, goal)) = id.zip(messages::read_after_id(&self.of.goal, request)) else {
            return Err(GoalRefusal::NotAGoal(self.of.action_goal.name().to_owned()));
        };
        let accepted = Time::now();
        self.goals.lock().begin(id, accepted)?;
        Ok((PendingGoal { id, accepted }, goal))
    }

    /// Answers a goal: it is executed from now on if `taken`, and rejected otherwise. Returns the response to its
    /// sender.
    pub fn answer(&self, begun: &PendingGoal, taken: bool) -> Bytes {
        if taken {
            self.execute(begun);
        } else {
            self.reject(begun);
        }
        messages::write_accepted(taken, begun.accepted)
    }

    /// Accepts the goal without executing it yet; returns the response to its sender.
    pub fn accept(&self, begun: &PendingGoal) -> Bytes {
        self.goals.lock().set_accepted(begun.id);
        self.publish_statuses();
        messages::write_accepted(true, begun.accepted)
    }

    /// Marks the goal as executing.
    pub fn execute(&self, begun: &PendingGoal) {
        self.goals.lock().set_executing(begun.id);
        self.publish_statuses();
    }

    /// Rejects the goal; returns false if its sender has already been told that it was accepted.
    pub fn reject(&self, begun: &PendingGoal) -> bool {
        self.goals.lock().remove_rejected(begun.id)
    }

    /// Returns the response to a request for a goal's result, once the goal has ended.
    pub async fn result(&self, request: &[u8]) -> Bytes {
        let id = messages::read_id(request);
        let answer = id.and_then(|id| self.goals.lock().subscribe_result(id));
        self.asked.notify_one();
        if let Some(mut answer) = answer {
            // If the sender is gone, the goal was rejected meanwhile.
            if let Ok(ended) = answer.wait_for(Option::is_some).await {
                return ended.clone().unwrap_or_default();
            }
        }
        self.default_result(ActionGoalStatus::Unknown)
    }

    /// Determines the goals to be cancelled; `None` if the request cannot be read.
    pub fn parse_cancel(&self, request: &[u8]) -> Option<CancelRequest> {
        let wanted = messages::read_cancel(request)?;
        let goals = self.goals.lock();
        Some(CancelRequest { goals: goals.matching_goals(wanted), otherwise: goals.no_match_code(wanted) })
    }

    /// Cancels those goals for which `ends` returns true, in addition to those that were asked before.
    pub fn cancel(&self, wanted: &CancelRequest, ends: impl Fn(&str) -> bool) -> CancelOutcome {
        let all = wanted.goals.iter();
        let ending = all.filter(|(goal, before)| *before || ends(&goal.id.to_string()));
        let ending: Vec<GoalInfo> = ending.map(|(goal, _)| *goal).collect();
        let newly: Vec<String> = {
            let mut goals = self.goals.lock();
            let newly = ending.iter().filter(|goal| goals.set_canceling(goal.id));
            newly.map(|goal| goal.id.to_string()).collect()
        };
        if !newly.is_empty() {
            self.publish_statuses();
        }
        let code = match (ending.is_empty(), wanted.goals.is_empty()) {
            (false, _) => CancelCode::None,
            (true, false) => CancelCode::Rejected,
            (true, true) => wanted.otherwise,
        };
        CancelOutcome { answer: messages::write_cancelled(code, &ending), newly }
    }

    /// Returns true if there is a goal with this id that has not ended.
    pub fn is_under_way(&self, id: &str) -> bool {
        let goals = self.goals.lock();
        GoalId::parse(id).is_some_and(|id| goals.is_under_way(id))
    }

    /// Returns the ids of the goals that have not ended.
    pub fn under_way(&self) -> Vec<String> {
        self.goals.lock().under_way().iter().map(GoalId::to_string).collect()
    }

    /// Publishes feedback for a goal; returns false if no goal with this id is active.
    pub fn publish_feedback(&self, id: &str, feedback: &[u8]) -> bool {
        let id = GoalId::parse(id).filter(|id| self.goals.lock().is_under_way(*id));
        let Some(id) = id else {
            return false;
        };
        match messages::write_with_id(id, &self.of.feedback, feedback) {
            Some(message) => self.topics.publish_feedback(message),
            None => {
                let (action, expected) = (&self.name, self.of.feedback.name());
                tracing::debug!(action, expected, "feedback of another type was dropped");
            }
        }
        true
    }

    /// Ends a goal; returns false if no goal with this id is active.
    pub fn end_goal(&self, id: &str, end: &GoalEnd) -> bool {
        let id = GoalId::parse(id);
        let ended = id.is_some_and(|id| self.finish(id, end.outcome, &end.result));
        if ended {
            self.publish_statuses();
        }
        ended
    }

    /// Ends a goal; returns false if it is not active. A goal cannot have succeeded without a result.
    fn finish(&self, id: GoalId, outcome: GoalOutcome, result: &[u8]) -> bool {
        let of = &self.of.result;
        let mut status = match outcome {
            GoalOutcome::Succeeded => ActionGoalStatus::Succeeded,
            GoalOutcome::Canceled => ActionGoalStatus::Canceled,
            GoalOutcome::Aborted | GoalOutcome::Rejected | GoalOutcome::Unknown => ActionGoalStatus::Aborted,
        };
        let answer = messages::write_result(status, of, result).unwrap_or_else(|| {
            if status == ActionGoalStatus::Succeeded {
                let (action, expected) = (&self.name, of.name());
                tracing::warn!(action, expected, "a result of another type aborts its goal");
                status = ActionGoalStatus::Aborted;
            }
            self.default_result(status)
        });
        let ended = self.goals.lock().end(id, status, answer, Instant::now());
        self.ended.notify_one();
        ended
    }

    /// Aborts all goals and accepts no more.
    pub fn close(&self) {
        let under_way = {
            let mut goals = self.goals.lock();
            goals.close();
            goals.under_way()
        };
        for id in &under_way {
            self.finish(*id, GoalOutcome::Aborted, &[]);
        }
        if !under_way.is_empty() {
            self.publish_statuses();
        }
    }

    /// Returns true if each result has been requested.
    pub(super) fn are_results_requested(&self) -> bool {
        self.goals.lock().are_results_requested()
    }

    /// Waits until each result has been requested.
    pub(super) async fn wait_until_results_requested(&self) {
        while !self.are_results_requested() {
            self.asked.notified().await;
        }
    }

    /// Drops results that were not requested in time, for as long as it is polled.
    pub async fn expire_results(&self) {
        loop {
            let next = self.goals.lock().next_expiry();
            match next {
                Some(next) => sleep_until(next.into()).await,
                None => self.ended.notified().await,
            }
            let forgot = self.goals.lock().expire(Instant::now());
            if forgot {
                self.publish_statuses();
            }
        }
    }

    /// Returns a result of default values.
    fn default_result(&self, status: ActionGoalStatus) -> Bytes {
        let nothing = default_message(&self.of.result);
        messages::write_result(status, &self.of.result, &nothing).unwrap_or_default()
    }

    fn publish_statuses(&self) {
        let _telling = self.telling.lock();
        let statuses = self.goals.lock().statuses();
        self.topics.publish_status(messages::write_statuses(&statuses));
    }
}

/// Returns the response to the sender of a rejected goal.
pub fn rejected_response() -> Bytes {
    messages::write_accepted(false, Time::now())
}

/// Returns the response to a cancel request that cannot be read.
pub fn cancel_rejected_response() -> Bytes {
    messages::write_cancelled(CancelCode::Rejected, &[])
}
