//! An action that this side serves.

mod goals;
mod retired;

use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use rtps::{Durability, EndpointQos, History};
use tokio::sync::Notify;
use tokio::task::AbortHandle;
use tokio::time::{sleep_until, timeout};

use self::goals::Goals;
pub(in crate::ros2) use self::retired::Retired;
use self::retired::{Guard, Keeping, take_over};
use super::messages::{self, CancelCode, Status};
use super::{GoalId, Parts, QUEUE};
use crate::bus::{
    ActionHandler, ActionServer, BusError, GoalEnd, Outcome, ServiceHandler, ServiceType, WireType,
};
use crate::codec::{Time, default_message};
use crate::ros2::bus::Inner;
use crate::ros2::raw::{self, RawWriter};
use crate::ros2::{names, services};
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
    of: Arc<ActionDef>,
    handler: Arc<dyn ActionHandler>,
    goals: Mutex<Goals>,
    feedback: RawWriter,
    status: RawWriter,
    /// Held while statuses are told, so that the last ones told are the last that there were.
    telling: Mutex<()>,
    /// A goal has ended.
    ended: Notify,
    /// Somebody has asked for a result.
    asked: Notify,
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
        let feedback = EndpointQos {
            history: History::KeepLast(QUEUE),
            ..EndpointQos::default()
        };
        let status = EndpointQos {
            durability: Durability::TransientLocal,
            history: History::KeepLast(1),
            ..EndpointQos::default()
        };
        let writer = |(topic, of): (String, WireType), qos| {
            Ok::<_, BusError>(raw::writer(bus, &names::topic(&topic, &of)?, qos))
        };
        let shared = Arc::new(Shared {
            bus: bus.clone(),
            name: name.to_owned(),
            of: of.clone(),
            handler,
            goals: Mutex::default(),
            feedback: writer(parts.feedback, feedback)?,
            status: writer(parts.status, status)?,
            telling: Mutex::default(),
            ended: Notify::new(),
            asked: Notify::new(),
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
        shared.tell_statuses();
        let task = bus.spawn(forget(shared.clone()));
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
        let under_way = {
            let mut goals = self.shared.goals.lock();
            goals.close();
            goals.under_way()
        };
        for id in &under_way {
            self.shared.end(*id, Outcome::Aborted, &[]);
        }
        if !under_way.is_empty() {
            self.shared.tell_statuses();
        }
        let asked = self.shared.goals.lock().are_asked_for();
        if let Some(guard) = self.get_result.take().filter(|_| !asked) {
            let shared = self.shared.clone();
            let keeping = Keeping::of(&shared.bus, &shared.name, guard);
            self.shared.bus.spawn(async move {
                let _ = timeout(LINGER, shared.all_asked_for()).await;
                drop(keeping);
            });
        }
    }
}

impl ActionServer for Server {
    fn feedback(&self, id: &str, feedback: Bytes) -> bool {
        let shared = &self.shared;
        let id = GoalId::parse(id).filter(|id| shared.goals.lock().is_under_way(*id));
        let Some(id) = id else {
            return false;
        };
        match messages::with_id(id, &shared.of.feedback, &feedback) {
            Some(message) => shared.feedback.write(message),
            None => {
                let (action, expected) = (&shared.name, shared.of.feedback.name());
                tracing::debug!(action, expected, "feedback of another type is left out");
            }
        }
        true
    }

    fn end(&self, id: &str, end: GoalEnd) -> bool {
        let id = GoalId::parse(id);
        let ended = id.is_some_and(|id| self.shared.end(id, end.outcome, &end.result));
        if ended {
            self.shared.tell_statuses();
        }
        ended
    }
}

impl Shared {
    /// Has the goal carried out, or says why not.
    fn take(&self, id: GoalId, goal: Bytes, accepted: Time) -> Result<(), String> {
        self.goals.lock().begin(id, accepted)?;
        let taken = self.handler.goal(&id.to_string(), goal);
        let mut goals = self.goals.lock();
        match taken {
            Ok(()) => goals.taken(id),
            Err(_) => goals.refused(id),
        }
        taken
    }

    /// False where there is no such goal under way. A goal cannot have succeeded without a result.
    fn end(&self, id: GoalId, outcome: Outcome, result: &[u8]) -> bool {
        let of = &self.of.result;
        let mut status = match outcome {
            Outcome::Succeeded => Status::Succeeded,
            Outcome::Canceled => Status::Canceled,
            Outcome::Aborted | Outcome::Rejected | Outcome::Unknown => Status::Aborted,
        };
        let answer = messages::write_result(status, of, result).unwrap_or_else(|| {
            if status == Status::Succeeded {
                let (action, expected) = (&self.name, of.name());
                tracing::warn!(action, expected, "a result of another type aborts its goal");
                status = Status::Aborted;
            }
            self.nothing(status)
        });
        let ended = self.goals.lock().end(id, status, answer, Instant::now());
        self.ended.notify_one();
        ended
    }

    /// Returns once somebody has asked for each result.
    async fn all_asked_for(&self) {
        while !self.goals.lock().are_asked_for() {
            self.asked.notified().await;
        }
    }

    /// A result of defaults.
    fn nothing(&self, status: Status) -> Bytes {
        let nothing = default_message(&self.of.result);
        messages::write_result(status, &self.of.result, &nothing).unwrap_or_default()
    }

    fn tell_statuses(&self) {
        let _telling = self.telling.lock();
        let statuses = self.goals.lock().statuses();
        self.status.write(messages::write_statuses(&statuses));
    }
}

/// Forgets results that nobody has asked for in time.
async fn forget(shared: Arc<Shared>) {
    loop {
        let next = shared.goals.lock().next_expiry();
        match next {
            Some(next) => sleep_until(next.into()).await,
            None => shared.ended.notified().await,
        }
        let forgot = shared.goals.lock().expire(Instant::now());
        if forgot {
            shared.tell_statuses();
        }
    }
}

/// What cannot be read is refused: a service of ROS 2 has no other way to say so.
struct SendGoal(Arc<Shared>);

#[async_trait]
impl ServiceHandler for SendGoal {
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, String> {
        let shared = &self.0;
        let (accepted, action) = (Time::now(), &shared.name);
        let id = messages::read_id(&request).filter(|id| *id != GoalId::NONE);
        let goal = messages::behind_id(&shared.of.goal, &request);
        let taken = match id.zip(goal) {
            Some((id, goal)) => shared.take(id, goal, accepted),
            None => Err(format!(
                "it is no serialized {}",
                shared.of.action_goal.name()
            )),
        };
        match &taken {
            Ok(()) => shared.tell_statuses(),
            Err(reason) => tracing::debug!(action, caller, reason, "a goal is refused"),
        }
        Ok(messages::write_accepted(taken.is_ok(), accepted))
    }
}

/// Answers once the goal has ended.
struct GetResult(Arc<Shared>);

#[async_trait]
impl ServiceHandler for GetResult {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, String> {
        let id = messages::read_id(&request);
        let answer = id.and_then(|id| self.0.goals.lock().answer(id));
        self.0.asked.notify_one();
        if let Some(mut answer) = answer {
            // Without its sender the goal was refused meanwhile.
            if let Ok(ended) = answer.wait_for(Option::is_some).await {
                return Ok(ended.clone().unwrap_or_default());
            }
        }
        Ok(self.0.nothing(Status::Unknown))
    }
}

struct CancelGoal(Arc<Shared>);

#[async_trait]
impl ServiceHandler for CancelGoal {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, String> {
        let shared = &self.0;
        let Some(wanted) = messages::read_cancel(&request) else {
            return Ok(messages::write_cancelled(CancelCode::Rejected, &[]));
        };
        let cancelled = shared.goals.lock().cancel(wanted);
        if !cancelled.newly.is_empty() {
            shared.tell_statuses();
        }
        for id in &cancelled.newly {
            shared.handler.cancel(&id.to_string());
        }
        Ok(messages::write_cancelled(
            cancelled.code,
            &cancelled.canceling,
        ))
    }
}
