//! The goals of an actionlib server and their states.

use std::collections::HashMap;
use std::time::Duration;

use budget::{Exceeded, Permit};
use ros_bus::GoalOutcome;
use ros_message::codec::Time;
use tokio::time::Instant;

use super::GoalLimits;
use crate::actions::messages::{ActionlibStatus, GoalId, GoalState};

/// Time for which an ended goal stays in the status list, as in actionlib.
const ENDED_GOAL_EXPIRY: Duration = Duration::from_secs(5);

/// Outcome of the arrival of a goal.
pub(super) enum Received {
    /// It is pending.
    Begun,
    /// There is, or was a moment ago, a goal with its id.
    Known,
    /// It has ended already.
    Ended(GoalState),
}

/// Reason for rejecting a goal without asking those who would execute it.
#[derive(Debug, thiserror::Error)]
enum GoalRejection {
    /// This number of goals has not ended.
    #[error("{0} goals of {1} are under way already; wait for some to end")]
    TooMany(usize, &'static str),
    /// The goal does not fit into the budget.
    #[error(transparent)]
    NoMemory(Exceeded),
}

pub(super) struct GoalTable {
    goals: HashMap<String, GoalEntry>,
    limits: GoalLimits,
    /// Goals up to this stamp are cancelled, including those that arrive after the cancel.
    cancelled_up_to: Time,
}

struct GoalEntry {
    state: GoalState,
    /// Permit for the goal until it ends.
    permit: Option<Permit>,
    /// Time at which it ended, or at which a cancel arrived before its goal.
    ended: Option<Instant>,
}

impl GoalTable {
    pub(super) fn new(limits: GoalLimits) -> Self {
        Self { goals: HashMap::new(), limits, cancelled_up_to: Time::default() }
    }

    /// Adds a goal whose message has this size in bytes.
    pub(super) fn begin(&mut self, goal: GoalId, size: usize) -> Received {
        let recalled = match self.goals.get(&goal.id) {
            // Only a cancel has been received.
            Some(known) if known.ended.is_some() && known.state.status == ActionlibStatus::Recalling => true,
            Some(_) => return Received::Known,
            None => goal.stamp != Time::default() && goal.stamp <= self.cancelled_up_to,
        };
        let room = if recalled { Ok(None) } else { self.check_room(size).map(Some) };
        let (status, text, permit) = match room {
            Ok(Some(permit)) => (ActionlibStatus::Pending, String::new(), Some(permit)),
            Ok(None) => (ActionlibStatus::Recalled, "the goal was cancelled before it came".to_owned(), None),
            Err(rejection) => (ActionlibStatus::Rejected, rejection.to_string(), None),
        };
        let ended = status.is_terminal().then(Instant::now);
        let state = GoalState { goal, status, text };
        self.goals.insert(state.goal.id.clone(), GoalEntry { state: state.clone(), permit, ended });
        if ended.is_none() {
            return Received::Begun;
        }
        self.prune();
        Received::Ended(state)
    }

    /// Returns a permit for a goal of this size.
    fn check_room(&self, size: usize) -> Result<Permit, GoalRejection> {
        let GoalLimits { goals, budget, holder } = &self.limits;
        if self.goals.values().filter(|goal| goal.ended.is_none()).count() >= *goals {
            return Err(GoalRejection::TooMany(*goals, holder));
        }
        budget.take(size).map_err(GoalRejection::NoMemory)
    }

    /// Marks a goal as being executed; returns true if it was not before.
    pub(super) fn accept(&mut self, id: &str) -> bool {
        let Some(goal) = self.find_under_way(id) else {
            return false;
        };
        goal.state.status = match goal.state.status {
            ActionlibStatus::Pending => ActionlibStatus::Active,
            ActionlibStatus::Recalling => ActionlibStatus::Preempting,
            _ => return false,
        };
        true
    }

    /// Marks the goals that a cancel concerns; returns those that were not marked before. A cancel of an unknown goal
    /// is remembered.
    pub(super) fn cancel(&mut self, wanted: GoalId) -> Vec<String> {
        let zero = wanted.stamp == Time::default();
        let matches = |goal: &GoalId| {
            goal.id == wanted.id || (wanted.id.is_empty() && zero) || (!zero && goal.stamp <= wanted.stamp)
        };
        let mut cancelled = Vec::new();
        for (id, goal) in &mut self.goals {
            if goal.ended.is_none() && matches(&goal.state.goal) {
                goal.state.status = match goal.state.status {
                    ActionlibStatus::Pending => ActionlibStatus::Recalling,
                    ActionlibStatus::Active => ActionlibStatus::Preempting,
                    _ => continue,
                };
                cancelled.push(id.clone());
            }
        }
        self.cancelled_up_to = wanted.stamp.max(self.cancelled_up_to);
        if !wanted.id.is_empty() && !self.goals.contains_key(&wanted.id) {
            let id = wanted.id.clone();
            let state = GoalState { goal: wanted, status: ActionlibStatus::Recalling, text: String::new() };
            self.goals.insert(id, GoalEntry { state, permit: None, ended: Some(Instant::now()) });
            self.prune();
        }
        cancelled
    }

    /// Ends a goal; returns its last state, or `None` if no goal with this id is active.
    pub(super) fn end(&mut self, id: &str, outcome: GoalOutcome, text: String) -> Option<GoalState> {
        let goal = self.find_under_way(id)?;
        let started = !matches!(goal.state.status, ActionlibStatus::Pending | ActionlibStatus::Recalling);
        goal.state.status = match outcome {
            GoalOutcome::Succeeded => ActionlibStatus::Succeeded,
            GoalOutcome::Canceled if started => ActionlibStatus::Preempted,
            GoalOutcome::Canceled => ActionlibStatus::Recalled,
            GoalOutcome::Rejected if !started => ActionlibStatus::Rejected,
            // Clients take no rejection of a goal that was active.
            GoalOutcome::Rejected | GoalOutcome::Aborted | GoalOutcome::Unknown => ActionlibStatus::Aborted,
        };
        goal.state.text = text;
        goal.permit = None;
        goal.ended = Some(Instant::now());
        let state = goal.state.clone();
        self.prune();
        Some(state)
    }

    /// Returns the ids of the goals that have not ended.
    pub(super) fn under_way(&self) -> Vec<String> {
        let goals = self.goals.iter();
        goals.filter(|(_, goal)| goal.ended.is_none()).map(|(id, _)| id.clone()).collect()
    }

    /// Returns the state of a goal that has not ended.
    pub(super) fn state_under_way(&self, id: &str) -> Option<GoalState> {
        let goal = self.goals.get(id).filter(|goal| goal.ended.is_none());
        goal.map(|goal| goal.state.clone())
    }

    /// Forgets the goals that ended some time ago; returns the states of the others.
    pub(super) fn states(&mut self) -> Vec<GoalState> {
        self.goals.retain(|_, goal| goal.ended.is_none_or(|ended| ended.elapsed() < ENDED_GOAL_EXPIRY));
        self.goals.values().map(|goal| goal.state.clone()).collect()
    }

    fn find_under_way(&mut self, id: &str) -> Option<&mut GoalEntry> {
        self.goals.get_mut(id).filter(|goal| goal.ended.is_none())
    }

    /// Forgets the oldest ended goal if there are too many; to be called for each goal that ends.
    fn prune(&mut self) {
        let ended = self.goals.iter().filter_map(|(id, goal)| Some((goal.ended?, id)));
        if ended.clone().count() <= self.limits.goals {
            return;
        }
        if let Some((_, first)) = ended.min() {
            let first = first.clone();
            self.goals.remove(&first);
        }
    }
}
