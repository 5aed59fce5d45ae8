//! Server of one action, on actionlib's topics.

use std::sync::{Arc, OnceLock};

use budget::Budget;
use bytes::Bytes;
use ros_bus::{ActionHandler, ActionServer, BusError, GoalEnd, GoalOutcome, Publisher, Subscription};
use ros_message::schema::ActionDef;
use tokio::task::AbortHandle;

use crate::actions::STATUS_PERIOD;
use crate::actions::goal_server::{GoalLimits, GoalServer, GoalServerTopics};
use crate::bus::Ros1BusState;

/// Maximum number of goals of a server.
const MAX_GOALS: usize = 1000;

/// A server of one action.
pub(crate) struct Ros1ActionServer {
    shared: Arc<ActionlibServerState>,
    task: AbortHandle,
}

struct ActionlibServerState {
    bus: Arc<Ros1BusState>,
    of: Arc<ActionDef>,
    handler: Arc<dyn ActionHandler>,
    goals: GoalServer<OnceLock<ActionServerPublishers>>,
}

/// Publishers of the server.
struct ActionServerPublishers {
    status: Box<dyn Publisher>,
    feedback: Box<dyn Publisher>,
    result: Box<dyn Publisher>,
}

/// Publishes nothing before the topics are open.
impl GoalServerTopics for OnceLock<ActionServerPublishers> {
    fn publish_status(&self, message: Bytes) {
        if let Some(ends) = self.get() {
            ends.status.publish(message);
        }
    }

    fn publish_feedback(&self, message: Bytes) {
        if let Some(ends) = self.get() {
            ends.feedback.publish(message);
        }
    }

    fn publish_result(&self, message: Bytes) {
        if let Some(ends) = self.get() {
            ends.result.publish(message);
        }
    }
}

/// Subscriptions to what clients publish.
struct ActionServerSubscriptions {
    goal: Subscription,
    cancel: Subscription,
}

impl Ros1ActionServer {
    /// Opens the action's topics in the background.
    pub(crate) fn open(
        bus: &Arc<Ros1BusState>,
        name: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Self {
        let limits = GoalLimits { goals: MAX_GOALS, budget: Budget::without_limit(), holder: "this server" };
        let shared = Arc::new(ActionlibServerState {
            bus: bus.clone(),
            of: of.clone(),
            handler,
            goals: GoalServer::new(name, of, OnceLock::new(), limits),
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
        let goals = &self.shared.goals;
        for id in goals.under_way() {
            goals.end_without_result(&id, GoalOutcome::Aborted, "its server is gone".to_owned());
        }
    }
}

impl ActionServer for Ros1ActionServer {
    /// Does nothing: a goal that waits is pending already.
    fn accept_goal(&self, _id: &str) {}

    fn execute_goal(&self, id: &str) {
        self.shared.goals.accept(id);
    }

    fn publish_feedback(&self, id: &str, feedback: Bytes) -> bool {
        self.shared.goals.publish_feedback(id, &feedback)
    }

    fn end_goal(&self, id: &str, end: GoalEnd) -> bool {
        self.shared.goals.end_goal(id, end)
    }
}

impl ActionlibServerState {
    /// Advertises first: a goal may be answered as soon as it can arrive.
    async fn open(&self) -> Result<ActionServerSubscriptions, BusError> {
        let topics = super::ActionTopicSet::new(&self.bus, self.goals.name(), &self.of)?;
        let ends = ActionServerPublishers {
            status: topics.advertise("status", true).await?,
            feedback: topics.advertise("feedback", false).await?,
            result: topics.advertise("result", false).await?,
        };
        // Set only here.
        let _ = self.goals.topics().set(ends);
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
                Some(message) = heard.cancel.messages.recv() => {
                    for id in self.goals.cancel(&message.bytes) {
                        self.handler.on_cancel(&id);
                    }
                }
                _ = period.tick() => self.goals.publish_status(),
            }
        }
    }

    fn on_goal(&self, message: &Bytes) {
        let Some((id, goal)) = self.goals.begin(message) else {
            return;
        };
        match self.handler.on_goal(&id, goal) {
            Ok(()) if self.handler.is_answer_deferred() => self.goals.announce_status(),
            Ok(()) => self.goals.accept(&id),
            Err(reason) => {
                self.goals.end_without_result(&id, GoalOutcome::Rejected, reason.into_string());
            }
        }
    }
}
