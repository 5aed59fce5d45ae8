//! An action of ROS 2 that a client of another kind stands behind: to those who use its three services and two topics
//! it looks like one action server.
//!
//! ```text
//!  send_goal ──▶ ActionClient      a group of servants, an action of the other ROS
//!                     │            the response is the server's decision; a goal that waits is accepted, but not
//!                     │            executed yet
//!  cancel_goal ─▶ ────┘            likewise
//!  get_result, feedback, status ◀── GoalEvents
//! ```
//!
//! Its users have its own goals only: a cancel of all goals concerns no goal that was sent elsewhere.

use std::collections::HashMap;
use std::fmt::Display;
use std::sync::Arc;
use std::time::Duration;

use budget::{Budget, Permit};
use bytes::Bytes;
use futures_util::future::join_all;
use parking_lot::Mutex;
use ros_bus::{
    ActionClient, ActionEndpoint, BusError, CallFate, Digest, FailureReason, GoalEnd, GoalError, GoalEvents,
    GoalOutcome, MatchedPeers, MessageSender, PeerId, QosProfile, SerializedMessage, ServiceType, Subscription,
    TopicPeer, WireType, message_queue,
};
use ros_message::schema::ActionDef;
use tokio::sync::{oneshot, watch};
use tokio::task::AbortHandle;
use tokio::time::timeout;

use super::ActionInterfaces;
use super::goal_server::{self, GoalServer, GoalServerTopics, PendingGoal};

/// Receives reasons for which goals were refused or ended, in words for people: ROS 2 has no field for them. Must not
/// block.
pub type GoalNotices = Arc<dyn Fn(String) + Send + Sync>;

/// The services and topics of one action in front of a client.
pub struct GoalServices<C> {
    parts: ActionInterfaces,
    client: C,
    goals: Arc<GoalServer<PublishedTopics>>,
    /// Budget for pending goals.
    budget: Budget,
    /// Cancellations that wait for the server's answer.
    canceling: Mutex<HashMap<String, Vec<oneshot::Sender<bool>>>>,
    notices: GoalNotices,
    matched: watch::Sender<MatchedPeers>,
    expiring: AbortHandle,
}

/// Publisher of the feedback and status topics.
struct PublishedTopics {
    node: PeerId,
    feedback: Arc<WireType>,
    status: Arc<WireType>,
    state: Mutex<Listeners>,
}

#[derive(Default)]
struct Listeners {
    all: Vec<(ActionEndpoint, MessageSender)>,
    /// Last status, for new subscribers.
    status: Option<SerializedMessage>,
}

impl PublishedTopics {
    fn build_message(&self, of: &Arc<WireType>, bytes: Bytes, latching: bool) -> SerializedMessage {
        SerializedMessage { bytes, wire_type: Arc::clone(of), publisher: self.node.clone(), latching }
    }
}

impl Listeners {
    fn publish(&mut self, end: ActionEndpoint, message: &SerializedMessage) {
        self.all.retain(|(_, listener)| !listener.is_closed());
        for (_, listener) in self.all.iter().filter(|(of, _)| *of == end) {
            listener.send(message.clone());
        }
    }
}

impl GoalServerTopics for PublishedTopics {
    fn publish_feedback(&self, message: Bytes) {
        let message = self.build_message(&self.feedback, message, false);
        self.state.lock().publish(ActionEndpoint::Feedback, &message);
    }

    fn publish_status(&self, message: Bytes) {
        let message = self.build_message(&self.status, message, true);
        let mut state = self.state.lock();
        state.publish(ActionEndpoint::Status, &message);
        state.status = Some(message);
    }
}

impl<C: ActionClient + 'static> GoalServices<C> {
    /// Creates the services and topics of an action that `node` seems to serve. Goals under way and results kept for
    /// late requests are charged to `budget`.
    pub fn new(
        (name, node): (&str, &str),
        of: &Arc<ActionDef>,
        client: C,
        budget: &Budget,
        notices: GoalNotices,
    ) -> Result<Arc<Self>, BusError> {
        let parts = ActionInterfaces::for_action(name, of)?;
        let node = PeerId::from(node);
        let peer = TopicPeer { id: node.clone(), connected: true, offer: None };
        let published = PublishedTopics {
            node,
            feedback: Arc::new(parts.feedback.1.clone()),
            status: Arc::new(parts.status.1.clone()),
            state: Mutex::default(),
        };
        let goals = GoalServer::new(name, of, published, budget.clone());
        let expires = Arc::clone(&goals);
        let expiring = tokio::spawn(async move { expires.expire_results().await });
        Ok(Arc::new(Self {
            parts,
            client,
            goals,
            budget: budget.clone(),
            canceling: Mutex::default(),
            notices,
            matched: watch::Sender::new(MatchedPeers { peers: vec![peer], refused: Vec::new() }),
            expiring: expiring.abort_handle(),
        }))
    }

    /// Returns the client that executes the goals.
    pub fn client(&self) -> &C {
        &self.client
    }

    /// Returns the type of a topic.
    pub fn wire_type(&self, end: ActionEndpoint) -> &WireType {
        match end {
            ActionEndpoint::Feedback => &self.parts.feedback.1,
            _ => &self.parts.status.1,
        }
    }

    /// Returns the type of a service.
    pub fn service_type(&self, end: ActionEndpoint) -> &ServiceType {
        match end {
            ActionEndpoint::SendGoal => &self.parts.send_goal.1,
            ActionEndpoint::CancelGoal => &self.parts.cancel_goal.1,
            _ => &self.parts.get_result.1,
        }
    }

    /// Subscribes to a topic with updates about this robot's goals.
    pub fn subscribe(
        self: &Arc<Self>,
        end: ActionEndpoint,
        of: &WireType,
        qos: QosProfile,
    ) -> Result<Subscription, BusError> {
        let ours = self.wire_type(end);
        if !(of.digest.is_any() || ours.is_compatible_with(of)) {
            return Err(BusError::TypeMismatch {
                what: "topic of an action".to_owned(),
                theirs: of.to_string(),
                ours: ours.to_string(),
            });
        }
        let (sender, messages) = message_queue(qos.depth);
        let mut state = self.goals.topics().state.lock();
        if let Some(status) = state.status.as_ref().filter(|_| end == ActionEndpoint::Status && qos.is_latching()) {
            sender.send(status.clone());
        }
        state.all.push((end, sender));
        drop(state);
        Ok(Subscription {
            dropped: messages.drop_counter(),
            messages,
            matched: self.matched.subscribe(),
            // The action exists as long as somebody subscribes.
            guard: Box::new(Arc::clone(self)),
        })
    }

    /// Calls one of the services.
    pub async fn call(
        self: &Arc<Self>,
        (end, name): (ActionEndpoint, &str),
        digest: &Digest,
        request: Bytes,
        patience: Duration,
    ) -> Result<Bytes, BusError> {
        let of = self.service_type(end);
        if !of.digest.is_compatible_with(digest) && of.request != *digest {
            return Err(BusError::TypeMismatch {
                what: format!("service {name}"),
                theirs: format!("{} {}", of.name, of.digest),
                ours: digest.to_string(),
            });
        }
        let answer = async {
            match end {
                ActionEndpoint::SendGoal => self.send_goal(name, &request).await,
                ActionEndpoint::CancelGoal => Ok(self.cancel_goal(&request).await),
                _ => Ok(self.goals.result(&request).await),
            }
        };
        let late = |_| BusError::Timeout { what: format!("service {name}"), after: patience };
        timeout(patience, answer).await.map_err(late)?
    }

    /// Cancels all goals.
    pub fn cancel_all(&self) {
        self.goals.under_way().iter().for_each(|id| self.client.cancel_goal(id));
    }

    /// Returns true if a goal has not ended.
    pub fn has_goals(&self) -> bool {
        !self.goals.under_way().is_empty()
    }

    async fn send_goal(self: &Arc<Self>, name: &str, request: &[u8]) -> Result<Bytes, BusError> {
        let refused = |reason: &dyn Display| {
            self.notify(&format!("a goal is refused: {reason}"));
            Ok(goal_server::rejected_response())
        };
        let (begun, goal) = match self.goals.begin(request) {
            Ok(begun) => begun,
            Err(refusal) => return refused(&refusal),
        };
        let permit = match self.budget.take(goal.len()) {
            Ok(permit) => permit,
            Err(full) => {
                self.goals.reject(&begun);
                return refused(&full);
            }
        };
        let (answer, answered) = oneshot::channel();
        let id = begun.id();
        let events = ServicesGoalEvents {
            // It receives the end of the goal even if nobody subscribes any more.
            services: Arc::clone(self),
            id: id.clone(),
            begun,
            answer: Mutex::new(Some(answer)),
            permit: Mutex::new(Some(permit)),
        };
        self.client.send_goal(&id, goal, Arc::new(events));
        match answered.await {
            Ok(Ok(answer)) => Ok(answer),
            Ok(Err(reason)) => {
                Err(BusError::CallFailed { service: name.to_owned(), reason: reason.into(), fate: CallFate::Unknown })
            }
            Err(_) => Err(BusError::Closed),
        }
    }

    /// Cancels the goals whose nodes agree.
    async fn cancel_goal(&self, request: &[u8]) -> Bytes {
        let Some(wanted) = self.goals.parse_cancel(request) else {
            return goal_server::cancel_rejected_response();
        };
        let asked = wanted.new_ids().map(|id| {
            let (sender, answer) = oneshot::channel();
            let mut canceling = self.canceling.lock();
            let waiting = canceling.entry(id.clone()).or_default();
            // A server may never answer, and its client may ask again and again.
            waiting.retain(|earlier| !earlier.is_closed());
            waiting.push(sender);
            drop(canceling);
            if self.goals.is_under_way(&id) {
                self.client.cancel_goal(&id)
            } else {
                // It has ended meanwhile, so nobody will answer.
                self.resolve_cancel(&id, false)
            }
            async move { answer.await.unwrap_or(false).then_some(id) }
        });
        let asked: Vec<_> = asked.collect();
        let ends: Vec<String> = join_all(asked).await.into_iter().flatten().collect();
        let canceled = self.goals.cancel(&wanted, |id| ends.iter().any(|it| it == id));
        canceled.answer
    }

    fn resolve_cancel(&self, id: &str, ends: bool) {
        let waiting = self.canceling.lock().remove(id);
        for waiting in waiting.into_iter().flatten() {
            let _ = waiting.send(ends);
        }
    }

    /// Reports why a goal was refused or ended.
    fn notify(&self, what: &str) {
        (self.notices)(format!("{what} (action {})", self.goals.name()));
    }
}

impl<C> Drop for GoalServices<C> {
    fn drop(&mut self) {
        self.expiring.abort();
    }
}

/// Response to the sender of a goal, or the reason why there will be none.
type GoalAnswer = Result<Bytes, FailureReason>;

struct ServicesGoalEvents<C> {
    services: Arc<GoalServices<C>>,
    id: String,
    begun: PendingGoal,
    /// Present until the sender is answered.
    answer: Mutex<Option<oneshot::Sender<GoalAnswer>>>,
    /// Memory permit while the goal is pending.
    permit: Mutex<Option<Permit>>,
}

impl<C> ServicesGoalEvents<C> {
    fn answer_once(&self, answer: impl FnOnce() -> GoalAnswer) {
        if let Some(sender) = self.answer.lock().take() {
            let _ = sender.send(answer());
        }
    }
}

impl<C: ActionClient + 'static> GoalEvents for ServicesGoalEvents<C> {
    fn on_waiting(&self) {
        let answer = self.services.goals.accept(&self.begun);
        self.answer_once(|| Ok(answer));
    }

    fn on_accepted(&self) {
        let answer = self.services.goals.answer(&self.begun, true);
        self.answer_once(|| Ok(answer));
    }

    fn on_cancel_response(&self, ends: bool) {
        self.services.resolve_cancel(&self.id, ends);
    }

    fn on_feedback(&self, feedback: Bytes) {
        // Only a goal that is executed has feedback, whatever arrives first.
        if self.answer.lock().is_some() {
            self.on_accepted();
        }
        self.services.goals.publish_feedback(&self.id, &feedback);
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        let goals = &self.services.goals;
        drop(self.permit.lock().take());
        let outcome = end.as_ref().ok().map(|end| end.outcome);
        let (end, mut why) = match end {
            Ok(end) => {
                let why = end.text.clone();
                (end, why)
            }
            Err(error) => (aborted_end(), error.to_string()),
        };
        // A goal whose sender was not answered before was not accepted.
        let rejected = matches!(outcome, None | Some(GoalOutcome::Rejected));
        let refused = rejected && goals.reject(&self.begun);
        if outcome == Some(GoalOutcome::Rejected) && !refused && why.is_empty() {
            "its node did not accept it when it was free for it".clone_into(&mut why);
        }
        if !why.is_empty() {
            self.services.notify(&format!("goal {} ended: {why}", self.id));
        }
        if refused {
            return self.answer_once(|| match outcome {
                None => Err(FailureReason::new(why)),
                Some(_) => Ok(goal_server::rejected_response()),
            });
        }
        goals.end_goal(&self.id, &end);
        self.services.resolve_cancel(&self.id, outcome == Some(GoalOutcome::Canceled));
        // The sender learns of the end from the result.
        self.answer_once(|| Ok(goals.answer(&self.begun, true)));
    }
}

fn aborted_end() -> GoalEnd {
    GoalEnd { outcome: GoalOutcome::Aborted, text: String::new(), result: Bytes::new() }
}

#[cfg(test)]
mod tests;
