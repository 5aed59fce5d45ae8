//! What a robot asks of its servant, and what it is answered, told to whoever compares a candidate with the servant: a [`Bus`] like
//! the one behind it, before which the bridge and the links stand. Calls and goals pass as they are; whoever listens is told of
//! them by a queue that never makes them wait. Topics need none of this: they are heard by subscribing.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use parking_lot::{Mutex, RwLock};
use ros::bus::{
    ActionClient, ActionHandler, ActionServer, Bus, BusError, Digest, GlobalParameters, GoalEnd,
    GoalEvents, Graph, Hearing, Lending, NodeParameters, Outcome, Publisher, Qos, RosVersion,
    ServiceHandler, ServiceType, Subscription, WireType,
};
use ros::ros2::names;
use ros::schema::ActionDef;
use tokio::sync::{mpsc, watch};

/// What waits for whoever listens; more is left out, and counted.
const QUEUE: usize = 1024;

/// What a robot asks, or is answered.
#[derive(Debug)]
pub struct Tapped {
    /// The same of what is asked and of its answer.
    pub number: u64,
    /// When it happened.
    pub at: Instant,
    /// What happens.
    pub what: What,
}

/// What happens to a call or a goal.
#[derive(Debug)]
pub enum What {
    /// A call goes to a service.
    Call {
        /// Its name.
        service: String,
        /// Serialized.
        request: Bytes,
    },
    /// A goal goes to an action.
    Goal {
        /// Its name.
        action: String,
        /// Its definition.
        of: Arc<ActionDef>,
        /// Serialized.
        goal: Bytes,
    },
    /// The goal is to end.
    Cancel,
    /// The robot was answered, after so long; what is not told of any more has no answer that could be compared.
    Answered {
        /// What it was answered.
        answer: Answer,
        /// Since it was asked.
        took: Duration,
    },
}

/// What was answered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// A response, or a result with how its goal ended.
    Given(Option<Outcome>, Bytes),
    /// The reason why there is none.
    Refused(String),
    /// Whoever asked did not wait for it.
    GivenUp,
}

impl Answer {
    /// Of a call.
    pub fn of_call(response: &Result<Bytes, BusError>) -> Answer {
        match response {
            Ok(response) => Answer::Given(None, response.clone()),
            Err(error) => Answer::Refused(error.to_string()),
        }
    }

    /// Of a goal.
    pub fn of_goal(end: &Result<GoalEnd, String>) -> Answer {
        match end {
            Ok(end) => Answer::Given(Some(end.outcome), end.result.clone()),
            Err(reason) => Answer::Refused(reason.clone()),
        }
    }

    /// The same, its bytes counted; none where they may not be held.
    fn counted(self, budget: &Budget) -> Option<Answer> {
        match self {
            Answer::Given(outcome, bytes) => {
                let permit = budget.take(bytes.len()).ok()?;
                Some(Answer::Given(outcome, permit.around(bytes)))
            }
            other => Some(other),
        }
    }
}

/// Where whoever compares listens to one servant's robot.
#[derive(Default)]
pub struct Tap {
    listener: RwLock<Option<Listener>>,
    numbers: AtomicU64,
}

#[derive(Clone)]
struct Listener {
    told: mpsc::Sender<Tapped>,
    budget: Budget,
    left_out: Arc<AtomicU64>,
}

/// Listens until it is dropped.
pub struct Tapping {
    /// What happens from now on.
    pub told: mpsc::Receiver<Tapped>,
    tap: Arc<Tap>,
    left_out: Arc<AtomicU64>,
}

impl Tapping {
    /// So much was left out: the queue was full, or the budget.
    pub fn left_out(&self) -> u64 {
        self.left_out.load(Ordering::Relaxed)
    }
}

impl Drop for Tapping {
    fn drop(&mut self) {
        *self.tap.listener.write() = None;
    }
}

impl Tap {
    /// Listens from now on; what is told is held in `budget`. None where somebody does.
    pub fn listen(self: &Arc<Self>, budget: &Budget) -> Option<Tapping> {
        let mut listener = self.listener.write();
        if listener.is_some() {
            return None;
        }
        let (sender, told) = mpsc::channel(QUEUE);
        let left_out = Arc::<AtomicU64>::default();
        *listener = Some(Listener {
            told: sender,
            budget: budget.clone(),
            left_out: Arc::clone(&left_out),
        });
        Some(Tapping {
            told,
            tap: Arc::clone(self),
            left_out,
        })
    }

    /// `bus`, with whoever listens here being told of its calls and goals.
    pub fn before(self: &Arc<Self>, bus: Arc<dyn Bus>) -> Arc<dyn Bus> {
        Arc::new(TappedBus {
            bus,
            tap: Arc::clone(self),
        })
    }

    /// Tells of something that is asked, if anybody listens.
    fn asked(&self, content: &Bytes, what: impl FnOnce(Bytes) -> What) -> Option<Noted> {
        let listener = self.listener.read().clone()?;
        let number = self.numbers.fetch_add(1, Ordering::Relaxed);
        let Ok(permit) = listener.budget.take(content.len()) else {
            listener.left_out.fetch_add(1, Ordering::Relaxed);
            return None;
        };
        let what = what(permit.around(content.clone()));
        listener.tell(number, what).then(|| Noted {
            listener,
            number,
            asked: Instant::now(),
            answered: false,
        })
    }
}

impl Listener {
    fn tell(&self, number: u64, what: What) -> bool {
        let at = Instant::now();
        let told = self.told.try_send(Tapped { number, at, what }).is_ok();
        if !told {
            self.left_out.fetch_add(1, Ordering::Relaxed);
        }
        told
    }
}

/// Something that was asked and has no answer yet.
struct Noted {
    listener: Listener,
    number: u64,
    asked: Instant,
    answered: bool,
}

impl Noted {
    fn answered(mut self, answer: Answer) {
        self.tell(answer);
    }

    fn tell(&mut self, answer: Answer) {
        self.answered = true;
        let took = self.asked.elapsed();
        match answer.counted(&self.listener.budget) {
            Some(answer) => drop(
                self.listener
                    .tell(self.number, What::Answered { answer, took }),
            ),
            None => {
                self.listener.left_out.fetch_add(1, Ordering::Relaxed);
                let answer = Answer::GivenUp;
                self.listener
                    .tell(self.number, What::Answered { answer, took });
            }
        }
    }
}

impl Drop for Noted {
    fn drop(&mut self) {
        if !self.answered {
            self.tell(Answer::GivenUp);
        }
    }
}

struct TappedBus {
    bus: Arc<dyn Bus>,
    tap: Arc<Tap>,
}

impl TappedBus {
    fn call_begins(&self, service: &str, request: &Bytes) -> Option<Noted> {
        // A part of an action of ROS 2: what it answers has stamps in it, and a goal is not compared by its parts.
        if self.bus.version() == RosVersion::Two && names::is_hidden(service) {
            return None;
        }
        self.tap.asked(request, |request| What::Call {
            service: service.to_owned(),
            request,
        })
    }
}

#[async_trait]
impl Bus for TappedBus {
    fn version(&self) -> RosVersion {
        self.bus.version()
    }

    async fn distribution(&self) -> String {
        self.bus.distribution().await
    }

    fn node(&self) -> &str {
        self.bus.node()
    }

    fn graph(&self) -> watch::Receiver<Arc<Graph>> {
        self.bus.graph()
    }

    async fn subscribe(
        &self,
        topic: &str,
        of: WireType,
        qos: Qos,
    ) -> Result<Subscription, BusError> {
        self.bus.subscribe(topic, of, qos).await
    }

    async fn advertise(
        &self,
        topic: &str,
        of: WireType,
        qos: Qos,
    ) -> Result<Box<dyn Publisher>, BusError> {
        self.bus.advertise(topic, of, qos).await
    }

    async fn call(
        &self,
        service: &str,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        let noted = self.call_begins(service, &request);
        let response = self.bus.call(service, request, timeout).await;
        if let Some(noted) = noted {
            noted.answered(Answer::of_call(&response));
        }
        response
    }

    async fn call_typed(
        &self,
        service: &str,
        digest: &Digest,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        let noted = self.call_begins(service, &request);
        let response = self.bus.call_typed(service, digest, request, timeout).await;
        if let Some(noted) = noted {
            noted.answered(Answer::of_call(&response));
        }
        response
    }

    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError> {
        self.bus.service_type(service).await
    }

    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError> {
        self.bus.topic_type(topic).await
    }

    async fn serve(
        &self,
        service: &str,
        service_type: ServiceType,
        handler: Arc<dyn ServiceHandler>,
    ) -> Result<Box<dyn Send + Sync>, BusError> {
        self.bus.serve(service, service_type, handler).await
    }

    fn action_client(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
    ) -> Result<Box<dyn ActionClient>, BusError> {
        Ok(Box::new(TappedClient {
            client: self.bus.action_client(action, of)?,
            action: action.to_owned(),
            of: Arc::clone(of),
            tap: Arc::clone(&self.tap),
            under_way: Arc::default(),
        }))
    }

    fn serve_action(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError> {
        self.bus.serve_action(action, of, handler)
    }

    fn parameters(&self) -> Result<&dyn GlobalParameters, BusError> {
        self.bus.parameters()
    }

    fn node_parameters(&self) -> Result<&dyn NodeParameters, BusError> {
        self.bus.node_parameters()
    }

    fn lending(&self) -> Result<&dyn Lending, BusError> {
        self.bus.lending()
    }

    fn hearing(&self) -> Option<&dyn Hearing> {
        self.bus.hearing()
    }

    fn shutdown_requested(&self) -> Option<watch::Receiver<Option<String>>> {
        self.bus.shutdown_requested()
    }

    fn process_ended(&self) {
        self.bus.process_ended();
    }

    async fn close(&self) {
        self.bus.close().await;
    }
}

/// Goals that somebody was told of, by their ids.
type UnderWay = Arc<Mutex<HashMap<String, Noted>>>;

struct TappedClient {
    client: Box<dyn ActionClient>,
    action: String,
    of: Arc<ActionDef>,
    tap: Arc<Tap>,
    under_way: UnderWay,
}

#[async_trait]
impl ActionClient for TappedClient {
    async fn ready(&self, patience: Duration) -> Result<(), BusError> {
        self.client.ready(patience).await
    }

    fn send(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        let noted = self.tap.asked(&goal, |goal| What::Goal {
            action: self.action.clone(),
            of: Arc::clone(&self.of),
            goal,
        });
        let Some(noted) = noted else {
            return self.client.send(id, goal, events);
        };
        self.under_way.lock().insert(id.to_owned(), noted);
        let events = Arc::new(TappedEvents {
            events,
            id: id.to_owned(),
            under_way: Arc::clone(&self.under_way),
        });
        self.client.send(id, goal, events);
    }

    fn cancel(&self, id: &str) {
        if let Some(noted) = self.under_way.lock().get(id) {
            noted.listener.tell(noted.number, What::Cancel);
        }
        self.client.cancel(id);
    }
}

struct TappedEvents {
    events: Arc<dyn GoalEvents>,
    id: String,
    under_way: UnderWay,
}

impl GoalEvents for TappedEvents {
    fn accepted(&self) {
        self.events.accepted();
    }

    fn cancel_answered(&self, ends: bool) {
        self.events.cancel_answered(ends);
    }

    fn feedback(&self, feedback: Bytes) {
        self.events.feedback(feedback);
    }

    fn ended(&self, end: Result<GoalEnd, String>) {
        let noted = self.under_way.lock().remove(&self.id);
        if let Some(noted) = noted {
            noted.answered(Answer::of_goal(&end));
        }
        self.events.ended(end);
    }
}
