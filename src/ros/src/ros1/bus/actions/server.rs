//! An action that this side serves, on actionlib's topics.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::Mutex;
use tokio::task::AbortHandle;

use crate::bus::{
    ActionHandler, ActionServer, BusError, GoalEnd, Outcome, Publisher, Subscription,
};
use crate::codec::Time;
use crate::ros1::actions::messages::{self, GoalId, GoalState, Status};
use crate::ros1::bus::Inner;
use crate::schema::ActionDef;

/// actionlib's rate.
const STATUS_PERIOD: Duration = Duration::from_millis(200);
/// How long an ended goal stays in the status list.
const STATUS_KEPT: Duration = Duration::from_secs(5);
/// Goals that a server may have on its hands.
const MAX_GOALS: usize = 1000;

/// One action.
pub(in crate::ros1) struct Server {
    shared: Arc<Shared>,
    task: AbortHandle,
}

struct Shared {
    bus: Arc<Inner>,
    name: String,
    of: Arc<ActionDef>,
    handler: Arc<dyn ActionHandler>,
    ends: OnceLock<Ends>,
    goals: Mutex<HashMap<String, Served>>,
    /// Goals up to this stamp were cancelled, those that come after their cancel included.
    cancelled_up_to: Mutex<Time>,
}

/// What this side publishes.
struct Ends {
    status: Box<dyn Publisher>,
    feedback: Box<dyn Publisher>,
    result: Box<dyn Publisher>,
}

/// What others publish.
struct Heard {
    goal: Subscription,
    cancel: Subscription,
}

struct Served {
    state: GoalState,
    ended: Option<Instant>,
}

impl Served {
    fn is(&self, status: Status) -> bool {
        self.ended.is_none() && self.state.status == status
    }
}

impl Server {
    /// Opens the action's topics in the background.
    pub(in crate::ros1) fn open(
        bus: &Arc<Inner>,
        name: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Self {
        let shared = Arc::new(Shared {
            bus: bus.clone(),
            name: name.to_owned(),
            of: of.clone(),
            handler,
            ends: OnceLock::new(),
            goals: Mutex::default(),
            cancelled_up_to: Mutex::default(),
        });
        let serving = shared.clone();
        let task = bus.spawn(async move {
            match serving.open().await {
                Ok(heard) => serving.serve(heard).await,
                Err(error) => serving.handler.failed(&error.to_string()),
            }
        });
        Self { shared, task }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.task.abort();
        let under_way: Vec<String> = {
            let goals = self.shared.goals.lock();
            let under_way = goals.iter().filter(|(_, served)| served.ended.is_none());
            under_way.map(|(id, _)| id.clone()).collect()
        };
        for id in under_way {
            let end = GoalEnd {
                outcome: Outcome::Aborted,
                text: "its server is gone".to_owned(),
                result: self.shared.nothing(),
            };
            self.shared.end(&id, end);
        }
    }
}

impl ActionServer for Server {
    fn feedback(&self, id: &str, feedback: Bytes) -> bool {
        let goals = self.shared.goals.lock();
        let served = goals.get(id).filter(|served| served.ended.is_none());
        let Some(state) = served.map(|served| served.state.clone()) else {
            return false;
        };
        drop(goals);
        if let Some(ends) = self.shared.ends.get() {
            let message = messages::write_state(Time::now(), &state, &feedback);
            ends.feedback.publish(message);
        }
        true
    }

    fn end(&self, id: &str, end: GoalEnd) -> bool {
        self.shared.end(id, end)
    }
}

impl Shared {
    /// Publishers first: a goal may be answered as soon as it can come.
    async fn open(&self) -> Result<Heard, BusError> {
        let topics = super::Topics::of(&self.bus, &self.name, &self.of)?;
        let ends = Ends {
            status: topics.advertise("status", true).await?,
            feedback: topics.advertise("feedback", false).await?,
            result: topics.advertise("result", false).await?,
        };
        // Set once, here.
        let _ = self.ends.set(ends);
        Ok(Heard {
            goal: topics.subscribe("goal").await?,
            cancel: topics.subscribe("cancel").await?,
        })
    }

    async fn serve(&self, mut heard: Heard) {
        let mut period = tokio::time::interval(STATUS_PERIOD);
        loop {
            tokio::select! {
                Some(message) = heard.goal.messages.recv() => self.goal(&message.bytes),
                Some(message) = heard.cancel.messages.recv() => self.cancel(&message.bytes),
                _ = period.tick() => self.publish_status(),
            }
        }
    }

    /// A result of defaults.
    fn nothing(&self) -> Bytes {
        vec![0; self.of.result.min_size()].into()
    }

    fn goal(&self, bytes: &Bytes) {
        let Some((mut goal, body)) = messages::read_goal(bytes) else {
            return;
        };
        if goal.id.is_empty() {
            goal.id = format!("{}-{}", self.name, self.bus.id());
        }
        let id = goal.id.clone();
        let mut state = GoalState {
            goal,
            status: Status::Active,
            text: String::new(),
        };
        {
            let cancelled_up_to = *self.cancelled_up_to.lock();
            let mut goals = self.goals.lock();
            let stamp = state.goal.stamp;
            let recalled = match goals.get(&id) {
                Some(known) if known.state.status == Status::Recalling => true,
                Some(_) => return,
                None => stamp != Time::default() && stamp <= cancelled_up_to,
            };
            let mut ended = None;
            if recalled {
                // Its cancel came first: the handler need not hear of it.
                state.status = Status::Recalled;
                state.text = "the goal was cancelled before it came".to_owned();
                ended = Some(Instant::now());
            } else if goals.len() >= MAX_GOALS {
                state.status = Status::Rejected;
                state.text = format!("{MAX_GOALS} goals wait for this server already");
                ended = Some(Instant::now());
            }
            let state = state.clone();
            goals.insert(id.clone(), Served { state, ended });
        }
        if state.status == Status::Active {
            if let Err(reason) = self.handler.goal(&id, body) {
                state.status = Status::Rejected;
                state.text = reason;
                let ended = Some(Instant::now());
                let state = state.clone();
                self.goals.lock().insert(id, Served { state, ended });
            }
        }
        self.publish_status();
        if state.status.is_terminal() {
            self.publish_result(&state, &self.nothing());
        }
    }

    /// actionlib's policy: an empty id means all goals up to the stamp, a zero stamp with it means all. A cancel may be
    /// faster than its goal, which comes on another topic: it is kept.
    fn cancel(&self, bytes: &[u8]) {
        let Some(wanted) = messages::read_cancel(bytes) else {
            return;
        };
        let zero = wanted.stamp == Time::default();
        let matches = |goal: &GoalId| {
            goal.id == wanted.id
                || (wanted.id.is_empty() && zero)
                || (!zero && goal.stamp <= wanted.stamp)
        };
        {
            let mut up_to = self.cancelled_up_to.lock();
            *up_to = wanted.stamp.max(*up_to);
        }
        let mut cancelled = Vec::new();
        let mut goals = self.goals.lock();
        if !wanted.id.is_empty() && !goals.contains_key(&wanted.id) && goals.len() < MAX_GOALS {
            let state = GoalState {
                goal: wanted.clone(),
                status: Status::Recalling,
                text: String::new(),
            };
            let ended = Some(Instant::now());
            goals.insert(wanted.id.clone(), Served { state, ended });
        }
        for (id, served) in goals.iter_mut() {
            if served.is(Status::Active) && matches(&served.state.goal) {
                served.state.status = Status::Preempting;
                cancelled.push(id.clone());
            }
        }
        drop(goals);
        self.publish_status();
        for id in cancelled {
            self.handler.cancel(&id);
        }
    }

    fn end(&self, id: &str, end: GoalEnd) -> bool {
        let mut goals = self.goals.lock();
        let served = goals.get_mut(id).filter(|served| served.ended.is_none());
        let Some(served) = served else {
            return false;
        };
        served.state.status = match end.outcome {
            Outcome::Succeeded => Status::Succeeded,
            Outcome::Canceled => Status::Preempted,
            Outcome::Rejected => Status::Rejected,
            Outcome::Aborted | Outcome::Unknown => Status::Aborted,
        };
        served.state.text = end.text;
        served.ended = Some(Instant::now());
        let state = served.state.clone();
        drop(goals);
        self.publish_result(&state, &end.result);
        self.publish_status();
        true
    }

    fn publish_result(&self, state: &GoalState, body: &[u8]) {
        if let Some(ends) = self.ends.get() {
            let message = messages::write_state(Time::now(), state, body);
            ends.result.publish(message);
        }
    }

    fn publish_status(&self) {
        let mut goals = self.goals.lock();
        goals.retain(|_, served| {
            served
                .ended
                .is_none_or(|ended| ended.elapsed() < STATUS_KEPT)
        });
        let states: Vec<_> = goals.values().map(|served| served.state.clone()).collect();
        drop(goals);
        if let Some(ends) = self.ends.get() {
            let message = messages::write_states(Time::now(), states.iter());
            ends.status.publish(message);
        }
    }
}
