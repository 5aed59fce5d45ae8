//! Goals that were sent to an action server, independent of the transport: DDS ([`super::Ros2ActionClient`]), or a
//! component that stands between two systems. Each goal has a task that first sends it and then requests its result.
//!
//! ```text
//!  send_goal, cancel_goal ──▶ GoalClient ──▶ ActionCalls     services of the server
//!             GoalEvents ◀──────────┴──────── feedback
//! ```

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::{ActionEndpoint, BusError, GoalEnd, GoalError, GoalEvents, GoalOutcome, MessageReceiver};
use ros_message::codec::{Time, default_message};
use ros_message::schema::ActionDef;
use tokio::sync::{mpsc, watch};
use tokio::task::AbortHandle;
use tokio::time::sleep;

use super::GoalId;
use super::messages::{self, ActionGoalStatus, GoalInfo};

/// Time for a server to answer a cancel request, or to accept a goal that nobody waits for any more.
const CANCEL_WAITS: Duration = Duration::from_secs(10);
/// No time limit: the call ends with the server.
const FOREVER: Duration = Duration::MAX;

/// The services of one server.
#[async_trait]
pub trait ActionCalls: Send + Sync + 'static {
    /// Calls a service of the action. Fails if the server goes away before it has answered.
    async fn call(&self, end: ActionEndpoint, request: Bytes, patience: Duration) -> Result<Bytes, GoalError>;
    /// Spawns the task of a goal, or the one that reports events.
    fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) -> AbortHandle;
    /// Fails if spawned tasks end at once.
    fn check_open(&self) -> Result<(), BusError> {
        Ok(())
    }
}

/// The goals of one client. Those that are under way when it is dropped are cancelled.
pub struct GoalClient<C: ActionCalls> {
    shared: Arc<GoalClientState<C>>,
    task: AbortHandle,
}

struct GoalClientState<C> {
    name: String,
    of: Arc<ActionDef>,
    calls: C,
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

impl<C: ActionCalls> GoalClient<C> {
    /// Creates a client without goals of the action of this name. `feedback` are the messages of its feedback topic.
    pub fn new(name: &str, of: &Arc<ActionDef>, calls: C, feedback: MessageReceiver) -> Self {
        let (sender, ended) = mpsc::unbounded_channel();
        let shared = Arc::new(GoalClientState {
            name: name.to_owned(),
            of: Arc::clone(of),
            calls,
            goals: Mutex::default(),
            ended: sender,
        });
        let task = shared.calls.spawn(report_events(EndGoalsOnDrop(Arc::clone(&shared)), feedback, ended));
        Self { shared, task }
    }

    /// Returns the services of the server.
    pub fn calls(&self) -> &C {
        &self.shared.calls
    }

    /// Sends a serialized goal. An id that is a UUID is used as it is; any other one is mapped to a random UUID.
    pub fn send_goal(&self, id: &str, goal: &[u8], events: Arc<dyn GoalEvents>) {
        let shared = &self.shared;
        let uuid = GoalId::parse(id).unwrap_or_else(GoalId::random);
        let Some(request) = messages::write_with_id(uuid, &shared.of.goal, goal) else {
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
        shared.calls.spawn(async move {
            let end = carrying.run_goal(uuid, request, wished).await;
            // Not received by anyone if the client was dropped meanwhile.
            let _ = carrying.ended.send((uuid, end));
        });
        if shared.calls.check_open().is_err() {
            shared.finish_goal(uuid, Err(BusError::Closed.into()));
        }
    }

    /// Asks the server to cancel a goal as soon as it has accepted it.
    pub fn cancel_goal(&self, id: &str) {
        let goals = self.shared.goals.lock();
        let goal = goals.named.get(id).and_then(|id| goals.under_way.get(id));
        if let Some(goal) = goal {
            goal.wish.send_replace(GoalIntent::Cancel);
        }
    }

    /// Ends all goals for this reason, without cancelling them.
    pub fn end_all(&self, reason: &GoalError) {
        self.shared.end_all(reason);
    }
}

impl<C: ActionCalls> Drop for GoalClient<C> {
    fn drop(&mut self) {
        self.task.abort();
        let goals = std::mem::take(&mut *self.shared.goals.lock());
        for goal in goals.under_way.into_values() {
            goal.wish.send_replace(GoalIntent::Abandon);
        }
    }
}

impl<C> GoalClientState<C> {
    fn end_all(&self, reason: &GoalError) {
        let goals = std::mem::take(&mut *self.goals.lock());
        for goal in goals.under_way.into_values() {
            goal.events.on_ended(Err(reason.clone()));
        }
    }
}

impl<C: ActionCalls> GoalClientState<C> {
    async fn run_goal(
        &self,
        id: GoalId,
        request: Bytes,
        mut wished: watch::Receiver<GoalIntent>,
    ) -> Result<GoalEnd, GoalError> {
        let taken = tokio::select! {
            taken = self.calls.call(ActionEndpoint::SendGoal, request, FOREVER) => taken?,
            // The goal may be accepted all the same, and is to be cancelled then.
            () = wait_abandoned(CANCEL_WAITS, wished.clone()) => return Err(BusError::Closed.into()),
        };
        match messages::read_accepted(&taken) {
            Some(true) => self.report_accepted(id),
            Some(false) => return Ok(self.rejected_end()),
            None => return Err(GoalError::UnreadableAnswer(self.name.clone())),
        }
        let asked = messages::write_id(id);
        tokio::select! {
            result = self.calls.call(ActionEndpoint::GetResult, asked, FOREVER) => self.parse_result(&result?),
            () = self.forward_cancels(id, &mut wished) => Err(BusError::Closed.into()),
        }
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
        let ends = match self.calls.call(ActionEndpoint::CancelGoal, request, CANCEL_WAITS).await {
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
async fn report_events<C: ActionCalls>(
    closing: EndGoalsOnDrop<C>,
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
struct EndGoalsOnDrop<C>(Arc<GoalClientState<C>>);

impl<C> Drop for EndGoalsOnDrop<C> {
    fn drop(&mut self) {
        self.0.end_all(&BusError::Closed.into());
    }
}
