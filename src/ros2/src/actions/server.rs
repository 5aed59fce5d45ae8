//! Server of an action.

mod retired;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::{
    ActionHandler, ActionServer, BusError, FailureReason, GoalEnd, GoalOutcome, QosProfile, ServiceHandler,
    ServiceType, WireType,
};
use ros_message::schema::ActionDef;
use tokio::sync::oneshot;
use tokio::task::AbortHandle;
use tokio::time::timeout;

use self::retired::{RetiredGuard, release_retired};
use super::ActionInterfaces;
use super::goal_server::{self, GoalServer, GoalServerTopics, PendingGoal};
use crate::raw::{self, RawWriter};
use crate::services;
use crate::state::{BoxedGuard, Ros2BusState};

/// Time for which results of aborted goals are available to clients that have not requested them yet.
const LINGER: Duration = Duration::from_secs(5);

/// A server of one action.
pub(crate) struct Ros2ActionServer {
    shared: Arc<ActionServerState>,
    task: AbortHandle,
    /// Dropped after all goals have ended.
    _services: [BoxedGuard; 2],
    get_result: Option<BoxedGuard>,
}

struct ActionServerState {
    bus: Arc<Ros2BusState>,
    name: String,
    handler: Arc<dyn ActionHandler>,
    goals: Arc<GoalServer<Writers>>,
    /// Goals that have not ended, by id, whose handler defers its answer.
    deferred: Mutex<HashMap<String, DeferredGoal>>,
}

/// A goal that its handler accepts or rejects later.
struct DeferredGoal {
    begun: PendingGoal,
    /// Receives the response to its sender; taken once that is known.
    sender: Option<oneshot::Sender<Bytes>>,
}

impl ActionServerState {
    /// Lets a goal wait for its handler's answer; returns the receiver of the response to its sender.
    fn defer(&self, begun: PendingGoal) -> oneshot::Receiver<Bytes> {
        let (sender, answered) = oneshot::channel();
        self.deferred.lock().insert(begun.id(), DeferredGoal { begun, sender: Some(sender) });
        answered
    }

    /// Changes a goal that was deferred, and answers its sender unless that was done before.
    fn answer_deferred(&self, id: &str, change: impl FnOnce(&GoalServer<Writers>, &PendingGoal) -> Bytes) {
        let mut deferred = self.deferred.lock();
        let Some(goal) = deferred.get_mut(id) else {
            return;
        };
        let answer = change(&self.goals, &goal.begun);
        if let Some(sender) = goal.sender.take() {
            // The goal's sender may be gone.
            let _ = sender.send(answer);
        }
    }

    /// Answers a goal that ends before it was accepted; returns whether it is rejected, and thereby forgotten.
    fn reject_deferred(&self, id: &str, outcome: GoalOutcome) -> bool {
        let deferred = self.deferred.lock().remove(id);
        let Some((begun, sender)) = deferred.and_then(|goal| Some((goal.begun, goal.sender?))) else {
            return false;
        };
        let is_rejected = outcome == GoalOutcome::Rejected;
        let _ = sender.send(self.goals.answer(&begun, !is_rejected));
        is_rejected
    }
}

struct Writers {
    feedback: RawWriter,
    status: RawWriter,
}

impl GoalServerTopics for Writers {
    fn publish_feedback(&self, message: Bytes) {
        self.feedback.write(message);
    }

    fn publish_status(&self, message: Bytes) {
        self.status.write(message);
    }
}

impl Ros2ActionServer {
    /// Opens the action's services and topics.
    pub(crate) fn open(
        bus: &Arc<Ros2BusState>,
        name: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Self, BusError> {
        bus.check_open()?;
        let parts = ActionInterfaces::for_action(name, of)?;
        let writer = |(topic, of): (String, WireType), qos: QosProfile| raw::writer(bus, &topic, &of, &qos);
        let writers = Writers {
            feedback: writer(parts.feedback, ActionInterfaces::feedback_qos())?,
            status: writer(parts.status, ActionInterfaces::status_qos())?,
        };
        let shared = Arc::new(ActionServerState {
            bus: bus.clone(),
            name: name.to_owned(),
            handler,
            goals: GoalServer::new(name, of, writers, Budget::without_limit()),
            deferred: Mutex::default(),
        });
        let serve = |(service, of): (String, ServiceType), handler: Arc<dyn ServiceHandler>| {
            services::serve(bus, &service, of, handler)
        };
        release_retired(bus, name);
        // The goal service comes last: once it is there, everything that follows a goal can be requested.
        let get_result = serve(parts.get_result, Arc::new(GetResult(shared.clone())))?;
        let services = [
            serve(parts.cancel_goal, Arc::new(CancelGoal(shared.clone())))?,
            serve(parts.send_goal, Arc::new(SendGoal(shared.clone())))?,
        ];
        let goals = shared.goals.clone();
        let task = bus.spawn(async move { goals.expire_results().await });
        Ok(Self { shared, task, _services: services, get_result: Some(get_result) })
    }
}

impl Drop for Ros2ActionServer {
    fn drop(&mut self) {
        self.task.abort();
        let goals = &self.shared.goals;
        let deferred: Vec<String> = self.shared.deferred.lock().keys().cloned().collect();
        for id in deferred {
            self.shared.reject_deferred(&id, GoalOutcome::Rejected);
        }
        goals.close();
        let asked = goals.are_results_requested();
        if let Some(guard) = self.get_result.take().filter(|_| !asked) {
            let shared = self.shared.clone();
            let keeping = RetiredGuard::keep(&shared.bus, &shared.name, guard);
            self.shared.bus.spawn(async move {
                let _ = timeout(LINGER, shared.goals.wait_until_results_requested()).await;
                drop(keeping);
            });
        }
    }
}

impl ActionServer for Ros2ActionServer {
    fn accept_goal(&self, id: &str) {
        self.shared.answer_deferred(id, |goals, begun| goals.accept(begun));
    }

    fn execute_goal(&self, id: &str) {
        self.shared.answer_deferred(id, |goals, begun| goals.answer(begun, true));
    }

    fn publish_feedback(&self, id: &str, feedback: Bytes) -> bool {
        self.shared.goals.publish_feedback(id, &feedback)
    }

    fn end_goal(&self, id: &str, end: GoalEnd) -> bool {
        self.shared.reject_deferred(id, end.outcome) || self.shared.goals.end_goal(id, &end)
    }
}

/// Receives goals. A request that cannot be read is rejected: a ROS 2 service has no other way to report it.
struct SendGoal(Arc<ActionServerState>);

#[async_trait]
impl ServiceHandler for SendGoal {
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, FailureReason> {
        let ActionServerState { goals, handler, name: action, .. } = &*self.0;
        let refused = |reason: String| {
            tracing::debug!(action, caller, reason, "a goal is refused");
        };
        let (begun, goal) = match goals.begin(&request) {
            Ok(begun) => begun,
            Err(reason) => {
                refused(reason.to_string());
                return Ok(goal_server::rejected_response());
            }
        };
        // Before the goal is handed over: it may be answered at once.
        let deferred = handler.is_answer_deferred().then(|| self.0.defer(begun));
        match (handler.on_goal(&begun.id(), goal), deferred) {
            (Ok(()), Some(answered)) => Ok(answered.await.unwrap_or_else(|_| goal_server::rejected_response())),
            (Ok(()), None) => Ok(goals.answer(&begun, true)),
            (Err(reason), _) => {
                refused(reason.into_string());
                self.0.deferred.lock().remove(&begun.id());
                Ok(goals.answer(&begun, false))
            }
        }
    }
}

/// Answers once the goal has ended.
struct GetResult(Arc<ActionServerState>);

#[async_trait]
impl ServiceHandler for GetResult {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        Ok(self.0.goals.result(&request).await)
    }
}

struct CancelGoal(Arc<ActionServerState>);

#[async_trait]
impl ServiceHandler for CancelGoal {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let ActionServerState { goals, handler, .. } = &*self.0;
        let Some(wanted) = goals.parse_cancel(&request) else {
            return Ok(goal_server::cancel_rejected_response());
        };
        let canceled = goals.cancel(&wanted, |_| true);
        for id in &canceled.newly {
            handler.on_cancel(id);
        }
        Ok(canceled.answer)
    }
}
