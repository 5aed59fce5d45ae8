//! The goals of an action server, including the results of ended goals for late requests.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use budget::{Budget, Permit};
use bytes::Bytes;
use ros_message::codec::Time;
use tokio::sync::watch;

use crate::actions::GoalId;
use crate::actions::messages::{ActionGoalStatus, CancelCode, GoalInfo};

/// Maximum number of active goals of a server.
pub(super) const MAX_GOALS: usize = 1000;
/// Time for which a result is kept.
const KEPT: Duration = Duration::from_secs(60);
/// Maximum number of results kept, and their maximum total size in bytes; the last one is kept whatever its size.
const MAX_KEPT: usize = 256;
const MAX_KEPT_BYTES: usize = 64 << 20;

/// Receives the response to a result request, once the goal has ended.
pub(super) type ResultReceiver = watch::Receiver<Option<Bytes>>;

/// The reason for rejecting a goal without asking those who would execute it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum GoalRefusal {
    /// The bytes are no message of the action's goal type.
    #[error("it is not a serialized {0}")]
    NotAGoal(
        /// Name of the goal type.
        String,
    ),
    /// The server is closed.
    #[error("its server is gone")]
    ServerGone,
    /// Another goal has this id, or had it until its result was forgotten.
    #[error("there is already a goal with this id")]
    AlreadyThere,
    /// As many goals have not ended as a server can have.
    #[error("{MAX_GOALS} goals wait for this server already")]
    TooMany,
}

pub(super) struct GoalTable {
    known: HashMap<GoalId, GoalEntry>,
    /// Ended goals with their expiry, in order of expiry.
    ended: VecDeque<(Instant, GoalId)>,
    kept_bytes: usize,
    /// Budget for the results kept.
    budget: Budget,
    begun: u64,
    closed: bool,
}

struct GoalEntry {
    /// Sequence number for ordering goals.
    number: u64,
    accepted: Time,
    /// Unknown until the goal is accepted.
    status: ActionGoalStatus,
    /// True once its result has been requested.
    asked: bool,
    answer: watch::Sender<Option<Bytes>>,
    /// Permit for the result.
    permit: Option<Permit>,
}

impl GoalTable {
    pub(super) fn new(budget: Budget) -> Self {
        Self { known: HashMap::new(), ended: VecDeque::new(), kept_bytes: 0, budget, begun: 0, closed: false }
    }

    /// Adds a goal, unless there is no room for it.
    pub(super) fn begin(&mut self, id: GoalId, accepted: Time) -> Result<(), GoalRefusal> {
        if self.closed {
            return Err(GoalRefusal::ServerGone);
        }
        if self.known.contains_key(&id) {
            return Err(GoalRefusal::AlreadyThere);
        }
        if self.known.len() - self.ended.len() >= MAX_GOALS {
            return Err(GoalRefusal::TooMany);
        }
        self.begun += 1;
        let known = GoalEntry {
            number: self.begun,
            accepted,
            status: ActionGoalStatus::Unknown,
            asked: false,
            answer: watch::Sender::new(None),
            permit: None,
        };
        self.known.insert(id, known);
        Ok(())
    }

    /// Marks a goal as accepted, to be executed later.
    pub(super) fn set_accepted(&mut self, id: GoalId) {
        if let Some(known) = self.pending(id) {
            known.status = ActionGoalStatus::Accepted;
        }
    }

    /// Marks a goal as executing. It may have ended already.
    pub(super) fn set_executing(&mut self, id: GoalId) {
        let known = self.known.get_mut(&id);
        let waits =
            |known: &&mut GoalEntry| matches!(known.status, ActionGoalStatus::Unknown | ActionGoalStatus::Accepted);
        if let Some(known) = known.filter(waits) {
            known.status = ActionGoalStatus::Executing;
        }
    }

    /// Removes a goal that is rejected; returns false if it was accepted or has ended.
    pub(super) fn remove_rejected(&mut self, id: GoalId) -> bool {
        let pending = self.pending(id).is_some();
        if pending {
            self.known.remove(&id);
        }
        pending
    }

    fn pending(&mut self, id: GoalId) -> Option<&mut GoalEntry> {
        let known = self.known.get_mut(&id);
        known.filter(|known| known.status == ActionGoalStatus::Unknown)
    }

    pub(super) fn is_under_way(&self, id: GoalId) -> bool {
        let known = self.known.get(&id);
        known.is_some_and(|known| !known.status.is_terminal())
    }

    pub(super) fn under_way(&self) -> Vec<GoalId> {
        let ids = self.known.keys().copied();
        ids.filter(|id| self.is_under_way(*id)).collect()
    }

    /// Ends a goal; returns false if no goal with this id is active.
    pub(super) fn end(&mut self, id: GoalId, status: ActionGoalStatus, answer: Bytes, now: Instant) -> bool {
        if !self.is_under_way(id) {
            return false;
        }
        let size = answer.len();
        self.kept_bytes += size;
        while self.ended.len() >= MAX_KEPT || (self.kept_bytes > MAX_KEPT_BYTES && !self.ended.is_empty()) {
            self.remove_oldest();
        }
        let mut permit = self.budget.take(size);
        while permit.is_err() && !self.ended.is_empty() {
            self.remove_oldest();
            permit = self.budget.take(size);
        }
        self.ended.push_back((now + KEPT, id));
        if let Some(known) = self.known.get_mut(&id) {
            known.status = status;
            known.permit = permit.ok();
            known.answer.send_replace(Some(answer));
        }
        true
    }

    /// Returns a receiver for the response to a result request; `None` if there is no such goal.
    pub(super) fn subscribe_result(&mut self, id: GoalId) -> Option<ResultReceiver> {
        let known = self.known.get_mut(&id)?;
        known.asked = true;
        Some(known.answer.subscribe())
    }

    /// Returns true if the result of each goal has been requested.
    pub(super) fn are_results_requested(&self) -> bool {
        self.known.values().all(|known| known.asked)
    }

    /// Returns the goals that a cancel request concerns, the oldest first, and whether each was asked to cancel before.
    /// By the policy that `action_msgs/srv/CancelGoal` specifies: without an id, all goals up to the stamp, or all
    /// goals if there is no stamp either; with an id that goal, and with a stamp also all goals up to it.
    pub(super) fn matching_goals(&self, wanted: GoalInfo) -> Vec<(GoalInfo, bool)> {
        let zero = wanted.stamp == Time::default();
        let all = wanted.id == GoalId::NONE && zero;
        let mut concerned: Vec<(u64, GoalInfo, bool)> = Vec::new();
        for (id, known) in &self.known {
            let stamped = !zero && known.accepted <= wanted.stamp;
            let before = match known.status {
                ActionGoalStatus::Canceling => true,
                ActionGoalStatus::Accepted | ActionGoalStatus::Executing => false,
                _ => continue,
            };
            if all || stamped || *id == wanted.id {
                concerned.push((known.number, known.info(*id), before));
            }
        }
        concerned.sort_by_key(|(number, ..)| *number);
        let concerned = concerned.into_iter();
        concerned.map(|(_, info, before)| (info, before)).collect()
    }

    /// Returns the code in the response to a cancel request that concerns no goal.
    pub(super) fn no_match_code(&self, wanted: GoalInfo) -> CancelCode {
        match self.known.get(&wanted.id) {
            Some(known) if known.status.is_terminal() => CancelCode::Terminated,
            _ if wanted.id == GoalId::NONE => CancelCode::Rejected,
            _ => CancelCode::UnknownGoal,
        }
    }

    /// Marks a goal as cancelling; returns false if it has ended or was asked before.
    pub(super) fn set_canceling(&mut self, id: GoalId) -> bool {
        let known = self.known.get_mut(&id);
        let goes_on =
            |known: &&mut GoalEntry| matches!(known.status, ActionGoalStatus::Accepted | ActionGoalStatus::Executing);
        let known = known.filter(goes_on);
        known.map(|known| known.status = ActionGoalStatus::Canceling).is_some()
    }

    /// Returns the statuses of all accepted goals, the oldest first.
    pub(super) fn statuses(&self) -> Vec<(GoalInfo, ActionGoalStatus)> {
        let taken = self.known.iter();
        let taken = taken.filter(|(_, known)| known.status != ActionGoalStatus::Unknown);
        let mut taken: Vec<_> = taken.collect();
        taken.sort_by_key(|(_, known)| known.number);
        let state = |(id, known): (&GoalId, &GoalEntry)| (known.info(*id), known.status);
        taken.into_iter().map(state).collect()
    }

    /// Drops expired results; returns true if there were any.
    pub(super) fn expire(&mut self, now: Instant) -> bool {
        let before = self.ended.len();
        while self.ended.front().is_some_and(|(until, _)| *until <= now) {
            self.remove_oldest();
        }
        self.ended.len() < before
    }

    /// Returns the next expiry of a result.
    pub(super) fn next_expiry(&self) -> Option<Instant> {
        self.ended.front().map(|(until, _)| *until)
    }

    fn remove_oldest(&mut self) {
        let first = self.ended.pop_front();
        let known = first.and_then(|(_, id)| self.known.remove(&id));
        let answer = known.and_then(|known| known.answer.borrow().as_ref().map(Bytes::len));
        self.kept_bytes -= answer.unwrap_or(0);
    }

    /// Accepts no further goals.
    pub(super) fn close(&mut self) {
        self.closed = true;
    }
}

impl GoalEntry {
    fn info(&self, id: GoalId) -> GoalInfo {
        GoalInfo { id, stamp: self.accepted }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(number: u8) -> GoalId {
        GoalId([number; 16])
    }

    fn time_at(secs: u32) -> Time {
        Time { secs, nsecs: 0 }
    }

    fn goals() -> GoalTable {
        GoalTable::new(Budget::without_limit())
    }

    /// Goals 1, 2, … accepted at second 1, 2, … and executing.
    fn executing_goals(count: u8) -> GoalTable {
        let mut goals = goals();
        for number in 1..=count {
            goals.begin(id(number), time_at(number.into())).unwrap();
            goals.set_executing(id(number));
        }
        goals
    }

    fn end(goals: &mut GoalTable, number: u8, now: Instant) -> bool {
        goals.end(id(number), ActionGoalStatus::Succeeded, Bytes::from_static(b"result"), now)
    }

    fn status_list(goals: &GoalTable) -> Vec<(u8, ActionGoalStatus)> {
        let statuses = goals.statuses().into_iter();
        statuses.map(|(info, status)| (info.id.0[0], status)).collect()
    }

    #[track_caller]
    fn assert_cancels(wanted: (GoalId, Time), code: CancelCode, expected: &[u8]) {
        let mut goals = executing_goals(4);
        end(&mut goals, 2, Instant::now());
        let (id, stamp) = wanted;
        let wanted = GoalInfo { id, stamp };
        let concerned = |goals: &GoalTable| -> Vec<(u8, bool)> {
            let concerned = goals.matching_goals(wanted).into_iter();
            concerned.map(|(info, before)| (info.id.0[0], before)).collect()
        };
        let all = |before| expected.iter().map(|number| (*number, before)).collect();
        let first: Vec<(u8, bool)> = all(false);
        assert_eq!(concerned(&goals), first);
        if first.is_empty() {
            assert_eq!(goals.no_match_code(wanted), code);
        }
        for number in expected {
            assert!(goals.set_canceling(super::GoalId([*number; 16])));
            assert!(!goals.set_canceling(super::GoalId([*number; 16])), "again");
        }
        for (number, status) in status_list(&goals) {
            let canceling = status == ActionGoalStatus::Canceling;
            assert_eq!(canceling, expected.contains(&number), "{number}");
        }
        let again: Vec<(u8, bool)> = all(true);
        assert_eq!(concerned(&goals), again);
    }

    #[test]
    fn a_cancel_names_one_goal_or_those_up_to_a_stamp_or_all() {
        let never = Time::default();
        assert_cancels((id(3), never), CancelCode::None, &[3]);
        assert_cancels((GoalId::NONE, never), CancelCode::None, &[1, 3, 4]);
        assert_cancels((GoalId::NONE, time_at(3)), CancelCode::None, &[1, 3]);
        assert_cancels((id(4), time_at(1)), CancelCode::None, &[1, 4]);
        assert_cancels((id(9), never), CancelCode::UnknownGoal, &[]);
        assert_cancels((id(2), never), CancelCode::Terminated, &[]);
        let early = Time { secs: 0, nsecs: 1 };
        assert_cancels((GoalId::NONE, early), CancelCode::Rejected, &[]);
    }

    #[test]
    fn a_goal_ends_once_and_its_result_is_there_for_a_minute() {
        let (mut goals, now) = (executing_goals(2), Instant::now());
        let early = goals.subscribe_result(id(1)).unwrap();
        assert_eq!(*early.borrow(), None);
        assert!(end(&mut goals, 1, now));
        assert!(!end(&mut goals, 1, now));
        assert_eq!(early.borrow().as_deref(), Some(&b"result"[..]));
        let late = goals.subscribe_result(id(1)).unwrap();
        assert_eq!(late.borrow().as_deref(), Some(&b"result"[..]));
        assert_eq!(status_list(&goals), [(1, ActionGoalStatus::Succeeded), (2, ActionGoalStatus::Executing)]);
        assert_eq!(goals.next_expiry(), Some(now + KEPT));
        assert!(!goals.expire(now));
        assert!(goals.expire(now + KEPT));
        assert!(goals.subscribe_result(id(1)).is_none());
        assert_eq!((status_list(&goals), goals.next_expiry()), (vec![(2, ActionGoalStatus::Executing)], None));
        assert_eq!(goals.under_way(), [id(2)]);
    }

    #[test]
    fn results_that_are_kept_are_bounded() {
        let (mut goals, now) = (executing_goals(3), Instant::now());
        let large = Bytes::from(vec![0; MAX_KEPT_BYTES]);
        assert!(goals.end(id(1), ActionGoalStatus::Aborted, large.clone(), now));
        assert!(goals.subscribe_result(id(1)).is_some(), "the last one is kept");
        assert!(goals.end(id(2), ActionGoalStatus::Aborted, large, now));
        assert!(goals.subscribe_result(id(1)).is_none());
        assert!(end(&mut goals, 3, now));
        assert!(goals.subscribe_result(id(2)).is_none());
        assert_eq!(goals.kept_bytes, b"result".len());
        for number in 0..2 * MAX_KEPT {
            let mut bytes = [7; 16];
            bytes[..8].copy_from_slice(&number.to_le_bytes());
            goals.begin(GoalId(bytes), time_at(1)).unwrap();
            assert!(goals.end(GoalId(bytes), ActionGoalStatus::Succeeded, Bytes::new(), now));
        }
        assert_eq!(goals.known.len(), MAX_KEPT);
    }

    #[test]
    fn goals_under_way_are_bounded_and_unlike() {
        let mut goals = executing_goals(1);
        assert!(goals.begin(id(1), time_at(1)).is_err(), "it is there");
        for number in 1..MAX_GOALS {
            let mut bytes = [7; 16];
            bytes[..8].copy_from_slice(&number.to_le_bytes());
            goals.begin(GoalId(bytes), time_at(1)).unwrap();
        }
        assert!(goals.begin(id(2), time_at(1)).is_err());
        assert!(end(&mut goals, 1, Instant::now()));
        goals.begin(id(2), time_at(1)).unwrap();
        assert!(goals.is_under_way(id(2)));
        assert!(goals.remove_rejected(id(2)));
        assert!(!goals.is_under_way(id(2)));
        goals.close();
        assert!(goals.begin(id(2), time_at(1)).is_err());
    }

    #[test]
    fn a_goal_may_end_before_it_is_taken() {
        let mut goals = goals();
        goals.begin(id(1), time_at(1)).unwrap();
        assert_eq!(status_list(&goals), []);
        assert!(end(&mut goals, 1, Instant::now()));
        goals.set_executing(id(1));
        assert!(!goals.remove_rejected(id(1)));
        assert_eq!(status_list(&goals), [(1, ActionGoalStatus::Succeeded)]);
    }

    #[test]
    fn a_goal_may_wait_before_it_is_carried_out() {
        let mut goals = executing_goals(1);
        goals.begin(id(2), time_at(2)).unwrap();
        goals.set_accepted(id(2));
        goals.set_accepted(id(1));
        let statuses = [(1, ActionGoalStatus::Executing), (2, ActionGoalStatus::Accepted)];
        assert_eq!(status_list(&goals), statuses);
        assert!(!goals.remove_rejected(id(2)), "its sender was told otherwise");
        goals.set_executing(id(2));
        assert_eq!(status_list(&goals), [(1, ActionGoalStatus::Executing), (2, ActionGoalStatus::Executing)]);
    }

    #[test]
    fn results_that_are_kept_count_in_a_budget() {
        let now = Instant::now();
        let budget = Budget::new("the robot", 250);
        let mut goals = GoalTable::new(budget.clone());
        let result = || Bytes::from(vec![0; 100]);
        for number in 1..=3 {
            goals.begin(id(number), time_at(1)).unwrap();
            assert!(goals.end(id(number), ActionGoalStatus::Succeeded, result(), now));
        }
        assert!(goals.subscribe_result(id(1)).is_none(), "there was no room");
        assert!(goals.subscribe_result(id(2)).is_some() && goals.subscribe_result(id(3)).is_some());
        assert_eq!(budget.used_bytes(), 200);
        // The last one is kept all the same.
        goals.begin(id(4), time_at(1)).unwrap();
        let large = Bytes::from(vec![0; 300]);
        assert!(goals.end(id(4), ActionGoalStatus::Succeeded, large, now));
        assert!(goals.subscribe_result(id(3)).is_none() && goals.subscribe_result(id(4)).is_some());
        assert_eq!(budget.used_bytes(), 0);
    }
}
