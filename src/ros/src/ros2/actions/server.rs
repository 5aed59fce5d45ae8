//! An action that this side serves.

mod retired;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use tokio::task::AbortHandle;
use tokio::time::timeout;

pub(in crate::ros2) use self::retired::Retired;
use self::retired::{Guard, Keeping, take_over};
use super::Parts;
use super::goal_server::{self, GoalServer, Topics};
use crate::bus::{
    ActionHandler, ActionServer, BusError, GoalEnd, Qos, ServiceHandler, ServiceType, WireType,
};
use crate::ros2::bus::Inner;
use crate::ros2::raw::{self, RawWriter};
use crate::ros2::{names, quality, services};
use crate::schema::ActionDef;

/// How long results of aborted goals are there for clients that have not asked for them yet.
const LINGER: Duration = Duration::from_secs(5);

/// One action.
pub(in crate::ros2) struct Server {
    shared: Arc<Shared>,
    task: AbortHandle,
    /// Dropped after all goals have ended.
    _services: [Guard; 2],
    get_result: Option<Guard>,
}

struct Shared {
    bus: Arc<Inner>,
    name: String,
    handler: Arc<dyn ActionHandler>,
    goals: Arc<GoalServer<Writers>>,
}

struct Writers {
    feedback: RawWriter,
    status: RawWriter,
}

impl Topics for Writers {
    fn feedback(&self, message: Bytes) {
        self.feedback.write(message);
    }

    fn status(&self, message: Bytes) {
        self.status.write(message);
    }
}

impl Server {
    /// Opens the action's parts.
    pub(in crate::ros2) fn open(
        bus: &Arc<Inner>,
        name: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Self, BusError> {
        bus.check_open()?;
        let parts = Parts::of(name, of)?;
        let writer = |(topic, of): (String, WireType), qos: Qos| {
            let qos = quality::offered(&qos);
            Ok::<_, BusError>(raw::writer(bus, &names::topic(&topic, &of)?, qos))
        };
        let writers = Writers {
            feedback: writer(parts.feedback, Parts::feedback_qos())?,
            status: writer(parts.status, Parts::status_qos())?,
        };
        let shared = Arc::new(Shared {
            bus: bus.clone(),
            name: name.to_owned(),
            handler,
            goals: GoalServer::new(name, of, writers, Budget::unlimited()),
        });
        let serve = |(service, of): (String, ServiceType), handler: Arc<dyn ServiceHandler>| {
            services::serve(bus, &service, of, handler)
        };
        take_over(bus, name);
        // Goals last: all that follows them can be asked for then.
        let get_result = serve(parts.get_result, Arc::new(GetResult(shared.clone())))?;
        let services = [
            serve(parts.cancel_goal, Arc::new(CancelGoal(shared.clone())))?,
            serve(parts.send_goal, Arc::new(SendGoal(shared.clone())))?,
        ];
        let goals = shared.goals.clone();
        let task = bus.spawn(async move { goals.forget_in_time().await });
        Ok(Self {
            shared,
            task,
            _services: services,
            get_result: Some(get_result),
        })
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.task.abort();
        let goals = &self.shared.goals;
        goals.close();
        let asked = goals.are_asked_for();
        if let Some(guard) = self.get_result.take().filter(|_| !asked) {
            let shared = self.shared.clone();
            let keeping = Keeping::of(&shared.bus, &shared.name, guard);
            self.shared.bus.spawn(async move {
                let _ = timeout(LINGER, shared.goals.all_asked_for()).await;
                drop(keeping);
            });
        }
    }
}

impl ActionServer for Server {
    fn feedback(&self, id: &str, feedback: Bytes) -> bool {
        self.shared.goals.feedback(id, &feedback)
    }

    fn end(&self, id: &str, end: GoalEnd) -> bool {
        self.shared.goals.end(id, &end)
    }
}

/// What cannot be read is refused: a service of ROS 2 has no other way to say so.
struct SendGoal(Arc<Shared>);

#[async_trait]
impl ServiceHandler for SendGoal {
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, String> {
        let Shared {
            goals,
            handler,
            name: action,
            ..
        } = &*self.0;
        let refused = |reason: String| {
            tracing::debug!(action, caller, reason, "a goal is refused");
        };
        let (begun, goal) = match goals.begin(&request) {
            Ok(begun) => begun,
            Err(reason) => {
                refused(reason);
                return Ok(goal_server::refusal());
            }
        };
        let taken = handler.goal(&begun.id(), goal);
        let answer = goals.answer(&begun, taken.is_ok());
        taken.unwrap_or_else(refused);
        Ok(answer)
    }
}

/// Answers once the goal has ended.
struct GetResult(Arc<Shared>);

#[async_trait]
impl ServiceHandler for GetResult {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, String> {
        Ok(self.0.goals.result(&request).await)
    }
}

struct CancelGoal(Arc<Shared>);

#[async_trait]
impl ServiceHandler for CancelGoal {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, String> {
        let Shared { goals, handler, .. } = &*self.0;
        let Some(wanted) = goals.wanted(&request) else {
            return Ok(goal_server::not_canceled());
        };
        let canceled = goals.canceled(&wanted, |_| true);
        for id in &canceled.newly {
            handler.cancel(id);
        }
        Ok(canceled.answer)
    }
}
