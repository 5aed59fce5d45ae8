//! Goals sent by this node: each has a task that first sends it and then requests its result.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::{
    ActionClient, BusError, CallFate, GoalEnd, GoalError, GoalEvents, GoalOutcome, MessageReceiver, MessageSender,
    PeerId, SerializedMessage, ServiceType, WireType, message_queue,
};
use ros_message::codec::{Time, default_message};
use ros_message::schema::ActionDef;
use tokio::sync::{mpsc, watch};
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};

use super::messages::{self, ActionGoalStatus, GoalInfo};
use super::{ActionInterfaces, GoalId, QUEUE};
use crate::calls;
use crate::client::ServiceClient;
use crate::raw::{self, RawListener, RawReader};
use crate::state::Ros2BusState;

/// Time after which a server that does not acknowledge our feedback reader is assumed to know it.
const UNSURE: Duration = Duration::from_millis(200);
/// Grace period for a server that was there a moment ago.
const GRACE: Duration = Duration::from_secs(3);
/// Time for a server to answer a cancel request, or to accept a goal that nobody waits for any more.
const CANCEL_WAITS: Duration = Duration::from_secs(10);
/// No time limit: the call ends with the server.
const FOREVER: Duration = Duration::MAX;

/// A client of one action.
pub(crate) struct Ros2ActionClient {
    shared: Arc<ActionClientState>,
    task: AbortHandle,
}

struct ActionClientState {
    bus: Arc<Ros2BusState>,
    name: String,
    of: Arc<ActionDef>,
    send_goal: Arc<ServiceClient>,
    get_result: Arc<ServiceClient>,
    cancel_goal: Arc<ServiceClient>,
    feedback: RawReader,
    goals: Mutex<ActiveGoals>,
    /// Sends ended goals to the task that delivers all events, so that they are delivered in order.
    ended: mpsc::UnboundedSender<FinishedGoal>,
}

type FinishedGoal = (GoalId, Result<GoalEnd, GoalError>);

#[derive(Default)]
struct ActiveGoals {
    under_way: HashMap<GoalId, ActiveGoal>,
    /// Ids by the names that the senders gave their goals.
    named: HashMap<String, GoalId>,
}

struct ActiveGoal {
    name: String,
    events: Arc<dyn GoalEvents>,
    wish: watch::Sender<GoalIntent>,
}

/// Intent of a goal's sender.
#[derive(Debug, Clone, Copy, PartialEq)]
enum GoalIntent {
    GoOn,
    /// Cancel the goal.
    Cancel,
    /// Cancel the goal; nobody waits for it any more.
    Abandon,
}

impl ActiveGoals {
    fn remove(&mut self, id: GoalId) -> Option<ActiveGoal> {
        let goal = self.under_way.remove(&id)?;
        self.named.remove(&goal.name);
        Some(goal)
    }
}

impl Ros2ActionClient {
    /// Opens the action's services and topics; servers are discovered in the background.
    pub(crate) fn open(bus: &Arc<Ros2BusState>, name: &str, of: &Arc<ActionDef>) -> Result<Self, BusError> {
        bus.check_open()?;
        let parts = ActionInterfaces::for_action(name, of)?;
        let client = |(service, of): (String, ServiceType)| calls::client_for(bus, &service, &of);
        let (queue, feedback) = message_queue(QUEUE);
        let (topic, wire_type) = parts.feedback;
        let wire_type = Arc::new(wire_type);
        let ear = Arc::new(FeedbackSink { queue, wire_type: Arc::clone(&wire_type), publisher: PeerId::from(name) });
        let qos = ActionInterfaces::feedback_qos();
        let (sender, ended) = mpsc::unbounded_channel();
        let shared = Arc::new(ActionClientState {
            bus: bus.clone(),
            name: name.to_owned(),
            of: of.clone(),
            send_goal: client(parts.send_goal)?,
            get_result: client(parts.get_result)?,
            cancel_goal: client(parts.cancel_goal)?,
            feedback: raw::reader(bus, &topic, &wire_type, &qos, ear)?,
            goals: Mutex::default(),
            ended: sender,
        });
        let task = bus.spawn(report_events(EndGoalsOnDrop(shared.clone()), feedback, ended));
        Ok(Self { shared, task })
    }
}

impl Drop for Ros2ActionClient {
    fn drop(&mut self) {
        self.task.abort();
        let goals = std::mem::take(&mut *self.shared.goals.lock());
        for goal in goals.under_way.into_values() {
            goal.wish.send_replace(GoalIntent::Abandon);
        }
    }
}

#[async_trait]
impl ActionClient for Ros2ActionClient {
    async fn wait_for_server(&self, patience: Duration) -> Result<(), BusError> {
        let shared = &self.shared;
        let ready = async {
            tokio::try_join!(
                shared.send_goal.wait_until_ready(patience),
                shared.get_result.wait_until_ready(patience),
                shared.cancel_goal.wait_until_ready(patience),
            )?;
            shared.feedback.wait_for_writer(UNSURE).await;
            Ok(())
        };
        match timeout(patience, ready).await {
            Ok(Err(BusError::Timeout { .. })) | Err(_) => {
                Err(BusError::Timeout { what: format!("action {}", shared.name), after: patience })
            }
            Ok(Err(of_part @ BusError::TypeMismatch { .. })) => Err(shared.type_mismatch().unwrap_or(of_part)),
            Ok(ready) => ready,
        }
    }

    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        let shared = &self.shared;
        let uuid = GoalId::parse(id).unwrap_or_else(GoalId::random);
        let Some(request) = messages::write_with_id(uuid, &shared.of.goal, &goal) else {
            let goal_type = shared.of.goal.name().to_owned();
            return events.on_ended(Err(GoalError::NotAGoal(goal_type)));
        };
        let (wish, wished) = watch::channel(GoalIntent::GoOn);
        let known = ActiveGoal { name: id.to_owned(), events: events.clone(), wish };
        {
            let mut goals = shared.goals.lock();
            if goals.named.contains_key(id) || goals.under_way.contains_key(&uuid) {
                drop(goals);
                return events.on_ended(Err(GoalError::AlreadyUnderWay(id.to_owned())));
            }
            goals.named.insert(id.to_owned(), uuid);
            goals.under_way.insert(uuid, known);
        }
        let carrying = shared.clone();
        shared.bus.spawn(async move {
            let end = carrying.run_goal(uuid, request, wished).await;
            // Not received by anyone if the client was dropped meanwhile.
            let _ = carrying.ended.send((uuid, end));
        });
        if shared.bus.check_open().is_err() {
            shared.finish_goal(uuid, Err(BusError::Closed.into()));
        }
    }

    /// The server is asked as soon as it has accepted the goal.
    fn cancel_goal(&self, id: &str) {
        let goals = self.shared.goals.lock();
        let goal = goals.named.get(id).and_then(|id| goals.under_way.get(id));
        if let Some(goal) = goal {
            goal.wish.send_replace(GoalIntent::Cancel);
        }
    }
}

impl ActionClientState {
    /// Returns the error if the server has another type, under the action's name: the type of a part is
    /// `Fibonacci_SendGoal`.
    fn type_mismatch(&self) -> Option<BusError> {
        let services = self.of.services.as_ref()?;
        let parts = [(&self.send_goal, &services.send_goal), (&self.get_result, &services.get_result)];
        parts.into_iter().find_map(|(part, ours)| {
            let of_action = |of: ServiceType| {
                let name = of.name.rsplit_once('_').map(|(action, _)| action.to_owned());
                ServiceType { name: name.unwrap_or_default(), ..of }
            };
            let theirs = of_action(part.mismatched_type()?);
            let what = format!("action {}", self.name);
            Some(theirs.mismatch(&of_action(ServiceType::from_service(ours)), what))
        })
    }

    async fn run_goal(
        &self,
        id: GoalId,
        request: Bytes,
        mut wished: watch::Receiver<GoalIntent>,
    ) -> Result<GoalEnd, GoalError> {
        let taken = tokio::select! {
            taken = self.call_part(&self.send_goal, request) => taken?,
            // The goal may be accepted all the same, and is to be cancelled then.
            () = wait_abandoned(CANCEL_WAITS, wished.clone()) => return Err(BusError::Closed.into()),
        };
        match messages::read_accepted(&taken) {
            Some(true) => self.report_accepted(id),
            Some(false) => return Ok(self.rejected_end()),
            None => return Err(GoalError::UnreadableAnswer(self.name.clone())),
        }
        tokio::select! {
            result = self.call_part(&self.get_result, messages::write_id(id)) => self.parse_result(&result?),
            () = self.forward_cancels(id, &mut wished) => Err(BusError::Closed.into()),
        }
    }

    async fn call_part(&self, part: &ServiceClient, request: Bytes) -> Result<Bytes, GoalError> {
        // The call itself would wait for a later server, which must not be given an old goal.
        let mut servers = part.servers();
        let there = servers.wait_for(|servers| servers.count() > 0);
        if timeout(GRACE, there).await.is_err() {
            return Err(GoalError::NoServer(self.name.clone()));
        }
        let answer = part.call(request, FOREVER).await;
        answer.map_err(|error| match error {
            BusError::CallFailed { fate: CallFate::Unknown, .. } => GoalError::ServerGone(self.name.clone()),
            other => other.into(),
        })
    }

    /// Requests cancellation whenever it is intended; returns when the goal is abandoned.
    async fn forward_cancels(&self, id: GoalId, wished: &mut watch::Receiver<GoalIntent>) {
        loop {
            let wish = *wished.borrow_and_update();
            if wish != GoalIntent::GoOn {
                self.request_cancel(id).await;
            }
            if wish == GoalIntent::Abandon || wished.changed().await.is_err() {
                return;
            }
        }
    }

    /// Requests cancellation of a goal. A goal that has ended meanwhile, or that its server wants to finish, is not
    /// cancelled.
    async fn request_cancel(&self, id: GoalId) {
        let stamp = Time::default();
        let request = messages::write_cancel(GoalInfo { id, stamp });
        let action = &self.name;
        let ends = match self.cancel_goal.call(request, CANCEL_WAITS).await {
            Ok(answer) => match messages::read_cancelled(&answer, id) {
                Some(Ok(())) => true,
                refused => {
                    tracing::debug!(action, %id, ?refused, "a goal is not cancelled");
                    false
                }
            },
            Err(error) => {
                tracing::debug!(action, %id, %error, "a goal cannot be cancelled");
                false
            }
        };
        if let Some(events) = self.goal_events(id) {
            events.on_cancel_response(ends);
        }
    }

    fn rejected_end(&self) -> GoalEnd {
        GoalEnd { outcome: GoalOutcome::Rejected, text: String::new(), result: default_message(&self.of.result).into() }
    }

    fn parse_result(&self, answer: &[u8]) -> Result<GoalEnd, GoalError> {
        let Some((status, result)) = messages::read_result(&self.of.result, answer) else {
            return Err(GoalError::UnreadableResult(self.name.clone()));
        };
        let outcome = match status {
            Some(ActionGoalStatus::Succeeded) => GoalOutcome::Succeeded,
            Some(ActionGoalStatus::Canceled) => GoalOutcome::Canceled,
            Some(ActionGoalStatus::Aborted) => GoalOutcome::Aborted,
            Some(ActionGoalStatus::Unknown) => return Err(GoalError::Forgotten),
            _ => GoalOutcome::Unknown,
        };
        Ok(GoalEnd { outcome, text: String::new(), result })
    }

    fn goal_events(&self, id: GoalId) -> Option<Arc<dyn GoalEvents>> {
        let goals = self.goals.lock();
        goals.under_way.get(&id).map(|goal| goal.events.clone())
    }

    fn report_accepted(&self, id: GoalId) {
        if let Some(events) = self.goal_events(id) {
            events.on_accepted();
        }
    }

    fn report_feedback(&self, bytes: &[u8]) {
        let Some(id) = messages::read_id(bytes) else {
            return;
        };
        let events = self.goal_events(id);
        let feedback = messages::read_after_id(&self.of.feedback, bytes);
        if let (Some(events), Some(feedback)) = (events, feedback) {
            events.on_feedback(feedback);
        }
    }

    fn finish_goal(&self, id: GoalId, end: Result<GoalEnd, GoalError>) {
        let goal = self.goals.lock().remove(id);
        if let Some(goal) = goal {
            goal.events.on_ended(end);
        }
    }
}

/// Returns when the goal has been abandoned for this long.
async fn wait_abandoned(long: Duration, mut wished: watch::Receiver<GoalIntent>) {
    // Without its sender nobody waits either.
    drop(wished.wait_for(|wish| *wish == GoalIntent::Abandon).await);
    sleep(long).await;
}

/// Delivers events of goals. Feedback that a server sent before the end of a goal arrived before the result.
async fn report_events(
    closing: EndGoalsOnDrop,
    mut feedback: MessageReceiver,
    mut ended: mpsc::UnboundedReceiver<FinishedGoal>,
) {
    let shared = &closing.0;
    loop {
        tokio::select! {
            Some(message) = feedback.recv() => shared.report_feedback(&message.bytes),
            Some((id, end)) = ended.recv() => {
                for _ in 0..feedback.len() {
                    if let Some(message) = feedback.try_recv() {
                        shared.report_feedback(&message.bytes);
                    }
                }
                shared.finish_goal(id, end);
            }
            else => return,
        }
    }
}

/// Ends all remaining goals for their senders when no more events will arrive.
struct EndGoalsOnDrop(Arc<ActionClientState>);

impl Drop for EndGoalsOnDrop {
    fn drop(&mut self) {
        let goals = std::mem::take(&mut *self.0.goals.lock());
        for goal in goals.under_way.into_values() {
            goal.events.on_ended(Err(BusError::Closed.into()));
        }
    }
}

/// Queues feedback while the participant calls; it is delivered later.
struct FeedbackSink {
    queue: MessageSender,
    wire_type: Arc<WireType>,
    publisher: PeerId,
}

impl RawListener for FeedbackSink {
    fn on_message(&self, payload: Bytes) {
        self.queue.send(SerializedMessage {
            bytes: payload,
            wire_type: self.wire_type.clone(),
            publisher: self.publisher.clone(),
            latching: false,
        });
    }
}
