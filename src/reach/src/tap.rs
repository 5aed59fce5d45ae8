//! Reports a robot's requests and their responses to a listener that compares a candidate with the servant. The tap is
//! a [`Bus`] in front of the actual one, used by the bridge and the links. Calls and goals pass unchanged; the listener
//! receives them through a queue that never blocks them. Topics need no tap, because they can be subscribed to.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use parking_lot::{Mutex, RwLock};
use ros::bus::{
    ActionClient, ActionHandler, ActionServer, Bus, BusError, Digest, GlobalParameters, GoalEnd, GoalError, GoalEvents,
    GoalOutcome, Graph, Lending, NodeParameters, Offer, Publisher, PublisherReports, QosProfile, RosVersion,
    ServiceHandler, ServiceType, Subscription, WireType,
};
use ros::ros2::names;
use ros::schema::ActionDef;
use tokio::sync::{mpsc, watch};

/// Length of the listener's queue; the excess is omitted and counted.
const QUEUE: usize = 1024;

/// A request of a robot or the response to it.
#[derive(Debug)]
pub struct TapEvent {
    /// Number that a request and its response have in common.
    pub number: u64,
    /// Time of the event.
    pub at: Instant,
    /// The event.
    pub what: TapEventKind,
}

/// An event of a call or goal.
#[derive(Debug)]
pub enum TapEventKind {
    /// A service is called.
    Call {
        /// Name of the service.
        service: String,
        /// Serialized request.
        request: Bytes,
    },
    /// A goal is sent to an action.
    Goal {
        /// Name of the action.
        action: String,
        /// Definition of the action.
        of: Arc<ActionDef>,
        /// Serialized goal.
        goal: Bytes,
    },
    /// The goal is to be cancelled.
    Cancel,
    /// The robot got a response. A request without this event has no response that could be compared.
    Answered {
        /// The response.
        answer: TapAnswer,
        /// Response time.
        took: Duration,
    },
}

/// Response to a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TapAnswer {
    /// A response, or a result with the outcome of its goal.
    Given(Option<GoalOutcome>, Bytes),
    /// Reason why there is none.
    Refused(String),
    /// The caller did not wait for it.
    GivenUp,
}

impl TapAnswer {
    /// Creates the answer of a call.
    pub fn from_call(response: &Result<Bytes, BusError>) -> TapAnswer {
        match response {
            Ok(response) => TapAnswer::Given(None, response.clone()),
            Err(error) => TapAnswer::Refused(error.to_string()),
        }
    }

    /// Creates the answer of a goal.
    pub fn from_goal(end: &Result<GoalEnd, GoalError>) -> TapAnswer {
        match end {
            Ok(end) => TapAnswer::Given(Some(end.outcome), end.result.clone()),
            Err(error) => TapAnswer::Refused(error.to_string()),
        }
    }

    /// Charges its bytes to the budget; returns `None` if they do not fit.
    fn charge(self, budget: &Budget) -> Option<TapAnswer> {
        match self {
            TapAnswer::Given(outcome, bytes) => {
                let permit = budget.take(bytes.len()).ok()?;
                Some(TapAnswer::Given(outcome, permit.wrap_bytes(bytes)))
            }
            other => Some(other),
        }
    }
}

/// The tap on one servant's robot.
#[derive(Default)]
pub struct Tap {
    listener: RwLock<Option<TapListener>>,
    numbers: AtomicU64,
}

#[derive(Clone)]
struct TapListener {
    told: mpsc::Sender<TapEvent>,
    budget: Budget,
    left_out: Arc<AtomicU64>,
}

/// Listens until it is dropped.
pub struct TapReceiver {
    /// Events from now on.
    pub told: mpsc::Receiver<TapEvent>,
    tap: Arc<Tap>,
    left_out: Arc<AtomicU64>,
}

impl TapReceiver {
    /// Returns the number of events omitted because the queue or the budget was full.
    pub fn omitted_count(&self) -> u64 {
        self.left_out.load(Ordering::Relaxed)
    }
}

impl Drop for TapReceiver {
    fn drop(&mut self) {
        *self.tap.listener.write() = None;
    }
}

impl Tap {
    /// Starts listening; events are charged to `budget`. Returns `None` if there already is a listener.
    pub fn listen(self: &Arc<Self>, budget: &Budget) -> Option<TapReceiver> {
        let mut listener = self.listener.write();
        if listener.is_some() {
            return None;
        }
        let (sender, told) = mpsc::channel(QUEUE);
        let left_out = Arc::<AtomicU64>::default();
        *listener = Some(TapListener { told: sender, budget: budget.clone(), left_out: Arc::clone(&left_out) });
        Some(TapReceiver { told, tap: Arc::clone(self), left_out })
    }

    /// Wraps `bus` so that the listener receives its calls and goals.
    pub fn wrap(self: &Arc<Self>, bus: Arc<dyn Bus>) -> Arc<dyn Bus> {
        Arc::new(TappedBus { bus, tap: Arc::clone(self) })
    }

    /// Reports a request, if there is a listener.
    fn begin_exchange(&self, content: &Bytes, what: impl FnOnce(Bytes) -> TapEventKind) -> Option<TapExchange> {
        let listener = self.listener.read().clone()?;
        let number = self.numbers.fetch_add(1, Ordering::Relaxed);
        let Ok(permit) = listener.budget.take(content.len()) else {
            listener.left_out.fetch_add(1, Ordering::Relaxed);
            return None;
        };
        let what = what(permit.wrap_bytes(content.clone()));
        listener.send(number, what).then(|| TapExchange { listener, number, asked: Instant::now(), answered: false })
    }
}

impl TapListener {
    fn send(&self, number: u64, what: TapEventKind) -> bool {
        let at = Instant::now();
        let told = self.told.try_send(TapEvent { number, at, what }).is_ok();
        if !told {
            self.left_out.fetch_add(1, Ordering::Relaxed);
        }
        told
    }
}

/// A request that has no response yet.
struct TapExchange {
    listener: TapListener,
    number: u64,
    asked: Instant,
    answered: bool,
}

impl TapExchange {
    fn answer(mut self, answer: TapAnswer) {
        self.finish(answer);
    }

    fn finish(&mut self, answer: TapAnswer) {
        self.answered = true;
        let took = self.asked.elapsed();
        match answer.charge(&self.listener.budget) {
            Some(answer) => drop(self.listener.send(self.number, TapEventKind::Answered { answer, took })),
            None => {
                self.listener.left_out.fetch_add(1, Ordering::Relaxed);
                let answer = TapAnswer::GivenUp;
                self.listener.send(self.number, TapEventKind::Answered { answer, took });
            }
        }
    }
}

impl Drop for TapExchange {
    fn drop(&mut self) {
        if !self.answered {
            self.finish(TapAnswer::GivenUp);
        }
    }
}

struct TappedBus {
    bus: Arc<dyn Bus>,
    tap: Arc<Tap>,
}

impl TappedBus {
    fn begin_call(&self, service: &str, request: &Bytes) -> Option<TapExchange> {
        // A service of a ROS 2 action: its responses contain stamps, and a goal is not compared by its parts.
        if self.bus.version() == RosVersion::Two && names::is_hidden(service) {
            return None;
        }
        self.tap.begin_exchange(request, |request| TapEventKind::Call { service: service.to_owned(), request })
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

    async fn subscribe(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Subscription, BusError> {
        self.bus.subscribe(topic, of, qos).await
    }

    async fn advertise(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Box<dyn Publisher>, BusError> {
        self.bus.advertise(topic, of, qos).await
    }

    async fn call_typed(
        &self,
        service: &str,
        digest: &Digest,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        let noted = self.begin_call(service, &request);
        let response = self.bus.call_typed(service, digest, request, timeout).await;
        if let Some(noted) = noted {
            noted.answer(TapAnswer::from_call(&response));
        }
        response
    }

    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError> {
        self.bus.service_type(service).await
    }

    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError> {
        self.bus.topic_type(topic).await
    }

    async fn topic_offer(&self, topic: &str) -> Result<Offer, BusError> {
        self.bus.topic_offer(topic).await
    }

    async fn serve(
        &self,
        service: &str,
        service_type: ServiceType,
        handler: Arc<dyn ServiceHandler>,
    ) -> Result<Box<dyn Send + Sync>, BusError> {
        self.bus.serve(service, service_type, handler).await
    }

    fn action_client(&self, action: &str, of: &Arc<ActionDef>) -> Result<Box<dyn ActionClient>, BusError> {
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

    fn publisher_reports(&self) -> Option<&dyn PublisherReports> {
        self.bus.publisher_reports()
    }

    fn shutdown_requested(&self) -> Option<watch::Receiver<Option<String>>> {
        self.bus.shutdown_requested()
    }

    fn on_process_exit(&self) {
        self.bus.on_process_exit();
    }

    async fn close(&self) {
        self.bus.close().await;
    }
}

/// Reported goals by id.
type UnderWay = Arc<Mutex<HashMap<String, TapExchange>>>;

struct TappedClient {
    client: Box<dyn ActionClient>,
    action: String,
    of: Arc<ActionDef>,
    tap: Arc<Tap>,
    under_way: UnderWay,
}

#[async_trait]
impl ActionClient for TappedClient {
    async fn wait_for_server(&self, patience: Duration) -> Result<(), BusError> {
        self.client.wait_for_server(patience).await
    }

    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        let noted = self.tap.begin_exchange(&goal, |goal| TapEventKind::Goal {
            action: self.action.clone(),
            of: Arc::clone(&self.of),
            goal,
        });
        let Some(noted) = noted else {
            return self.client.send_goal(id, goal, events);
        };
        self.under_way.lock().insert(id.to_owned(), noted);
        let events = Arc::new(TappedEvents { events, id: id.to_owned(), under_way: Arc::clone(&self.under_way) });
        self.client.send_goal(id, goal, events);
    }

    fn cancel_goal(&self, id: &str) {
        if let Some(noted) = self.under_way.lock().get(id) {
            noted.listener.send(noted.number, TapEventKind::Cancel);
        }
        self.client.cancel_goal(id);
    }
}

struct TappedEvents {
    events: Arc<dyn GoalEvents>,
    id: String,
    under_way: UnderWay,
}

impl GoalEvents for TappedEvents {
    fn on_waiting(&self) {
        self.events.on_waiting();
    }

    fn on_accepted(&self) {
        self.events.on_accepted();
    }

    fn on_cancel_response(&self, ends: bool) {
        self.events.on_cancel_response(ends);
    }

    fn on_feedback(&self, feedback: Bytes) {
        self.events.on_feedback(feedback);
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        let noted = self.under_way.lock().remove(&self.id);
        if let Some(noted) = noted {
            noted.answer(TapAnswer::from_goal(&end));
        }
        self.events.on_ended(end);
    }
}
