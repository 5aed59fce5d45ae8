//! Goals that this side has sent: each has a task, which asks for it to be taken and then for its result.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use rtps::{EndpointQos, Guid, History};
use tokio::sync::{mpsc, watch};
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};

use super::messages::{self, GoalInfo, Status};
use super::{GoalId, Parts, QUEUE};
use crate::bus::{
    ActionClient, BusError, CallFate, GoalEnd, GoalEvents, Message, MessageReceiver, MessageSender,
    Outcome, PeerId, ServiceType, WireType, message_queue,
};
use crate::codec::{Time, default_message};
use crate::ros2::bus::Inner;
use crate::ros2::client::Client as ServiceClient;
use crate::ros2::raw::{self, Ear, RawReader};
use crate::ros2::{calls, names};
use crate::schema::ActionDef;

/// A server may not say that it knows our reader of feedback; then it is taken to do so after this time.
const UNSURE: Duration = Duration::from_millis(200);
/// For a server that was there a moment ago.
const GRACE: Duration = Duration::from_secs(3);
/// How long a server has to answer that it ends a goal, or to take one that nobody waits for any more.
const CANCEL_WAITS: Duration = Duration::from_secs(10);
/// As long as the server is there.
const FOREVER: Duration = Duration::MAX;
const CLOSED: &str = "the connection to this ROS system was closed";

/// One action.
pub(in crate::ros2) struct Client {
    shared: Arc<Shared>,
    task: AbortHandle,
}

struct Shared {
    bus: Arc<Inner>,
    name: String,
    of: Arc<ActionDef>,
    send_goal: Arc<ServiceClient>,
    get_result: Arc<ServiceClient>,
    cancel_goal: Arc<ServiceClient>,
    feedback: RawReader,
    goals: Mutex<Goals>,
    /// To the task that tells of everything, so that it is told in order.
    ended: mpsc::UnboundedSender<Ended>,
}

type Ended = (GoalId, Result<GoalEnd, String>);

#[derive(Default)]
struct Goals {
    under_way: HashMap<GoalId, Goal>,
    /// What those who have sent them call them.
    named: HashMap<String, GoalId>,
}

struct Goal {
    name: String,
    events: Arc<dyn GoalEvents>,
    wish: watch::Sender<Wish>,
}

/// What whoever has sent a goal wants of it.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Wish {
    GoOn,
    /// It should end.
    Cancel,
    /// It should end, and nobody waits for it any more.
    Abandon,
}

impl Goals {
    fn remove(&mut self, id: GoalId) -> Option<Goal> {
        let goal = self.under_way.remove(&id)?;
        self.named.remove(&goal.name);
        Some(goal)
    }
}

impl Client {
    /// Opens the action's parts; servers are found in the background.
    pub(in crate::ros2) fn open(
        bus: &Arc<Inner>,
        name: &str,
        of: &Arc<ActionDef>,
    ) -> Result<Self, BusError> {
        bus.check_open()?;
        let parts = Parts::of(name, of)?;
        let client = |(service, of): (String, ServiceType)| calls::client(bus, &service, &of);
        let (queue, feedback) = message_queue(QUEUE as usize);
        let (topic, wire_type) = parts.feedback;
        let topic = names::topic(&topic, &wire_type)?;
        let ear = Arc::new(Feedback {
            queue,
            wire_type: Arc::new(wire_type),
            publisher: PeerId::from(name),
        });
        let qos = EndpointQos {
            history: History::KeepLast(QUEUE),
            ..EndpointQos::default()
        };
        let (sender, ended) = mpsc::unbounded_channel();
        let shared = Arc::new(Shared {
            bus: bus.clone(),
            name: name.to_owned(),
            of: of.clone(),
            send_goal: client(parts.send_goal)?,
            get_result: client(parts.get_result)?,
            cancel_goal: client(parts.cancel_goal)?,
            feedback: raw::reader(bus, &topic, qos, ear),
            goals: Mutex::default(),
            ended: sender,
        });
        let task = bus.spawn(follow(Closing(shared.clone()), feedback, ended));
        Ok(Self { shared, task })
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.task.abort();
        let goals = std::mem::take(&mut *self.shared.goals.lock());
        for goal in goals.under_way.into_values() {
            goal.wish.send_replace(Wish::Abandon);
        }
    }
}

#[async_trait]
impl ActionClient for Client {
    async fn ready(&self, patience: Duration) -> Result<(), BusError> {
        let shared = &self.shared;
        let ready = async {
            tokio::try_join!(
                shared.send_goal.ready(patience),
                shared.get_result.ready(patience),
                shared.cancel_goal.ready(patience),
            )?;
            shared.hears_feedback().await;
            Ok(())
        };
        match timeout(patience, ready).await {
            Ok(Err(BusError::Timeout { .. })) | Err(_) => Err(BusError::Timeout {
                what: format!("action {}", shared.name),
                after: patience,
            }),
            Ok(Err(of_part @ BusError::TypeMismatch { .. })) => {
                Err(shared.other_type().unwrap_or(of_part))
            }
            Ok(ready) => ready,
        }
    }

    fn send(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        let shared = &self.shared;
        let uuid = GoalId::parse(id).unwrap_or_else(GoalId::random);
        let Some(request) = messages::with_id(uuid, &shared.of.goal, &goal) else {
            let reason = format!("the goal is no serialized {}", shared.of.goal.name());
            return events.ended(Err(reason));
        };
        let (wish, wished) = watch::channel(Wish::GoOn);
        let known = Goal {
            name: id.to_owned(),
            events: events.clone(),
            wish,
        };
        {
            let mut goals = shared.goals.lock();
            if goals.named.contains_key(id) || goals.under_way.contains_key(&uuid) {
                drop(goals);
                return events.ended(Err(format!("a goal with id {id} is under way already")));
            }
            goals.named.insert(id.to_owned(), uuid);
            goals.under_way.insert(uuid, known);
        }
        let carrying = shared.clone();
        shared.bus.spawn(async move {
            let end = carrying.carry_out(uuid, request, wished).await;
            // Nobody hears of it where the client was dropped meanwhile.
            let _ = carrying.ended.send((uuid, end));
        });
        if shared.bus.check_open().is_err() {
            shared.end(uuid, Err(CLOSED.to_owned()));
        }
    }

    /// The server hears of it as soon as it has taken the goal.
    fn cancel(&self, id: &str) {
        let goals = self.shared.goals.lock();
        let goal = goals.named.get(id).and_then(|id| goals.under_way.get(id));
        if let Some(goal) = goal {
            goal.wish.send_replace(Wish::Cancel);
        }
    }
}

impl Shared {
    /// Returns once a server's feedback comes here. That of a server of this node does as soon as there is one.
    async fn hears_feedback(&self) {
        if self.feedback.hears_own() {
            return;
        }
        let mut ends = self.feedback.ends();
        drop(ends.wait_for(|ends| !ends.matched.is_empty()).await);
        let is_sure = ends.wait_for(|ends| !ends.confirmed.is_empty());
        drop(timeout(UNSURE, is_sure).await);
    }

    /// That its server has another type, by the action's name: that of a part is `Fibonacci_SendGoal`.
    fn other_type(&self) -> Option<BusError> {
        let services = self.of.services.as_ref()?;
        let parts = [
            (&self.send_goal, &services.send_goal),
            (&self.get_result, &services.get_result),
        ];
        parts.into_iter().find_map(|(part, ours)| {
            let of_action = |of: ServiceType| {
                let name = of
                    .name
                    .rsplit_once('_')
                    .map(|(action, _)| action.to_owned());
                ServiceType {
                    name: name.unwrap_or_default(),
                    ..of
                }
            };
            let theirs = of_action(part.other_type()?);
            let what = format!("action {}", self.name);
            Some(theirs.not(&of_action(ServiceType::of(ours)), what))
        })
    }

    async fn carry_out(
        &self,
        id: GoalId,
        request: Bytes,
        mut wished: watch::Receiver<Wish>,
    ) -> Result<GoalEnd, String> {
        let taken = tokio::select! {
            taken = self.ask(&self.send_goal, request) => taken?,
            // It may be taken all the same, and is to be cancelled then.
            () = abandoned_for(CANCEL_WAITS, wished.clone()) => return Err(CLOSED.to_owned()),
        };
        match messages::read_accepted(&taken) {
            Some(true) => self.tell_accepted(id),
            Some(false) => return Ok(self.rejected()),
            None => return Err(format!("action {} answers what cannot be read", self.name)),
        }
        tokio::select! {
            result = self.ask(&self.get_result, messages::write_id(id)) => self.end_of(&result?),
            () = self.pass_on(id, &mut wished) => Err(CLOSED.to_owned()),
        }
    }

    async fn ask(&self, part: &ServiceClient, request: Bytes) -> Result<Bytes, String> {
        // A call would wait for one that comes later, which is not to be given an old goal.
        let mut servers = part.servers();
        let there = servers.wait_for(|servers| servers.count() > 0);
        if timeout(GRACE, there).await.is_err() {
            return Err(format!("action {} has no server", self.name));
        }
        let answer = part.call(request, FOREVER).await;
        answer.map_err(|error| match error {
            BusError::CallFailed {
                fate: CallFate::Unknown,
                ..
            } => format!("action server {} is gone", self.name),
            other => other.to_string(),
        })
    }

    /// Has the goal cancelled each time that it is wanted; returns when it is abandoned.
    async fn pass_on(&self, id: GoalId, wished: &mut watch::Receiver<Wish>) {
        loop {
            let wish = *wished.borrow_and_update();
            if wish != Wish::GoOn {
                self.ask_to_cancel(id).await;
            }
            if wish == Wish::Abandon || wished.changed().await.is_err() {
                return;
            }
        }
    }

    /// One that has ended meanwhile, or that its server wants to finish, is not cancelled.
    async fn ask_to_cancel(&self, id: GoalId) {
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
        if let Some(events) = self.events(id) {
            events.cancel_answered(ends);
        }
    }

    fn rejected(&self) -> GoalEnd {
        GoalEnd {
            outcome: Outcome::Rejected,
            text: String::new(),
            result: default_message(&self.of.result).into(),
        }
    }

    fn end_of(&self, answer: &[u8]) -> Result<GoalEnd, String> {
        let Some((status, result)) = messages::read_result(&self.of.result, answer) else {
            return Err(format!("the result of action {} cannot be read", self.name));
        };
        let outcome = match status {
            Some(Status::Succeeded) => Outcome::Succeeded,
            Some(Status::Canceled) => Outcome::Canceled,
            Some(Status::Aborted) => Outcome::Aborted,
            Some(Status::Unknown) => {
                return Err("the action server no longer knows the goal".to_owned());
            }
            _ => Outcome::Unknown,
        };
        Ok(GoalEnd {
            outcome,
            text: String::new(),
            result,
        })
    }

    fn events(&self, id: GoalId) -> Option<Arc<dyn GoalEvents>> {
        let goals = self.goals.lock();
        goals.under_way.get(&id).map(|goal| goal.events.clone())
    }

    fn tell_accepted(&self, id: GoalId) {
        if let Some(events) = self.events(id) {
            events.accepted();
        }
    }

    fn tell_feedback(&self, bytes: &[u8]) {
        let Some(id) = messages::read_id(bytes) else {
            return;
        };
        let events = self.events(id);
        let feedback = messages::behind_id(&self.of.feedback, bytes);
        if let (Some(events), Some(feedback)) = (events, feedback) {
            events.feedback(feedback);
        }
    }

    fn end(&self, id: GoalId, end: Result<GoalEnd, String>) {
        let goal = self.goals.lock().remove(id);
        if let Some(goal) = goal {
            goal.events.ended(end);
        }
    }
}

/// Returns when nobody has waited for the goal for so long.
async fn abandoned_for(long: Duration, mut wished: watch::Receiver<Wish>) {
    // Without its sender nobody waits either.
    drop(wished.wait_for(|wish| *wish == Wish::Abandon).await);
    sleep(long).await;
}

/// Tells how goals get on. What a server said of a goal before it ended has come before its result.
async fn follow(
    closing: Closing,
    mut feedback: MessageReceiver,
    mut ended: mpsc::UnboundedReceiver<Ended>,
) {
    let shared = &closing.0;
    loop {
        tokio::select! {
            Some(message) = feedback.recv() => shared.tell_feedback(&message.bytes),
            Some((id, end)) = ended.recv() => {
                for _ in 0..feedback.len() {
                    if let Some(message) = feedback.try_recv() {
                        shared.tell_feedback(&message.bytes);
                    }
                }
                shared.end(id, end);
            }
            else => return,
        }
    }
}

/// When nothing more will be heard, all goals that are still under way have ended for who has sent them.
struct Closing(Arc<Shared>);

impl Drop for Closing {
    fn drop(&mut self) {
        let goals = std::mem::take(&mut *self.0.goals.lock());
        for goal in goals.under_way.into_values() {
            goal.events.ended(Err(CLOSED.to_owned()));
        }
    }
}

/// Takes feedback while the participant is at work; it is told of later.
struct Feedback {
    queue: MessageSender,
    wire_type: Arc<WireType>,
    publisher: PeerId,
}

impl Ear for Feedback {
    fn hear(&self, payload: Bytes, _writer: Guid) {
        self.queue.send(Message {
            bytes: payload,
            wire_type: self.wire_type.clone(),
            publisher: self.publisher.clone(),
            latching: false,
        });
    }
}
