//! What the parts of an action server are asked and what they answer, whatever carries it: DDS ([`super::Server`]), or whoever stands
//! for servers elsewhere and shows itself as one.
//!
//! ```text
//!  send_goal ──▶ begin ─▶ answer         get_result ──▶ result
//!  cancel_goal ─▶ wanted ─▶ canceled     feedback, end ─▶ Topics
//! ```

mod goals;

use std::sync::Arc;
use std::time::Instant;

use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::Notify;
use tokio::time::sleep_until;

use self::goals::Goals;
use super::GoalId;
use super::messages::{self, CancelCode, GoalInfo, Status};
use crate::bus::{GoalEnd, Outcome};
use crate::codec::{Time, default_message};
use crate::schema::ActionDef;

/// Where a server publishes. Must not block.
pub trait Topics: Send + Sync + 'static {
    /// Feedback of one goal.
    fn feedback(&self, message: Bytes);
    /// How all goals stand: the last one is for newcomers, too.
    fn status(&self, message: Bytes);
}

/// One action, and its goals.
pub struct GoalServer<T> {
    name: String,
    of: Arc<ActionDef>,
    topics: T,
    goals: Mutex<Goals>,
    /// Held while statuses are told, so that the last ones told are the last that there were.
    telling: Mutex<()>,
    /// A goal has ended.
    ended: Notify,
    /// Somebody has asked for a result.
    asked: Notify,
}

/// A goal that was sent and is not answered yet.
#[derive(Debug, Clone, Copy)]
pub struct Begun {
    id: GoalId,
    accepted: Time,
}

impl Begun {
    /// Its id, as this side shows it.
    pub fn id(&self) -> String {
        self.id.to_string()
    }
}

/// Goals that somebody wants to end.
#[derive(Debug)]
pub struct Wanted {
    /// With whether they have been asked to before.
    goals: Vec<(GoalInfo, bool)>,
    /// What is answered where none of them ends.
    otherwise: CancelCode,
}

impl Wanted {
    /// Those that have not been asked to before.
    pub fn newly(&self) -> impl Iterator<Item = String> + '_ {
        let newly = self.goals.iter().filter(|(_, before)| !before);
        newly.map(|(goal, _)| goal.id.to_string())
    }
}

/// What came of that.
#[derive(Debug)]
pub struct Canceled {
    /// What whoever wanted it is answered.
    pub answer: Bytes,
    /// Those that end since then.
    pub newly: Vec<String>,
}

impl<T: Topics> GoalServer<T> {
    /// Without goals. Results that are kept for who asks late count in `budget`.
    pub fn new(name: &str, of: &Arc<ActionDef>, topics: T, budget: Budget) -> Arc<Self> {
        let server = Arc::new(Self {
            name: name.to_owned(),
            of: of.clone(),
            topics,
            goals: Mutex::new(Goals::new(budget)),
            telling: Mutex::default(),
            ended: Notify::new(),
            asked: Notify::new(),
        });
        server.tell_statuses();
        server
    }

    /// The action's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Where it publishes.
    pub fn topics(&self) -> &T {
        &self.topics
    }

    /// A goal has come; with the goal itself, serialized. An error is why it is refused, and [`refusal`] what its sender is answered
    /// then.
    pub fn begin(&self, request: &[u8]) -> Result<(Begun, Bytes), String> {
        let id = messages::read_id(request).filter(|id| *id != GoalId::NONE);
        let Some((id, goal)) = id.zip(messages::behind_id(&self.of.goal, request)) else {
            return Err(format!(
                "it is no serialized {}",
                self.of.action_goal.name()
            ));
        };
        let accepted = Time::now();
        self.goals.lock().begin(id, accepted)?;
        Ok((Begun { id, accepted }, goal))
    }

    /// Whether the goal is carried out from now on; what its sender is answered.
    pub fn answer(&self, begun: &Begun, taken: bool) -> Bytes {
        match taken {
            true => self.carries_out(begun),
            false => drop(self.refuses(begun)),
        }
        messages::write_accepted(taken, begun.accepted)
    }

    /// The goal is accepted, and nobody has begun with it; what its sender is answered.
    pub fn waits(&self, begun: &Begun) -> Bytes {
        self.goals.lock().accepted(begun.id);
        self.tell_statuses();
        messages::write_accepted(true, begun.accepted)
    }

    /// The goal is carried out from now on.
    pub fn carries_out(&self, begun: &Begun) {
        self.goals.lock().taken(begun.id);
        self.tell_statuses();
    }

    /// The goal is not carried out; false where its sender has been answered that it is.
    pub fn refuses(&self, begun: &Begun) -> bool {
        self.goals.lock().refused(begun.id)
    }

    /// What whoever asks for a goal's result is answered, once it has ended.
    pub async fn result(&self, request: &[u8]) -> Bytes {
        let id = messages::read_id(request);
        let answer = id.and_then(|id| self.goals.lock().answer(id));
        self.asked.notify_one();
        if let Some(mut answer) = answer {
            // Without its sender the goal was refused meanwhile.
            if let Ok(ended) = answer.wait_for(Option::is_some).await {
                return ended.clone().unwrap_or_default();
            }
        }
        self.nothing(Status::Unknown)
    }

    /// Which goals are to be cancelled; none where the request cannot be read.
    pub fn wanted(&self, request: &[u8]) -> Option<Wanted> {
        let wanted = messages::read_cancel(request)?;
        let goals = self.goals.lock();
        Some(Wanted {
            goals: goals.concerned(wanted),
            otherwise: goals.otherwise(wanted),
        })
    }

    /// Those of them for which `ends` says so end now, beside those that were asked before.
    pub fn canceled(&self, wanted: &Wanted, ends: impl Fn(&str) -> bool) -> Canceled {
        let all = wanted.goals.iter();
        let ending = all.filter(|(goal, before)| *before || ends(&goal.id.to_string()));
        let ending: Vec<GoalInfo> = ending.map(|(goal, _)| *goal).collect();
        let newly: Vec<String> = {
            let mut goals = self.goals.lock();
            let newly = ending.iter().filter(|goal| goals.canceling(goal.id));
            newly.map(|goal| goal.id.to_string()).collect()
        };
        if !newly.is_empty() {
            self.tell_statuses();
        }
        let code = match (ending.is_empty(), wanted.goals.is_empty()) {
            (false, _) => CancelCode::None,
            (true, false) => CancelCode::Rejected,
            (true, true) => wanted.otherwise,
        };
        Canceled {
            answer: messages::write_cancelled(code, &ending),
            newly,
        }
    }

    /// Whether there is a goal of this id that has not ended.
    pub fn is_under_way(&self, id: &str) -> bool {
        let goals = self.goals.lock();
        GoalId::parse(id).is_some_and(|id| goals.is_under_way(id))
    }

    /// Tells how a goal gets on; false where there is none of this id under way.
    pub fn feedback(&self, id: &str, feedback: &[u8]) -> bool {
        let id = GoalId::parse(id).filter(|id| self.goals.lock().is_under_way(*id));
        let Some(id) = id else {
            return false;
        };
        match messages::with_id(id, &self.of.feedback, feedback) {
            Some(message) => self.topics.feedback(message),
            None => {
                let (action, expected) = (&self.name, self.of.feedback.name());
                tracing::debug!(action, expected, "feedback of another type is left out");
            }
        }
        true
    }

    /// Ends a goal; false where there is none of this id under way.
    pub fn end(&self, id: &str, end: &GoalEnd) -> bool {
        let id = GoalId::parse(id);
        let ended = id.is_some_and(|id| self.ends(id, end.outcome, &end.result));
        if ended {
            self.tell_statuses();
        }
        ended
    }

    /// False where there is no such goal under way. A goal cannot have succeeded without a result.
    fn ends(&self, id: GoalId, outcome: Outcome, result: &[u8]) -> bool {
        let of = &self.of.result;
        let mut status = match outcome {
            Outcome::Succeeded => Status::Succeeded,
            Outcome::Canceled => Status::Canceled,
            Outcome::Aborted | Outcome::Rejected | Outcome::Unknown => Status::Aborted,
        };
        let answer = messages::write_result(status, of, result).unwrap_or_else(|| {
            if status == Status::Succeeded {
                let (action, expected) = (&self.name, of.name());
                tracing::warn!(action, expected, "a result of another type aborts its goal");
                status = Status::Aborted;
            }
            self.nothing(status)
        });
        let ended = self.goals.lock().end(id, status, answer, Instant::now());
        self.ended.notify_one();
        ended
    }

    /// Aborts all goals, and takes no more.
    pub fn close(&self) {
        let under_way = {
            let mut goals = self.goals.lock();
            goals.close();
            goals.under_way()
        };
        for id in &under_way {
            self.ends(*id, Outcome::Aborted, &[]);
        }
        if !under_way.is_empty() {
            self.tell_statuses();
        }
    }

    /// Whether somebody has asked for each result.
    pub(super) fn are_asked_for(&self) -> bool {
        self.goals.lock().are_asked_for()
    }

    /// Returns once somebody has asked for each result.
    pub(super) async fn all_asked_for(&self) {
        while !self.are_asked_for() {
            self.asked.notified().await;
        }
    }

    /// Forgets results that nobody has asked for in time, as long as it is polled.
    pub async fn forget_in_time(&self) {
        loop {
            let next = self.goals.lock().next_expiry();
            match next {
                Some(next) => sleep_until(next.into()).await,
                None => self.ended.notified().await,
            }
            let forgot = self.goals.lock().expire(Instant::now());
            if forgot {
                self.tell_statuses();
            }
        }
    }

    /// A result of defaults.
    fn nothing(&self, status: Status) -> Bytes {
        let nothing = default_message(&self.of.result);
        messages::write_result(status, &self.of.result, &nothing).unwrap_or_default()
    }

    fn tell_statuses(&self) {
        let _telling = self.telling.lock();
        let statuses = self.goals.lock().statuses();
        self.topics.status(messages::write_statuses(&statuses));
    }
}

/// What the sender of a goal is answered that is not taken.
pub fn refusal() -> Bytes {
    messages::write_accepted(false, Time::now())
}

/// What is answered to a request to cancel that cannot be read.
pub fn not_canceled() -> Bytes {
    messages::write_cancelled(CancelCode::Rejected, &[])
}
