//! The goals of an action that this side serves, and the results of those that have ended, for who asks late.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use budget::{Budget, Permit};
use bytes::Bytes;
use tokio::sync::watch;

use crate::codec::Time;
use crate::ros2::actions::GoalId;
use crate::ros2::actions::messages::{CancelCode, GoalInfo, Status};

/// Goals that a server may have on its hands.
pub(super) const MAX_GOALS: usize = 1000;
/// How long a result is kept.
const KEPT: Duration = Duration::from_secs(60);
/// Results that are kept, and the bytes of all of them; the last one is kept whatever its size.
const MAX_KEPT: usize = 256;
const MAX_KEPT_BYTES: usize = 64 << 20;

/// The answer to who asks for the result of a goal, once it has ended.
pub(super) type Answer = watch::Receiver<Option<Bytes>>;

pub(super) struct Goals {
    known: HashMap<GoalId, Known>,
    /// Those that have ended, the first to be forgotten first, and when.
    ended: VecDeque<(Instant, GoalId)>,
    kept_bytes: usize,
    /// Counts results that are kept.
    budget: Budget,
    begun: u64,
    closed: bool,
}

struct Known {
    /// Counts goals, so that they are told of in order.
    number: u64,
    accepted: Time,
    /// Unknown until it was taken.
    status: Status,
    /// Somebody has asked for its result.
    asked: bool,
    answer: watch::Sender<Option<Bytes>>,
    /// For its result.
    permit: Option<Permit>,
}

impl Goals {
    pub(super) fn new(budget: Budget) -> Self {
        Self {
            known: HashMap::new(),
            ended: VecDeque::new(),
            kept_bytes: 0,
            budget,
            begun: 0,
            closed: false,
        }
    }

    /// Makes room for a goal, or says why there is none.
    pub(super) fn begin(&mut self, id: GoalId, accepted: Time) -> Result<(), String> {
        if self.closed {
            return Err("its server is gone".to_owned());
        }
        if self.known.contains_key(&id) {
            return Err("there is a goal of this id already".to_owned());
        }
        if self.known.len() - self.ended.len() >= MAX_GOALS {
            return Err(format!("{MAX_GOALS} goals wait for this server already"));
        }
        self.begun += 1;
        let known = Known {
            number: self.begun,
            accepted,
            status: Status::Unknown,
            asked: false,
            answer: watch::Sender::new(None),
            permit: None,
        };
        self.known.insert(id, known);
        Ok(())
    }

    /// It will be carried out.
    pub(super) fn accepted(&mut self, id: GoalId) {
        if let Some(known) = self.pending(id) {
            known.status = Status::Accepted;
        }
    }

    /// It is carried out now. It may have ended already.
    pub(super) fn taken(&mut self, id: GoalId) {
        let known = self.known.get_mut(&id);
        let waits = |known: &&mut Known| matches!(known.status, Status::Unknown | Status::Accepted);
        if let Some(known) = known.filter(waits) {
            known.status = Status::Executing;
        }
    }

    /// It is not carried out; false where it was accepted, or has ended.
    pub(super) fn refused(&mut self, id: GoalId) -> bool {
        let pending = self.pending(id).is_some();
        if pending {
            self.known.remove(&id);
        }
        pending
    }

    fn pending(&mut self, id: GoalId) -> Option<&mut Known> {
        let known = self.known.get_mut(&id);
        known.filter(|known| known.status == Status::Unknown)
    }

    pub(super) fn is_under_way(&self, id: GoalId) -> bool {
        let known = self.known.get(&id);
        known.is_some_and(|known| !known.status.is_terminal())
    }

    pub(super) fn under_way(&self) -> Vec<GoalId> {
        let ids = self.known.keys().copied();
        ids.filter(|id| self.is_under_way(*id)).collect()
    }

    /// Ends a goal; false where there is none of this id under way.
    pub(super) fn end(&mut self, id: GoalId, status: Status, answer: Bytes, now: Instant) -> bool {
        if !self.is_under_way(id) {
            return false;
        }
        let size = answer.len();
        self.kept_bytes += size;
        while self.ended.len() >= MAX_KEPT
            || (self.kept_bytes > MAX_KEPT_BYTES && !self.ended.is_empty())
        {
            self.forget_first();
        }
        let mut permit = self.budget.take(size);
        while permit.is_err() && !self.ended.is_empty() {
            self.forget_first();
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

    /// What answers who asks for the result of a goal; none where there is no such goal.
    pub(super) fn answer(&mut self, id: GoalId) -> Option<Answer> {
        let known = self.known.get_mut(&id)?;
        known.asked = true;
        Some(known.answer.subscribe())
    }

    /// Whether somebody has asked for the result of each goal.
    pub(super) fn are_asked_for(&self) -> bool {
        self.known.values().all(|known| known.asked)
    }

    /// Whom a request to cancel concerns, the first one first, and whether each was asked to end before. By the policy that
    /// `action_msgs/srv/CancelGoal` states: without an id all goals up to the stamp, and without a stamp either all; with
    /// an id that one, and with a stamp also all up to it.
    pub(super) fn concerned(&self, wanted: GoalInfo) -> Vec<(GoalInfo, bool)> {
        let zero = wanted.stamp == Time::default();
        let all = wanted.id == GoalId::NONE && zero;
        let mut concerned: Vec<(u64, GoalInfo, bool)> = Vec::new();
        for (id, known) in &self.known {
            let stamped = !zero && known.accepted <= wanted.stamp;
            let before = match known.status {
                Status::Canceling => true,
                Status::Accepted | Status::Executing => false,
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

    /// What is answered to a request to cancel that concerns none.
    pub(super) fn otherwise(&self, wanted: GoalInfo) -> CancelCode {
        match self.known.get(&wanted.id) {
            Some(known) if known.status.is_terminal() => CancelCode::Terminated,
            _ if wanted.id == GoalId::NONE => CancelCode::Rejected,
            _ => CancelCode::UnknownGoal,
        }
    }

    /// It ends because it was asked to; false where it has ended, or was asked before.
    pub(super) fn canceling(&mut self, id: GoalId) -> bool {
        let known = self.known.get_mut(&id);
        let goes_on =
            |known: &&mut Known| matches!(known.status, Status::Accepted | Status::Executing);
        let known = known.filter(goes_on);
        known
            .map(|known| known.status = Status::Canceling)
            .is_some()
    }

    /// How all that were taken stand, the first one first.
    pub(super) fn statuses(&self) -> Vec<(GoalInfo, Status)> {
        let taken = self.known.iter();
        let taken = taken.filter(|(_, known)| known.status != Status::Unknown);
        let mut taken: Vec<_> = taken.collect();
        taken.sort_by_key(|(_, known)| known.number);
        let state = |(id, known): (&GoalId, &Known)| (known.info(*id), known.status);
        taken.into_iter().map(state).collect()
    }

    /// Forgets results that were kept long enough; whether there were any.
    pub(super) fn expire(&mut self, now: Instant) -> bool {
        let before = self.ended.len();
        while self.ended.front().is_some_and(|(until, _)| *until <= now) {
            self.forget_first();
        }
        self.ended.len() < before
    }

    /// When the next result is forgotten.
    pub(super) fn next_expiry(&self) -> Option<Instant> {
        self.ended.front().map(|(until, _)| *until)
    }

    fn forget_first(&mut self) {
        let first = self.ended.pop_front();
        let known = first.and_then(|(_, id)| self.known.remove(&id));
        let answer = known.and_then(|known| known.answer.borrow().as_ref().map(Bytes::len));
        self.kept_bytes -= answer.unwrap_or(0);
    }

    /// No further goal is begun.
    pub(super) fn close(&mut self) {
        self.closed = true;
    }
}

impl Known {
    fn info(&self, id: GoalId) -> GoalInfo {
        GoalInfo {
            id,
            stamp: self.accepted,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(number: u8) -> GoalId {
        GoalId([number; 16])
    }

    fn at(secs: u32) -> Time {
        Time { secs, nsecs: 0 }
    }

    fn goals() -> Goals {
        Goals::new(Budget::unlimited())
    }

    /// Goals 1, 2, … accepted at second 1, 2, … and taken.
    fn taken(count: u8) -> Goals {
        let mut goals = goals();
        for number in 1..=count {
            goals.begin(id(number), at(number.into())).unwrap();
            goals.taken(id(number));
        }
        goals
    }

    fn end(goals: &mut Goals, number: u8, now: Instant) -> bool {
        goals.end(
            id(number),
            Status::Succeeded,
            Bytes::from_static(b"result"),
            now,
        )
    }

    fn told(goals: &Goals) -> Vec<(u8, Status)> {
        let statuses = goals.statuses().into_iter();
        statuses
            .map(|(info, status)| (info.id.0[0], status))
            .collect()
    }

    #[track_caller]
    fn cancels(wanted: (GoalId, Time), code: CancelCode, expected: &[u8]) {
        let mut goals = taken(4);
        end(&mut goals, 2, Instant::now());
        let (id, stamp) = wanted;
        let wanted = GoalInfo { id, stamp };
        let concerned = |goals: &Goals| -> Vec<(u8, bool)> {
            let concerned = goals.concerned(wanted).into_iter();
            concerned
                .map(|(info, before)| (info.id.0[0], before))
                .collect()
        };
        let all = |before| expected.iter().map(|number| (*number, before)).collect();
        let first: Vec<(u8, bool)> = all(false);
        assert_eq!(concerned(&goals), first);
        if first.is_empty() {
            assert_eq!(goals.otherwise(wanted), code);
        }
        for number in expected {
            assert!(goals.canceling(super::GoalId([*number; 16])));
            assert!(!goals.canceling(super::GoalId([*number; 16])), "again");
        }
        for (number, status) in told(&goals) {
            let canceling = status == Status::Canceling;
            assert_eq!(canceling, expected.contains(&number), "{number}");
        }
        let again: Vec<(u8, bool)> = all(true);
        assert_eq!(concerned(&goals), again);
    }

    #[test]
    fn a_cancel_names_one_goal_or_those_up_to_a_stamp_or_all() {
        let never = Time::default();
        cancels((id(3), never), CancelCode::None, &[3]);
        cancels((GoalId::NONE, never), CancelCode::None, &[1, 3, 4]);
        cancels((GoalId::NONE, at(3)), CancelCode::None, &[1, 3]);
        cancels((id(4), at(1)), CancelCode::None, &[1, 4]);
        cancels((id(9), never), CancelCode::UnknownGoal, &[]);
        cancels((id(2), never), CancelCode::Terminated, &[]);
        let early = Time { secs: 0, nsecs: 1 };
        cancels((GoalId::NONE, early), CancelCode::Rejected, &[]);
    }

    #[test]
    fn a_goal_ends_once_and_its_result_is_there_for_a_minute() {
        let (mut goals, now) = (taken(2), Instant::now());
        let early = goals.answer(id(1)).unwrap();
        assert_eq!(*early.borrow(), None);
        assert!(end(&mut goals, 1, now));
        assert!(!end(&mut goals, 1, now));
        assert_eq!(early.borrow().as_deref(), Some(&b"result"[..]));
        let late = goals.answer(id(1)).unwrap();
        assert_eq!(late.borrow().as_deref(), Some(&b"result"[..]));
        assert_eq!(
            told(&goals),
            [(1, Status::Succeeded), (2, Status::Executing)]
        );
        assert_eq!(goals.next_expiry(), Some(now + KEPT));
        assert!(!goals.expire(now));
        assert!(goals.expire(now + KEPT));
        assert!(goals.answer(id(1)).is_none());
        assert_eq!(
            (told(&goals), goals.next_expiry()),
            (vec![(2, Status::Executing)], None)
        );
        assert_eq!(goals.under_way(), [id(2)]);
    }

    #[test]
    fn results_that_are_kept_are_bounded() {
        let (mut goals, now) = (taken(3), Instant::now());
        let large = Bytes::from(vec![0; MAX_KEPT_BYTES]);
        assert!(goals.end(id(1), Status::Aborted, large.clone(), now));
        assert!(goals.answer(id(1)).is_some(), "the last one is kept");
        assert!(goals.end(id(2), Status::Aborted, large, now));
        assert!(goals.answer(id(1)).is_none());
        assert!(end(&mut goals, 3, now));
        assert!(goals.answer(id(2)).is_none());
        assert_eq!(goals.kept_bytes, b"result".len());
        for number in 0..2 * MAX_KEPT {
            let mut bytes = [7; 16];
            bytes[..8].copy_from_slice(&number.to_le_bytes());
            goals.begin(GoalId(bytes), at(1)).unwrap();
            assert!(goals.end(GoalId(bytes), Status::Succeeded, Bytes::new(), now));
        }
        assert_eq!(goals.known.len(), MAX_KEPT);
    }

    #[test]
    fn goals_under_way_are_bounded_and_unlike() {
        let mut goals = taken(1);
        assert!(goals.begin(id(1), at(1)).is_err(), "it is there");
        for number in 1..MAX_GOALS {
            let mut bytes = [7; 16];
            bytes[..8].copy_from_slice(&number.to_le_bytes());
            goals.begin(GoalId(bytes), at(1)).unwrap();
        }
        assert!(goals.begin(id(2), at(1)).is_err());
        assert!(end(&mut goals, 1, Instant::now()));
        goals.begin(id(2), at(1)).unwrap();
        assert!(goals.is_under_way(id(2)));
        assert!(goals.refused(id(2)));
        assert!(!goals.is_under_way(id(2)));
        goals.close();
        assert!(goals.begin(id(2), at(1)).is_err());
    }

    #[test]
    fn a_goal_may_end_before_it_is_taken() {
        let mut goals = goals();
        goals.begin(id(1), at(1)).unwrap();
        assert_eq!(told(&goals), []);
        assert!(end(&mut goals, 1, Instant::now()));
        goals.taken(id(1));
        assert!(!goals.refused(id(1)));
        assert_eq!(told(&goals), [(1, Status::Succeeded)]);
    }

    #[test]
    fn a_goal_may_wait_before_it_is_carried_out() {
        let mut goals = taken(1);
        goals.begin(id(2), at(2)).unwrap();
        goals.accepted(id(2));
        goals.accepted(id(1));
        let statuses = [(1, Status::Executing), (2, Status::Accepted)];
        assert_eq!(told(&goals), statuses);
        assert!(!goals.refused(id(2)), "its sender was told otherwise");
        goals.taken(id(2));
        assert_eq!(
            told(&goals),
            [(1, Status::Executing), (2, Status::Executing)]
        );
    }

    #[test]
    fn results_that_are_kept_count_in_a_budget() {
        let now = Instant::now();
        let budget = Budget::new("the robot", 250);
        let mut goals = Goals::new(budget.clone());
        let result = || Bytes::from(vec![0; 100]);
        for number in 1..=3 {
            goals.begin(id(number), at(1)).unwrap();
            assert!(goals.end(id(number), Status::Succeeded, result(), now));
        }
        assert!(goals.answer(id(1)).is_none(), "there was no room");
        assert!(goals.answer(id(2)).is_some() && goals.answer(id(3)).is_some());
        assert_eq!(budget.used(), 200);
        // The last one is kept all the same.
        goals.begin(id(4), at(1)).unwrap();
        let large = Bytes::from(vec![0; 300]);
        assert!(goals.end(id(4), Status::Succeeded, large, now));
        assert!(goals.answer(id(3)).is_none() && goals.answer(id(4)).is_some());
        assert_eq!(budget.used(), 0);
    }
}
