//! ROS 1 actions of a group: five topics (<http://wiki.ros.org/actionlib/DetailedDescription>). A robot sees only its
//! own goals; to it the group looks like one action server.
//!
//! ```text
//!  /goal, /cancel ──▶ GroupClient ─▶ the group
//!  /feedback, /result, /status ◀── updates about this robot's goals
//! ```

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::Duration;

use budget::{Budget, Exceeded, Permit};
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    ActionClient, BusError, GoalEnd, GoalError, GoalEvents, GoalOutcome, MatchedPeers, MessageSender, PeerId,
    Publisher, QosProfile, RosVersion, SerializedMessage, Subscription, TopicPeer, WireType, message_queue,
};
use ros::codec::Time;
use ros::ros1::actions::messages::{self, ActionlibStatus, GoalId, GoalState};
use ros::schema::{ActionDef, Registry};
use tokio::sync::watch;
use tokio::time::Instant;

use super::ServantGroup;
use super::action_ends::{ActionEndpoint, action_endpoints};
use super::dispatch::RobotNumber;
use super::goals::GroupClient;

/// Interval at which the status is published, as by action servers; also published at each change.
const STATUS: Duration = Duration::from_millis(200);
/// Time for which the status contains an ended goal, as with action servers.
const REMEMBERED: Duration = Duration::from_secs(5);
/// Maximum number of pending goals of one robot; more are rejected. A node would hold them in its own memory, but here
/// it is the daemon's.
const GOALS: usize = 256;
/// Maximum number of ended goals that are remembered.
const ENDED: usize = 256;
/// Maximum length in bytes of a goal's id, which each status repeats.
const LONGEST_ID: usize = 1024;

/// One action of one robot.
pub(super) struct ActionTopics {
    name: String,
    of: Arc<ActionDef>,
    types: HashMap<ActionEndpoint, Arc<WireType>>,
    node: PeerId,
    client: GroupClient,
    state: Mutex<State>,
    /// Budget for pending goals.
    budget: Budget,
    matched: watch::Sender<MatchedPeers>,
    numbers: std::sync::atomic::AtomicU64,
}

/// A goal of the robot.
struct TopicGoal {
    state: GoalState,
    /// Memory permit while the goal is pending.
    permit: Option<Permit>,
    /// Time at which it ended.
    ended: Option<Instant>,
}

/// Reason for rejecting a goal without asking a node.
#[derive(Debug, thiserror::Error)]
enum GoalRejection {
    /// This number of goals has not ended.
    #[error("{0} goals of this robot are under way already; wait for some to end")]
    TooMany(usize),
    /// The goal does not fit into the robot's budget.
    #[error(transparent)]
    NoMemory(Exceeded),
}

#[derive(Default)]
struct State {
    goals: HashMap<String, TopicGoal>,
    listeners: Vec<(ActionEndpoint, MessageSender)>,
    /// The task that publishes the status is running.
    ticking: bool,
}

impl ActionTopics {
    pub(super) fn new(
        group: &Arc<ServantGroup>,
        robot: RobotNumber,
        (name, node): (&str, &str),
        of: &Arc<ActionDef>,
        registry: &Registry,
        budget: &Budget,
    ) -> Result<Arc<ActionTopics>, BusError> {
        let types = action_endpoints(RosVersion::One, name).into_iter();
        let types = types.map(|(end, topic)| {
            let type_name = end.type_name(&of.name);
            let found = registry.message(&type_name);
            let found = found.map_err(|error| BusError::Protocol { what: topic, reason: error.to_string() })?;
            Ok((end, Arc::new(WireType::from_message(&found))))
        });
        let node = PeerId::from(node);
        let peer = TopicPeer { id: node.clone(), connected: true, offer: None };
        Ok(Arc::new(ActionTopics {
            name: name.to_owned(),
            of: Arc::clone(of),
            types: types.collect::<Result<_, BusError>>()?,
            node,
            client: GroupClient::new(group, robot, name, of),
            state: Mutex::default(),
            budget: budget.clone(),
            matched: watch::Sender::new(MatchedPeers { peers: vec![peer], refused: Vec::new() }),
            numbers: Default::default(),
        }))
    }

    pub(super) fn wire_type(&self, end: ActionEndpoint) -> WireType {
        WireType::clone(&self.types[&end])
    }

    fn check_type(&self, end: ActionEndpoint, of: &WireType) -> Result<(), BusError> {
        let ours = &self.types[&end];
        if ours.is_compatible_with(of) {
            Ok(())
        } else {
            Err(BusError::TypeMismatch {
                what: format!("topic of action {}", self.name),
                theirs: of.to_string(),
                ours: ours.to_string(),
            })
        }
    }

    /// Subscribes to a topic with updates about this robot's goals.
    pub(super) fn subscribe(
        self: &Arc<Self>,
        end: ActionEndpoint,
        of: &WireType,
        qos: QosProfile,
    ) -> Result<Subscription, BusError> {
        self.check_type(end, of)?;
        let (sender, messages) = message_queue(qos.depth);
        let mut state = self.state.lock();
        state.listeners.push((end, sender));
        if end == ActionEndpoint::Status {
            self.publish_status(&mut state);
            if !std::mem::replace(&mut state.ticking, true) {
                tokio::spawn(publish_status_periodically(Arc::downgrade(self)));
            }
        }
        drop(state);
        Ok(Subscription {
            dropped: messages.drop_counter(),
            messages,
            matched: self.matched.subscribe(),
            // The action exists as long as somebody subscribes.
            guard: Box::new(Arc::clone(self)),
        })
    }

    /// Advertises a topic on which the robot's client sends or cancels goals.
    pub(super) fn advertise(
        self: &Arc<Self>,
        end: ActionEndpoint,
        of: &WireType,
    ) -> Result<Box<dyn Publisher>, BusError> {
        self.check_type(end, of)?;
        Ok(Box::new(ClientTopicPublisher { topics: Arc::clone(self), end }))
    }

    fn publish_to_listeners(&self, state: &mut State, end: ActionEndpoint, bytes: Bytes) {
        let message = SerializedMessage {
            bytes,
            wire_type: Arc::clone(&self.types[&end]),
            publisher: self.node.clone(),
            latching: false,
        };
        state.listeners.retain(|(_, listener)| !listener.is_closed());
        for (_, listener) in state.listeners.iter().filter(|(of, _)| *of == end) {
            listener.send(message.clone());
        }
    }

    fn publish_status(&self, state: &mut State) {
        let now = Instant::now();
        let old = |ended: Option<Instant>| ended.is_some_and(|at| now > at + REMEMBERED);
        state.goals.retain(|_, goal| !old(goal.ended));
        let goals = state.goals.values();
        let states: Vec<GoalState> = goals.map(|goal| goal.state.clone()).collect();
        let bytes = messages::write_states(Time::now(), states.iter());
        self.publish_to_listeners(state, ActionEndpoint::Status, bytes);
    }

    fn receive_goal(self: &Arc<Self>, bytes: &Bytes) {
        let Some((mut goal, body)) = messages::read_goal(bytes) else {
            tracing::debug!("a goal of {} cannot be read", self.name);
            return;
        };
        if goal.id.is_empty() {
            let number = self.numbers.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
            goal.id = format!("{}-{number}", self.name);
        }
        if goal.id.len() > LONGEST_ID {
            tracing::debug!("a goal of {} has an id of {} bytes", self.name, goal.id.len());
            return;
        }
        let id = goal.id.clone();
        {
            let mut state = self.state.lock();
            if state.goals.get(&id).is_some_and(|goal| goal.ended.is_none()) {
                tracing::debug!("a goal of {} has the id of another, {id}", self.name);
                return;
            }
            let room = state.check_capacity().and_then(|()| {
                let permit = self.budget.take(body.len());
                permit.map_err(GoalRejection::NoMemory)
            });
            let (permit, refused) = match room {
                Ok(permit) => (Some(permit), None),
                Err(rejection) => (None, Some(rejection.to_string())),
            };
            let known = TopicGoal {
                state: GoalState { goal, status: ActionlibStatus::Active, text: String::new() },
                permit,
                ended: None,
            };
            state.goals.insert(id.clone(), known);
            if let Some(text) = refused {
                let end = GoalEnd { outcome: GoalOutcome::Rejected, text, result: self.empty_result() };
                return self.record_end(&mut state, &id, end);
            }
            self.publish_status(&mut state);
        }
        let events = TopicsGoalEvents {
            // It receives the end of the goal even if nobody subscribes any more.
            topics: Arc::clone(self),
            id: id.clone(),
        };
        self.client.send_goal(&id, body, Arc::new(events));
    }

    /// Cancels all goals because the robot or its node is gone; they are not followed for long.
    pub(super) fn cancel_all(&self) {
        self.client.abandon();
    }

    fn cancel_matching(&self, GoalId { stamp, id }: &GoalId) {
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
        ids.iter().for_each(|id| self.client.cancel_goal(id));
    }

    fn finish_goal(&self, id: &str, end: Result<GoalEnd, GoalError>) {
        let end = end.unwrap_or_else(|error| GoalEnd {
            outcome: GoalOutcome::Aborted,
            text: error.to_string(),
            result: self.empty_result(),
        });
        self.record_end(&mut self.state.lock(), id, end);
    }

    /// Returns an all-zero result.
    fn empty_result(&self) -> Bytes {
        vec![0; self.of.result.min_size()].into()
    }

    fn record_end(&self, state: &mut State, id: &str, end: GoalEnd) {
        let Some(known) = state.goals.get_mut(id) else {
            return;
        };
        let goal = &mut known.state;
        goal.status = match end.outcome {
            GoalOutcome::Succeeded => ActionlibStatus::Succeeded,
            GoalOutcome::Canceled => ActionlibStatus::Preempted,
            GoalOutcome::Aborted => ActionlibStatus::Aborted,
            GoalOutcome::Rejected => ActionlibStatus::Rejected,
            GoalOutcome::Unknown => ActionlibStatus::Lost,
        };
        goal.text = end.text;
        let goal = goal.clone();
        known.ended = Some(Instant::now());
        known.permit = None;
        state.prune_ended();
        self.publish_status(state);
        let bytes = messages::write_state(Time::now(), &goal, &end.result);
        self.publish_to_listeners(state, ActionEndpoint::Result, bytes);
    }
}

impl State {
    /// Returns an error if there is no room for another goal.
    fn check_capacity(&self) -> Result<(), GoalRejection> {
        let goals = self.goals.values();
        let count = goals.filter(|goal| goal.ended.is_none()).count();
        if count < GOALS { Ok(()) } else { Err(GoalRejection::TooMany(count)) }
    }

    /// Forgets the oldest ended goals if there are too many.
    fn prune_ended(&mut self) {
        let ended = |goals: &HashMap<String, TopicGoal>| goals.values().filter(|goal| goal.ended.is_some()).count();
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

/// Publishes the status until nobody subscribes to it.
async fn publish_status_periodically(topics: Weak<ActionTopics>) {
    loop {
        tokio::time::sleep(STATUS).await;
        let Some(topics) = topics.upgrade() else {
            return;
        };
        let mut state = topics.state.lock();
        topics.publish_status(&mut state);
        if !state.listeners.iter().any(|(end, _)| *end == ActionEndpoint::Status) {
            state.ticking = false;
            return;
        }
    }
}

struct ClientTopicPublisher {
    topics: Arc<ActionTopics>,
    end: ActionEndpoint,
}

impl Publisher for ClientTopicPublisher {
    fn publish(&self, bytes: Bytes) {
        match self.end {
            ActionEndpoint::Goal => self.topics.receive_goal(&bytes),
            _ => {
                if let Some(which) = messages::read_cancel(&bytes) {
                    self.topics.cancel_matching(&which);
                }
            }
        }
    }

    fn matched_subscribers(&self) -> watch::Receiver<MatchedPeers> {
        self.topics.matched.subscribe()
    }
}

struct TopicsGoalEvents {
    topics: Arc<ActionTopics>,
    id: String,
}

impl GoalEvents for TopicsGoalEvents {
    fn on_feedback(&self, feedback: Bytes) {
        let mut state = self.topics.state.lock();
        let known = state.goals.get(&self.id);
        let Some(known) = known.filter(|goal| goal.ended.is_none()) else {
            return;
        };
        let bytes = messages::write_state(Time::now(), &known.state, &feedback);
        self.topics.publish_to_listeners(&mut state, ActionEndpoint::Feedback, bytes);
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        self.topics.finish_goal(&self.id, end);
    }
}

#[cfg(test)]
mod tests;
