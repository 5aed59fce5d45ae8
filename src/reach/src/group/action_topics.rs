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

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    ActionClient, BusError, GoalEnd, GoalEvents, Matched, Message, MessageSender, Outcome, Peer,
    PeerId, Publisher, Qos, Subscription, WireType, message_queue,
};
use ros::codec::Time;
use ros::ros1::actions::messages::{self, GoalId, GoalState, Status};
use ros::schema::{ActionDef, Registry};
use tokio::sync::watch;
use tokio::time::Instant;

use super::Group;
use super::dispatch::Robot;
use super::goals::GroupClient;

/// How often who listens is told how goals stand, as action servers do; also at each change.
const STATUS: Duration = Duration::from_millis(200);
/// How long the status names a goal that has ended, as action servers do.
const REMEMBERED: Duration = Duration::from_secs(5);

/// One of the five.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum End {
    Goal,
    Cancel,
    Feedback,
    Result,
    Status,
}

impl End {
    const ALL: [(End, &str); 5] = [
        (End::Goal, "/goal"),
        (End::Cancel, "/cancel"),
        (End::Feedback, "/feedback"),
        (End::Result, "/result"),
        (End::Status, "/status"),
    ];

    /// Whether clients publish it.
    pub(super) fn is_of_clients(self) -> bool {
        matches!(self, End::Goal | End::Cancel)
    }

    /// Its topic's type, of an action of this type.
    pub(super) fn type_name(self, action: &str) -> String {
        match self {
            End::Goal => format!("{action}ActionGoal"),
            End::Feedback => format!("{action}ActionFeedback"),
            End::Result => format!("{action}ActionResult"),
            End::Cancel => "actionlib_msgs/GoalID".to_owned(),
            End::Status => "actionlib_msgs/GoalStatusArray".to_owned(),
        }
    }
}

/// The topics of an action.
pub(super) fn topics_of(action: &str) -> impl Iterator<Item = (End, String)> + '_ {
    End::ALL
        .into_iter()
        .map(move |(end, suffix)| (end, format!("{action}{suffix}")))
}

/// One action of one robot.
pub(super) struct ActionTopics {
    name: String,
    of: Arc<ActionDef>,
    types: HashMap<End, Arc<WireType>>,
    node: PeerId,
    client: GroupClient,
    state: Mutex<State>,
    matched: watch::Sender<Matched>,
    numbers: std::sync::atomic::AtomicU64,
}

#[derive(Default)]
struct State {
    goals: HashMap<String, (GoalState, Option<Instant>)>,
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
    ) -> Result<Arc<ActionTopics>, BusError> {
        let types = End::ALL.into_iter().map(|(end, suffix)| {
            let type_name = end.type_name(&of.name);
            let found = registry.message(&type_name);
            let found = found.map_err(|error| BusError::Protocol {
                what: format!("{name}{suffix}"),
                reason: error.to_string(),
            })?;
            Ok((end, Arc::new(WireType::of(&found))))
        });
        let node = PeerId::from(node);
        let peer = Peer {
            id: node.clone(),
            connected: true,
        };
        Ok(Arc::new(ActionTopics {
            name: name.to_owned(),
            of: Arc::clone(of),
            types: types.collect::<Result<_, BusError>>()?,
            node,
            client: GroupClient::new(group, robot, name, of),
            state: Mutex::default(),
            matched: watch::Sender::new(Matched { peers: vec![peer] }),
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
        state.goals.retain(|_, (_, ended)| !old(*ended));
        let states: Vec<GoalState> = state
            .goals
            .values()
            .map(|(state, _)| state.clone())
            .collect();
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
        let id = goal.id.clone();
        {
            let mut state = self.state.lock();
            let known = GoalState {
                goal,
                status: Status::Active,
                text: String::new(),
            };
            if state
                .goals
                .get(&id)
                .is_some_and(|(_, ended)| ended.is_none())
            {
                tracing::debug!("a goal of {} has the id of another, {id}", self.name);
                return;
            }
            state.goals.insert(id.clone(), (known, None));
            self.tell_status(&mut state);
        }
        let events = Ear {
            // It hears of its end even when nobody listens any more.
            topics: Arc::clone(self),
            id: id.clone(),
        };
        self.client.send(&id, body, Arc::new(events));
    }

    fn cancel(&self, bytes: &Bytes) {
        let Some(GoalId { stamp, id }) = messages::read_cancel(bytes) else {
            return;
        };
        let named = |of: &GoalId| of.id == id;
        let before = |of: &GoalId| {
            let at = |time: Time| (time.secs, time.nsecs);
            stamp != Time::default() && at(of.stamp) <= at(stamp)
        };
        let all = id.is_empty() && stamp == Time::default();
        let state = self.state.lock();
        let goals = state.goals.values();
        let goals = goals.filter(|(goal, ended)| {
            ended.is_none() && (all || named(&goal.goal) || before(&goal.goal))
        });
        let ids: Vec<String> = goals.map(|(goal, _)| goal.goal.id.clone()).collect();
        drop(state);
        ids.iter().for_each(|id| self.client.cancel(id));
    }

    fn ended(&self, id: &str, end: Result<GoalEnd, String>) {
        let end = end.unwrap_or_else(|text| GoalEnd {
            outcome: Outcome::Aborted,
            text,
            result: vec![0; self.of.result.min_size()].into(),
        });
        let mut state = self.state.lock();
        let Some((goal, ended)) = state.goals.get_mut(id) else {
            return;
        };
        goal.status = match end.outcome {
            Outcome::Succeeded => Status::Succeeded,
            Outcome::Canceled => Status::Preempted,
            Outcome::Aborted => Status::Aborted,
            Outcome::Rejected => Status::Rejected,
            Outcome::Unknown => Status::Lost,
        };
        goal.text = end.text;
        *ended = Some(Instant::now());
        let goal = goal.clone();
        self.tell_status(&mut state);
        let bytes = messages::write_state(Time::now(), &goal, &end.result);
        self.tell(&mut state, End::Result, bytes);
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
            _ => self.topics.cancel(&bytes),
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
        let Some((goal, None)) = state.goals.get(&self.id).cloned() else {
            return;
        };
        let bytes = messages::write_state(Time::now(), &goal, &feedback);
        self.topics.tell(&mut state, End::Feedback, bytes);
    }

    fn ended(&self, end: Result<GoalEnd, String>) {
        self.topics.ended(&self.id, end);
    }
}
