//! Actions as a ROS 1 client knows them: five topics (<http://wiki.ros.org/actionlib/DetailedDescription>). A robot hears of its
//! own goals alone; to it the group is one action server.
//!
//! ```text
//!  /goal, /cancel ──▶ GroupClient ─▶ the group
//!  /feedback, /result, /status ◀── what it says of this robot's goals
//! ```

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::Duration;

use budget::{Budget, Permit};
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    ActionClient, BusError, GoalEnd, GoalEvents, Matched, Message, MessageSender, Outcome, Peer,
    PeerId, Publisher, Qos, RosVersion, Subscription, WireType, message_queue,
};
use ros::codec::Time;
use ros::ros1::actions::messages::{self, GoalId, GoalState, Status};
use ros::schema::{ActionDef, Registry};
use tokio::sync::watch;
use tokio::time::Instant;

use super::Group;
use super::action_ends::{End, ends_of};
use super::dispatch::Robot;
use super::goals::GroupClient;

/// How often who listens is told how goals stand, as action servers do; also at each change.
const STATUS: Duration = Duration::from_millis(200);
/// How long the status names a goal that has ended, as action servers do.
const REMEMBERED: Duration = Duration::from_secs(5);
/// Goals of one robot that may be under way at once; one more is rejected. A node would hold them in its own memory: here it
/// is the daemon's.
const GOALS: usize = 256;
/// Goals that have ended and are remembered.
const ENDED: usize = 256;
/// Bytes of a goal's id, which each status repeats.
const LONGEST_ID: usize = 1024;

/// One action of one robot.
pub(super) struct ActionTopics {
    name: String,
    of: Arc<ActionDef>,
    types: HashMap<End, Arc<WireType>>,
    node: PeerId,
    client: GroupClient,
    state: Mutex<State>,
    /// Counts the goals under way.
    budget: Budget,
    matched: watch::Sender<Matched>,
    numbers: std::sync::atomic::AtomicU64,
}

/// A goal of the robot's.
struct Known {
    state: GoalState,
    /// For what is held of it while it is under way.
    permit: Option<Permit>,
    /// When it ended.
    ended: Option<Instant>,
}

#[derive(Default)]
struct State {
    goals: HashMap<String, Known>,
    listeners: Vec<(End, MessageSender)>,
    /// Somebody is told of the status again and again.
    ticking: bool,
}

impl ActionTopics {
    pub(super) fn new(
        group: &Arc<Group>,
        robot: Robot,
        (name, node): (&str, &str),
        of: &Arc<ActionDef>,
        registry: &Registry,
        budget: &Budget,
    ) -> Result<Arc<ActionTopics>, BusError> {
        let types = ends_of(RosVersion::One, name).into_iter();
        let types = types.map(|(end, topic)| {
            let type_name = end.type_name(&of.name);
            let found = registry.message(&type_name);
            let found = found.map_err(|error| BusError::Protocol {
                what: topic,
                reason: error.to_string(),
            })?;
            Ok((end, Arc::new(WireType::of(&found))))
        });
        let node = PeerId::from(node);
        let peer = Peer {
            id: node.clone(),
            connected: true,
            offer: None,
        };
        Ok(Arc::new(ActionTopics {
            name: name.to_owned(),
            of: Arc::clone(of),
            types: types.collect::<Result<_, BusError>>()?,
            node,
            client: GroupClient::new(group, robot, name, of),
            state: Mutex::default(),
            budget: budget.clone(),
            matched: watch::Sender::new(Matched {
                peers: vec![peer],
                refused: Vec::new(),
            }),
            numbers: Default::default(),
        }))
    }

    pub(super) fn wire_type(&self, end: End) -> WireType {
        WireType::clone(&self.types[&end])
    }

    fn agrees(&self, end: End, of: &WireType) -> Result<(), BusError> {
        let ours = &self.types[&end];
        match ours.agrees(of) {
            true => Ok(()),
            false => Err(BusError::TypeMismatch {
                what: format!("topic of action {}", self.name),
                theirs: of.to_string(),
                ours: ours.to_string(),
            }),
        }
    }

    /// Listens to what the group says of this robot's goals.
    pub(super) fn subscribe(
        self: &Arc<Self>,
        end: End,
        of: &WireType,
        qos: Qos,
    ) -> Result<Subscription, BusError> {
        self.agrees(end, of)?;
        let (sender, messages) = message_queue(qos.depth);
        let mut state = self.state.lock();
        state.listeners.push((end, sender));
        if end == End::Status {
            self.tell_status(&mut state);
            if !std::mem::replace(&mut state.ticking, true) {
                tokio::spawn(tick(Arc::downgrade(self)));
            }
        }
        drop(state);
        Ok(Subscription {
            dropped: messages.dropped(),
            messages,
            matched: self.matched.subscribe(),
            // The action goes on while somebody listens.
            guard: Box::new(Arc::clone(self)),
        })
    }

    /// A topic on which the robot's client sends goals, or cancels them.
    pub(super) fn advertise(
        self: &Arc<Self>,
        end: End,
        of: &WireType,
    ) -> Result<Box<dyn Publisher>, BusError> {
        self.agrees(end, of)?;
        Ok(Box::new(Mouth {
            topics: Arc::clone(self),
            end,
        }))
    }

    fn tell(&self, state: &mut State, end: End, bytes: Bytes) {
        let message = Message {
            bytes,
            wire_type: Arc::clone(&self.types[&end]),
            publisher: self.node.clone(),
            latching: false,
        };
        state
            .listeners
            .retain(|(_, listener)| !listener.is_closed());
        for (_, listener) in state.listeners.iter().filter(|(of, _)| *of == end) {
            listener.send(message.clone());
        }
    }

    fn tell_status(&self, state: &mut State) {
        let now = Instant::now();
        let old = |ended: Option<Instant>| ended.is_some_and(|at| now > at + REMEMBERED);
        state.goals.retain(|_, goal| !old(goal.ended));
        let goals = state.goals.values();
        let states: Vec<GoalState> = goals.map(|goal| goal.state.clone()).collect();
        let bytes = messages::write_states(Time::now(), states.iter());
        self.tell(state, End::Status, bytes);
    }

    fn goal(self: &Arc<Self>, bytes: &Bytes) {
        let Some((mut goal, body)) = messages::read_goal(bytes) else {
            tracing::debug!("a goal of {} cannot be read", self.name);
            return;
        };
        if goal.id.is_empty() {
            let number = self
                .numbers
                .fetch_add(1, std::sync::atomic::Ordering::Relaxed);
            goal.id = format!("{}-{number}", self.name);
        }
        if goal.id.len() > LONGEST_ID {
            tracing::debug!(
                "a goal of {} has an id of {} bytes",
                self.name,
                goal.id.len()
            );
            return;
        }
        let id = goal.id.clone();
        {
            let mut state = self.state.lock();
            if state
                .goals
                .get(&id)
                .is_some_and(|goal| goal.ended.is_none())
            {
                tracing::debug!("a goal of {} has the id of another, {id}", self.name);
                return;
            }
            let room = state.room().and_then(|()| {
                self.budget
                    .take(body.len())
                    .map_err(|full| full.to_string())
            });
            let (permit, refused) = match room {
                Ok(permit) => (Some(permit), None),
                Err(text) => (None, Some(text)),
            };
            let known = Known {
                state: GoalState {
                    goal,
                    status: Status::Active,
                    text: String::new(),
                },
                permit,
                ended: None,
            };
            state.goals.insert(id.clone(), known);
            if let Some(text) = refused {
                let end = GoalEnd {
                    outcome: Outcome::Rejected,
                    text,
                    result: self.nothing(),
                };
                return self.end(&mut state, &id, end);
            }
            self.tell_status(&mut state);
        }
        let events = Ear {
            // It hears of its end even when nobody listens any more.
            topics: Arc::clone(self),
            id: id.clone(),
        };
        self.client.send(&id, body, Arc::new(events));
    }

    /// The robot's node or the robot has gone: its goals are cancelled, and not followed for long.
    pub(super) fn cancel_all(&self) {
        self.client.leave();
    }

    fn cancel(&self, GoalId { stamp, id }: &GoalId) {
        let (stamp, id) = (*stamp, id.as_str());
        let named = |of: &GoalId| of.id == id;
        let before = |of: &GoalId| {
            let at = |time: Time| (time.secs, time.nsecs);
            stamp != Time::default() && at(of.stamp) <= at(stamp)
        };
        let all = id.is_empty() && stamp == Time::default();
        let state = self.state.lock();
        let goals = state.goals.values();
        let goals = goals.filter(|known| {
            let goal = &known.state.goal;
            known.ended.is_none() && (all || named(goal) || before(goal))
        });
        let ids: Vec<String> = goals.map(|goal| goal.state.goal.id.clone()).collect();
        drop(state);
        ids.iter().for_each(|id| self.client.cancel(id));
    }

    fn ended(&self, id: &str, end: Result<GoalEnd, String>) {
        let end = end.unwrap_or_else(|text| GoalEnd {
            outcome: Outcome::Aborted,
            text,
            result: self.nothing(),
        });
        self.end(&mut self.state.lock(), id, end);
    }

    /// A result that says nothing.
    fn nothing(&self) -> Bytes {
        vec![0; self.of.result.min_size()].into()
    }

    fn end(&self, state: &mut State, id: &str, end: GoalEnd) {
        let Some(known) = state.goals.get_mut(id) else {
            return;
        };
        let goal = &mut known.state;
        goal.status = match end.outcome {
            Outcome::Succeeded => Status::Succeeded,
            Outcome::Canceled => Status::Preempted,
            Outcome::Aborted => Status::Aborted,
            Outcome::Rejected => Status::Rejected,
            Outcome::Unknown => Status::Lost,
        };
        goal.text = end.text;
        let goal = goal.clone();
        known.ended = Some(Instant::now());
        known.permit = None;
        state.forget_some();
        self.tell_status(state);
        let bytes = messages::write_state(Time::now(), &goal, &end.result);
        self.tell(state, End::Result, bytes);
    }
}

impl State {
    /// Whether there is room for one more goal, or why not.
    fn room(&self) -> Result<(), String> {
        let goals = self.goals.values();
        let count = goals.filter(|goal| goal.ended.is_none()).count();
        match count < GOALS {
            true => Ok(()),
            false => Err(format!(
                "{count} goals of this robot are under way already; wait for some to end"
            )),
        }
    }

    /// Of too many goals that have ended, those that did first are forgotten.
    fn forget_some(&mut self) {
        let ended = |goals: &HashMap<String, Known>| {
            goals.values().filter(|goal| goal.ended.is_some()).count()
        };
        while ended(&self.goals) > ENDED {
            let over = self.goals.iter();
            let over = over.filter_map(|(id, goal)| Some((goal.ended?, id)));
            let Some(first) = over.min().map(|(_, id)| id.clone()) else {
                return;
            };
            self.goals.remove(&first);
        }
    }
}

/// Tells the status until nobody listens.
async fn tick(topics: Weak<ActionTopics>) {
    loop {
        tokio::time::sleep(STATUS).await;
        let Some(topics) = topics.upgrade() else {
            return;
        };
        let mut state = topics.state.lock();
        topics.tell_status(&mut state);
        if !state.listeners.iter().any(|(end, _)| *end == End::Status) {
            state.ticking = false;
            return;
        }
    }
}

struct Mouth {
    topics: Arc<ActionTopics>,
    end: End,
}

impl Publisher for Mouth {
    fn publish(&self, bytes: Bytes) {
        match self.end {
            End::Goal => self.topics.goal(&bytes),
            _ => {
                if let Some(which) = messages::read_cancel(&bytes) {
                    self.topics.cancel(&which);
                }
            }
        }
    }

    fn matched(&self) -> watch::Receiver<Matched> {
        self.topics.matched.subscribe()
    }
}

struct Ear {
    topics: Arc<ActionTopics>,
    id: String,
}

impl GoalEvents for Ear {
    fn feedback(&self, feedback: Bytes) {
        let mut state = self.topics.state.lock();
        let known = state.goals.get(&self.id);
        let Some(known) = known.filter(|goal| goal.ended.is_none()) else {
            return;
        };
        let bytes = messages::write_state(Time::now(), &known.state, &feedback);
        self.topics.tell(&mut state, End::Feedback, bytes);
    }

    fn ended(&self, end: Result<GoalEnd, String>) {
        self.topics.ended(&self.id, end);
    }
}

#[cfg(test)]
mod tests;
