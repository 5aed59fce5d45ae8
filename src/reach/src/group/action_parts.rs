//! Actions as ROS 2 knows them: three services and two topics. To a robot the group is one action server, with its goals alone.
//!
//! ```text
//!  send_goal ──▶ GroupClient ─▶ the group      a node's yes or no is the answer
//!                     │                        while no servant is free: accepted, and not carried out yet
//!  cancel_goal ─▶ ────┘                        likewise
//!  get_result, feedback, status ◀── what it says of this robot's goals
//! ```

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use budget::{Budget, Permit};
use bytes::Bytes;
use futures_util::future::join_all;
use parking_lot::Mutex;
use ros::bus::{
    ActionClient, BusError, CallFate, Digest, GoalEnd, GoalEvents, Matched, Message, MessageSender,
    Outcome, Peer, PeerId, Qos, ServiceType, Subscription, WireType, message_queue,
};
use ros::ros2::actions::Parts;
use ros::ros2::actions::goal_server::{self, Begun, GoalServer, Topics};
use ros::schema::ActionDef;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::timeout;
use tokio_util::task::AbortOnDropHandle;

use super::Group;
use super::action_ends::End;
use super::dispatch::Robot;
use super::goals::{GroupClient, GroupEvents};

/// Something that a node's robot should know: the node as the robot knows it, and what.
pub(super) type Notices = mpsc::UnboundedSender<(String, String)>;

/// One action of one robot.
pub(super) struct ActionParts {
    parts: Parts,
    node: PeerId,
    client: GroupClient,
    goals: Arc<GoalServer<Published>>,
    /// Counts the goals under way.
    budget: Budget,
    /// Who waits to hear whether a goal ends.
    canceling: Mutex<HashMap<String, Vec<oneshot::Sender<bool>>>>,
    notices: Notices,
    matched: watch::Sender<Matched>,
    _forgetting: AbortOnDropHandle<()>,
}

/// What is said on the topics.
struct Published {
    node: PeerId,
    feedback: Arc<WireType>,
    status: Arc<WireType>,
    state: Mutex<Listeners>,
}

#[derive(Default)]
struct Listeners {
    all: Vec<(End, MessageSender)>,
    /// For newcomers.
    status: Option<Message>,
}

impl Published {
    fn message(&self, of: &Arc<WireType>, bytes: Bytes, latching: bool) -> Message {
        Message {
            bytes,
            wire_type: Arc::clone(of),
            publisher: self.node.clone(),
            latching,
        }
    }
}

impl Listeners {
    fn tell(&mut self, end: End, message: &Message) {
        self.all.retain(|(_, listener)| !listener.is_closed());
        for (_, listener) in self.all.iter().filter(|(of, _)| *of == end) {
            listener.send(message.clone());
        }
    }
}

impl Topics for Published {
    fn feedback(&self, message: Bytes) {
        let message = self.message(&self.feedback, message, false);
        self.state.lock().tell(End::Feedback, &message);
    }

    fn status(&self, message: Bytes) {
        let message = self.message(&self.status, message, true);
        let mut state = self.state.lock();
        state.tell(End::Status, &message);
        state.status = Some(message);
    }
}

impl ActionParts {
    pub(super) fn new(
        group: &Arc<Group>,
        robot: Robot,
        (name, node): (&str, &str),
        of: &Arc<ActionDef>,
        budget: &Budget,
        notices: &Notices,
    ) -> Result<Arc<ActionParts>, BusError> {
        let parts = Parts::of(name, of)?;
        let node = PeerId::from(node);
        let published = Published {
            node: node.clone(),
            feedback: Arc::new(parts.feedback.1.clone()),
            status: Arc::new(parts.status.1.clone()),
            state: Mutex::default(),
        };
        let goals = GoalServer::new(name, of, published, budget.clone());
        let forgets = Arc::clone(&goals);
        let forgetting = tokio::spawn(async move { forgets.forget_in_time().await });
        let peer = Peer {
            id: node.clone(),
            connected: true,
            offer: None,
        };
        Ok(Arc::new(ActionParts {
            parts,
            node,
            client: GroupClient::new(group, robot, name, of),
            goals,
            budget: budget.clone(),
            canceling: Mutex::default(),
            notices: notices.clone(),
            matched: watch::Sender::new(Matched {
                peers: vec![peer],
                refused: Vec::new(),
            }),
            _forgetting: AbortOnDropHandle::new(forgetting),
        }))
    }

    pub(super) fn wire_type(&self, end: End) -> &WireType {
        match end {
            End::Feedback => &self.parts.feedback.1,
            _ => &self.parts.status.1,
        }
    }

    pub(super) fn service_type(&self, end: End) -> &ServiceType {
        match end {
            End::SendGoal => &self.parts.send_goal.1,
            End::CancelGoal => &self.parts.cancel_goal.1,
            _ => &self.parts.get_result.1,
        }
    }

    /// Listens to what the group says of this robot's goals.
    pub(super) fn subscribe(
        self: &Arc<Self>,
        end: End,
        of: &WireType,
        qos: Qos,
    ) -> Result<Subscription, BusError> {
        let ours = self.wire_type(end);
        if !(of.digest.is_any() || ours.agrees(of)) {
            return Err(BusError::TypeMismatch {
                what: "topic of an action".to_owned(),
                theirs: of.to_string(),
                ours: ours.to_string(),
            });
        }
        let (sender, messages) = message_queue(qos.depth);
        let mut state = self.goals.topics().state.lock();
        if let Some(status) = state
            .status
            .as_ref()
            .filter(|_| end == End::Status && qos.is_latching())
        {
            sender.send(status.clone());
        }
        state.all.push((end, sender));
        drop(state);
        Ok(Subscription {
            dropped: messages.dropped(),
            messages,
            matched: self.matched.subscribe(),
            // The action goes on while somebody listens.
            guard: Box::new(Arc::clone(self)),
        })
    }

    /// Calls one of the services.
    pub(super) async fn call(
        self: &Arc<Self>,
        (end, name): (End, &str),
        digest: &Digest,
        request: Bytes,
        patience: Duration,
    ) -> Result<Bytes, BusError> {
        let of = self.service_type(end);
        if !of.digest.agrees(digest) && of.request != *digest {
            return Err(BusError::TypeMismatch {
                what: format!("service {name}"),
                theirs: format!("{} {}", of.name, of.digest),
                ours: digest.to_string(),
            });
        }
        let answer = async {
            match end {
                End::SendGoal => self.send_goal(name, &request).await,
                End::CancelGoal => Ok(self.cancel_goal(&request).await),
                _ => Ok(self.goals.result(&request).await),
            }
        };
        let late = |_| BusError::Timeout {
            what: format!("service {name}"),
            after: patience,
        };
        timeout(patience, answer).await.map_err(late)?
    }

    /// The robot's node or the robot has gone: its goals are cancelled, and not followed for long.
    pub(super) fn cancel_all(&self) {
        self.client.leave();
    }

    async fn send_goal(self: &Arc<Self>, name: &str, request: &[u8]) -> Result<Bytes, BusError> {
        let refused = |reason: String| {
            self.tell(&format!("a goal is refused: {reason}"));
            Ok(goal_server::refusal())
        };
        let (begun, goal) = match self.goals.begin(request) {
            Ok(begun) => begun,
            Err(reason) => return refused(reason),
        };
        let permit = match self.budget.take(goal.len()) {
            Ok(permit) => permit,
            Err(full) => {
                self.goals.refuses(&begun);
                return refused(full.to_string());
            }
        };
        let (answer, answered) = oneshot::channel();
        let id = begun.id();
        let events = Ear {
            // It hears of its end even when nobody listens any more.
            parts: Arc::clone(self),
            id: id.clone(),
            begun,
            answer: Mutex::new(Some(answer)),
            permit: Mutex::new(Some(permit)),
        };
        self.client.sends(&id, goal, Arc::new(events));
        match answered.await {
            Ok(Ok(answer)) => Ok(answer),
            Ok(Err(reason)) => Err(BusError::CallFailed {
                service: name.to_owned(),
                reason,
                fate: CallFate::Unknown,
            }),
            Err(_) => Err(BusError::Closed),
        }
    }

    /// Ends those goals that their nodes are willing to end.
    async fn cancel_goal(&self, request: &[u8]) -> Bytes {
        let Some(wanted) = self.goals.wanted(request) else {
            return goal_server::not_canceled();
        };
        let asked = wanted.newly().map(|id| {
            let (sender, answer) = oneshot::channel();
            let mut canceling = self.canceling.lock();
            canceling.entry(id.clone()).or_default().push(sender);
            drop(canceling);
            match self.goals.is_under_way(&id) {
                true => self.client.cancel(&id),
                // It has ended meanwhile: nobody will answer.
                false => self.cancel_answered(&id, false),
            }
            async move { answer.await.unwrap_or(false).then_some(id) }
        });
        let asked: Vec<_> = asked.collect();
        let ends: Vec<String> = join_all(asked).await.into_iter().flatten().collect();
        let canceled = self
            .goals
            .canceled(&wanted, |id| ends.iter().any(|it| it == id));
        canceled.answer
    }

    fn cancel_answered(&self, id: &str, ends: bool) {
        let waiting = self.canceling.lock().remove(id);
        for waiting in waiting.into_iter().flatten() {
            let _ = waiting.send(ends);
        }
    }

    /// ROS 2 has no words for why a goal ends: they go to the robot's log.
    fn tell(&self, what: &str) {
        let text = format!("{what} (action {})", self.goals.name());
        let _ = self.notices.send((self.node.node().to_owned(), text));
    }
}

/// What the sender of a goal is answered, or why nobody will ever know.
type Answer = Result<Bytes, String>;

struct Ear {
    parts: Arc<ActionParts>,
    id: String,
    begun: Begun,
    /// Until its sender is answered.
    answer: Mutex<Option<oneshot::Sender<Answer>>>,
    /// For what is held of it while it is under way.
    permit: Mutex<Option<Permit>>,
}

impl Ear {
    fn answer(&self, answer: impl FnOnce() -> Answer) {
        if let Some(sender) = self.answer.lock().take() {
            let _ = sender.send(answer());
        }
    }
}

impl GoalEvents for Ear {
    fn accepted(&self) {
        let answer = self.parts.goals.answer(&self.begun, true);
        self.answer(|| Ok(answer));
    }

    fn cancel_answered(&self, ends: bool) {
        self.parts.cancel_answered(&self.id, ends);
    }

    fn feedback(&self, feedback: Bytes) {
        self.parts.goals.feedback(&self.id, &feedback);
    }

    fn ended(&self, end: Result<GoalEnd, String>) {
        let goals = &self.parts.goals;
        drop(self.permit.lock().take());
        let outcome = end.as_ref().ok().map(|end| end.outcome);
        let (end, mut why) = match end {
            Ok(end) => {
                let why = end.text.clone();
                (end, why)
            }
            Err(reason) => (aborted(), reason),
        };
        // One that was not answered before was not accepted.
        let rejected = matches!(outcome, None | Some(Outcome::Rejected));
        let refused = rejected && goals.refuses(&self.begun);
        if outcome == Some(Outcome::Rejected) && !refused && why.is_empty() {
            "its node did not accept it when it was free for it".clone_into(&mut why);
        }
        if !why.is_empty() {
            self.parts.tell(&format!("goal {} ended: {why}", self.id));
        }
        if refused {
            return self.answer(|| match outcome {
                None => Err(why),
                Some(_) => Ok(goal_server::refusal()),
            });
        }
        goals.end(&self.id, &end);
        self.parts
            .cancel_answered(&self.id, outcome == Some(Outcome::Canceled));
        // Its sender learns of its end by its result.
        self.answer(|| Ok(goals.answer(&self.begun, true)));
    }
}

fn aborted() -> GoalEnd {
    GoalEnd {
        outcome: Outcome::Aborted,
        text: String::new(),
        result: Bytes::new(),
    }
}

impl GroupEvents for Ear {
    fn waits(&self) {
        let answer = self.parts.goals.waits(&self.begun);
        self.answer(|| Ok(answer));
    }
}

#[cfg(test)]
mod tests;
