//! Server of one action, on actionlib's topics.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::{ActionHandler, ActionServer, BusError, GoalEnd, GoalOutcome, Publisher, Subscription};
use ros_message::codec::Time;
use ros_message::schema::ActionDef;
use tokio::task::AbortHandle;

use crate::actions::messages::{self, ActionlibStatus, GoalId, GoalState};
use crate::bus::Ros1BusState;

/// Interval of status messages, as in actionlib.
const STATUS_PERIOD: Duration = Duration::from_millis(200);
/// Time for which an ended goal stays in the status list.
const STATUS_KEPT: Duration = Duration::from_secs(5);
/// Maximum number of goals of a server.
const MAX_GOALS: usize = 1000;

/// A server of one action.
pub(crate) struct Ros1ActionServer {
    shared: Arc<ActionlibServerState>,
    task: AbortHandle,
}

struct ActionlibServerState {
    bus: Arc<Ros1BusState>,
    name: String,
    of: Arc<ActionDef>,
    handler: Arc<dyn ActionHandler>,
    ends: OnceLock<ActionServerPublishers>,
    goals: Mutex<HashMap<String, ServedGoal>>,
    /// Goals up to this stamp are cancelled, including those that arrive after the cancel.
    cancelled_up_to: Mutex<Time>,
}

/// Publishers of the server.
struct ActionServerPublishers {
    status: Box<dyn Publisher>,
    feedback: Box<dyn Publisher>,
    result: Box<dyn Publisher>,
}

/// Subscriptions to what clients publish.
struct ActionServerSubscriptions {
    goal: Subscription,
    cancel: Subscription,
}

struct ServedGoal {
    state: GoalState,
    ended: Option<Instant>,
}

impl ServedGoal {
    fn has_status(&self, status: ActionlibStatus) -> bool {
        self.ended.is_none() && self.state.status == status
    }
}

impl Ros1ActionServer {
    /// Opens the action's topics in the background.
    pub(crate) fn open(
        bus: &Arc<Ros1BusState>,
        name: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Self {
        let shared = Arc::new(ActionlibServerState {
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
                Err(error) => serving.handler.on_failed(&error.to_string()),
            }
        });
        Self { shared, task }
    }
}

impl Drop for Ros1ActionServer {
    fn drop(&mut self) {
        self.task.abort();
        let under_way: Vec<String> = {
            let goals = self.shared.goals.lock();
            let under_way = goals.iter().filter(|(_, served)| served.ended.is_none());
            under_way.map(|(id, _)| id.clone()).collect()
        };
        for id in under_way {
            let end = GoalEnd {
                outcome: GoalOutcome::Aborted,
                text: "its server is gone".to_owned(),
                result: self.shared.default_result(),
            };
            self.shared.end_goal(&id, end);
        }
    }
}

impl ActionServer for Ros1ActionServer {
    fn publish_feedback(&self, id: &str, feedback: Bytes) -> bool {
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

    fn end_goal(&self, id: &str, end: GoalEnd) -> bool {
        self.shared.end_goal(id, end)
    }
}

impl ActionlibServerState {
    /// Advertises first: a goal may be answered as soon as it can arrive.
    async fn open(&self) -> Result<ActionServerSubscriptions, BusError> {
        let topics = super::ActionTopicSet::new(&self.bus, &self.name, &self.of)?;
        let ends = ActionServerPublishers {
            status: topics.advertise("status", true).await?,
            feedback: topics.advertise("feedback", false).await?,
            result: topics.advertise("result", false).await?,
        };
        // Set only here.
        let _ = self.ends.set(ends);
        Ok(ActionServerSubscriptions {
            goal: topics.subscribe("goal").await?,
            cancel: topics.subscribe("cancel").await?,
        })
    }

    async fn serve(&self, mut heard: ActionServerSubscriptions) {
        let mut period = tokio::time::interval(STATUS_PERIOD);
        loop {
            tokio::select! {
                Some(message) = heard.goal.messages.recv() => self.on_goal(&message.bytes),
                Some(message) = heard.cancel.messages.recv() => self.on_cancel(&message.bytes),
                _ = period.tick() => self.publish_status(),
            }
        }
    }

    /// Returns a result of default values.
    fn default_result(&self) -> Bytes {
        vec![0; self.of.result.min_size()].into()
    }

    fn on_goal(&self, bytes: &Bytes) {
        let Some((mut goal, body)) = messages::read_goal(bytes) else {
            return;
        };
        if goal.id.is_empty() {
            goal.id = format!("{}-{}", self.name, self.bus.next_id());
        }
        let id = goal.id.clone();
        let mut state = GoalState { goal, status: ActionlibStatus::Active, text: String::new() };
        {
            let cancelled_up_to = *self.cancelled_up_to.lock();
            let mut goals = self.goals.lock();
            let stamp = state.goal.stamp;
            let recalled = match goals.get(&id) {
                Some(known) if known.state.status == ActionlibStatus::Recalling => true,
                Some(_) => return,
                None => stamp != Time::default() && stamp <= cancelled_up_to,
            };
            let mut ended = None;
            if recalled {
                // The cancel arrived first: the handler need not know of the goal.
                state.status = ActionlibStatus::Recalled;
                state.text = "the goal was cancelled before it came".to_owned();
                ended = Some(Instant::now());
            } else if goals.len() >= MAX_GOALS {
                state.status = ActionlibStatus::Rejected;
                state.text = format!("{MAX_GOALS} goals wait for this server already");
                ended = Some(Instant::now());
            }
            let state = state.clone();
            goals.insert(id.clone(), ServedGoal { state, ended });
        }
        if state.status == ActionlibStatus::Active {
            if let Err(reason) = self.handler.on_goal(&id, body) {
                state.status = ActionlibStatus::Rejected;
                state.text = reason.into_string();
                let ended = Some(Instant::now());
                let state = state.clone();
                self.goals.lock().insert(id, ServedGoal { state, ended });
            }
        }
        self.publish_status();
        if state.status.is_terminal() {
            self.publish_result(&state, &self.default_result());
        }
    }

    /// Handles a cancel by actionlib's policy: an empty id means all goals up to the stamp, and with a zero stamp all
    /// goals. A cancel may overtake its goal, which arrives on another topic: then it is remembered.
    fn on_cancel(&self, bytes: &[u8]) {
        let Some(wanted) = messages::read_cancel(bytes) else {
            return;
        };
        let zero = wanted.stamp == Time::default();
        let matches = |goal: &GoalId| {
            goal.id == wanted.id || (wanted.id.is_empty() && zero) || (!zero && goal.stamp <= wanted.stamp)
        };
        {
            let mut up_to = self.cancelled_up_to.lock();
            *up_to = wanted.stamp.max(*up_to);
        }
        let mut cancelled = Vec::new();
        let mut goals = self.goals.lock();
        if !wanted.id.is_empty() && !goals.contains_key(&wanted.id) && goals.len() < MAX_GOALS {
            let state = GoalState { goal: wanted.clone(), status: ActionlibStatus::Recalling, text: String::new() };
            let ended = Some(Instant::now());
            goals.insert(wanted.id.clone(), ServedGoal { state, ended });
        }
        for (id, served) in goals.iter_mut() {
            if served.has_status(ActionlibStatus::Active) && matches(&served.state.goal) {
                served.state.status = ActionlibStatus::Preempting;
                cancelled.push(id.clone());
            }
        }
        drop(goals);
        self.publish_status();
        for id in cancelled {
            self.handler.on_cancel(&id);
        }
    }

    fn end_goal(&self, id: &str, end: GoalEnd) -> bool {
        let mut goals = self.goals.lock();
        let served = goals.get_mut(id).filter(|served| served.ended.is_none());
        let Some(served) = served else {
            return false;
        };
        served.state.status = match end.outcome {
            GoalOutcome::Succeeded => ActionlibStatus::Succeeded,
            GoalOutcome::Canceled => ActionlibStatus::Preempted,
            GoalOutcome::Rejected => ActionlibStatus::Rejected,
            GoalOutcome::Aborted | GoalOutcome::Unknown => ActionlibStatus::Aborted,
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
        goals.retain(|_, served| served.ended.is_none_or(|ended| ended.elapsed() < STATUS_KEPT));
        let states: Vec<_> = goals.values().map(|served| served.state.clone()).collect();
        drop(goals);
        if let Some(ends) = self.ends.get() {
            let message = messages::write_states(Time::now(), states.iter());
            ends.status.publish(message);
        }
    }
}
