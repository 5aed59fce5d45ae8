//! Groups of servants shared by many robots: each request of a robot is dispatched to one of them ([`dispatch`]), and
//! its response goes to that robot.
//!
//! ```text
//!  robot A ─▶ Bridge, links ─▶ GroupBus A ─┐             ┌─▶ Bus of servant 1
//!                                          ├─ Dispatcher ┤
//!  robot B ─▶ Bridge, links ─▶ GroupBus B ─┘             └─▶ Bus of servant 2
//! ```
//!
//! A robot reaches the group through buses of its own, which show the services and actions of the interface and nothing
//! else: no topic, no parameter, no node of another robot. Its rosbridge clients see the deployer's names, its stubs
//! the names that the nodes would have on the robot. [`shareable`] decides what can be shared.

mod bus;
pub mod dispatch;
mod goals;
mod names;
mod node_ends;
mod nodes;
mod seat;
pub mod shareable;
mod view;

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use bytes::Bytes;
use futures_util::StreamExt;
use futures_util::future::{AbortHandle, Aborted, BoxFuture, abortable};
use futures_util::stream::FuturesUnordered;
use package::interface::Interface;
use parking_lot::Mutex;
use ros::bus::{ActionClient, Bus, BusError, CallFate, Digest, RosVersion};
use ros::schema::ActionDef;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, sleep_until, timeout};

use dispatch::{
    AttemptOutcome, DispatchOrder, Dispatcher, GroupLoad, Kind, LossReason, Member, RobotNumber, Rules, Ticket,
};

use view::GroupView;

pub use seat::open_seat;

/// Minimum pause before a servant that did not take a request is asked again; after it, a change of its graph is
/// awaited.
const PAUSE: Duration = Duration::from_millis(100);
/// Maximum pause, if its graph does not change.
const LONGEST_PAUSE: Duration = Duration::from_secs(1);

/// Minimum time over which the mean load is computed; shorter spans would reflect single requests.
const SPAN: Duration = Duration::from_millis(200);

/// Counters of a group's requests.
#[derive(Debug, Default)]
pub struct GroupCounters {
    /// Requests answered, including by an error of the node.
    pub answered: AtomicU64,
    /// Requests failed because their servant was lost or none was available in time.
    pub failed: AtomicU64,
    /// Requests retried after their servant was lost.
    pub asked_again: AtomicU64,
    /// Number of recent responses timed, and sum of their times in microseconds.
    times: Mutex<(u64, u64)>,
    /// Redundant work of replicas: responses that came second or were abandoned.
    pub wasted: AtomicU64,
}

/// Number of responses over which the mean is computed; older ones count half.
const LATELY: u64 = 200;

impl GroupCounters {
    /// Returns the recent mean response time.
    pub fn mean_response_time(&self) -> Option<Duration> {
        let (count, micros) = *self.times.lock();
        micros.checked_div(count).map(Duration::from_micros)
    }

    fn record_answer(&self, took: Duration) {
        self.answered.fetch_add(1, Ordering::Relaxed);
        let mut times = self.times.lock();
        if times.0 >= LATELY {
            *times = (times.0 / 2, times.1 / 2);
        }
        times.0 += 1;
        times.1 += took.as_micros() as u64;
    }
}

/// The servants of one revision that answer together, and the requests of their robots.
pub struct ServantGroup {
    ros: RosVersion,
    distribution: String,
    interface: Interface,
    /// Parameter values of the nodes when the interface was recorded, by name.
    values: BTreeMap<String, serde_json::Value>,
    state: Mutex<State>,
    members: watch::Sender<BTreeMap<Member, Arc<MemberServant>>>,
    /// View of the interface as it was deployed.
    whole: Arc<GroupView>,
    counts: GroupCounters,
    robots: AtomicU64,
}

/// State protected by one lock.
struct State {
    dispatcher: Dispatcher,
    doors: HashMap<Ticket, mpsc::UnboundedSender<DispatchEvent>>,
    /// Integral of the number of requests over time in microseconds, and the time up to which it was computed.
    busy: (u128, Instant),
    /// Mean number of concurrent requests, and the time up to which it was computed.
    mean: (f64, Instant),
}

/// An event for the owner of a request.
enum DispatchEvent {
    Ask(Arc<MemberServant>),
    Drop(Arc<MemberServant>),
    Fail(LossReason),
}

/// One servant of the group.
struct MemberServant {
    member: Member,
    /// Servant id.
    id: String,
    bus: Arc<dyn Bus>,
    actions: Mutex<HashMap<String, Arc<dyn ActionClient>>>,
    /// Reason why it left.
    gone: OnceLock<String>,
}

impl MemberServant {
    /// Returns a client of the action, which is opened once.
    fn action(&self, name: &str, of: &Arc<ActionDef>) -> Result<Arc<dyn ActionClient>, BusError> {
        let mut actions = self.actions.lock();
        if let Some(known) = actions.get(name) {
            return Ok(Arc::clone(known));
        }
        let opened: Arc<dyn ActionClient> = Arc::from(self.bus.action_client(name, of)?);
        actions.insert(name.to_owned(), Arc::clone(&opened));
        Ok(opened)
    }

    /// Forgets an action that could not be opened; the next user opens it again.
    fn forget_action(&self, name: &str) {
        self.actions.lock().remove(name);
    }
}

impl ServantGroup {
    /// Creates a group without servants for robots of a service with this interface.
    pub fn new(ros: RosVersion, distribution: &str, interface: &Interface, rules: Rules) -> Arc<ServantGroup> {
        let values = interface.parameters.iter().filter_map(|parameter| {
            let value = parameter.value.clone()?;
            Some((parameter.name.clone(), value))
        });
        let values = values.collect();
        let interface = shareable::shared_interface(interface);
        let whole = Arc::new(GroupView::from_interface(ros, &interface));
        let state = State {
            dispatcher: Dispatcher::new(rules),
            doors: HashMap::new(),
            busy: (0, Instant::now()),
            mean: (0.0, Instant::now()),
        };
        Arc::new(ServantGroup {
            ros,
            distribution: distribution.to_owned(),
            interface,
            values,
            state: Mutex::new(state),
            members: watch::Sender::default(),
            whole,
            counts: GroupCounters::default(),
            robots: AtomicU64::new(0),
        })
    }

    /// Adds a servant; returns its number.
    pub fn join(&self, id: &str, bus: Arc<dyn Bus>) -> Member {
        let mut servant = None;
        self.members.send_modify(|members| {
            let member = self.robots.fetch_add(1, Ordering::Relaxed);
            let joins = Arc::new(MemberServant {
                member,
                id: id.to_owned(),
                bus,
                actions: Mutex::default(),
                gone: OnceLock::new(),
            });
            members.insert(member, joins);
            servant = Some(member);
        });
        let member = servant.unwrap_or_default();
        self.decide(|dispatcher| ((), dispatcher.join(member)));
        member
    }

    /// Sends no further requests to a servant, which finishes what it is working on.
    pub fn retire(&self, member: Member) {
        self.decide(|dispatcher| ((), dispatcher.retire(member)));
    }

    /// Sends requests to a retired servant again.
    pub fn reinstate(&self, member: Member) {
        self.decide(|dispatcher| ((), dispatcher.reinstate(member)));
    }

    /// Removes a servant that is gone for this reason.
    pub fn leave(&self, member: Member, reason: &str) {
        let servant = self.members.borrow().get(&member).cloned();
        if let Some(servant) = servant {
            let _ = servant.gone.set(reason.to_owned());
        }
        self.decide(|dispatcher| ((), dispatcher.leave(member)));
        self.members.send_modify(|members| {
            members.remove(&member);
        });
    }

    /// Returns the current load.
    pub fn load(&self) -> GroupLoad {
        self.state.lock().dispatcher.load()
    }

    /// Returns the number of requests a servant is working on.
    pub fn member_load(&self, member: Member) -> usize {
        self.state.lock().dispatcher.member_load(member)
    }

    /// Returns the mean number of concurrent requests since the last call, over at least [`SPAN`]; before that, the
    /// previous value.
    pub fn mean_load(&self) -> f64 {
        let mut state = self.state.lock();
        let now = Instant::now();
        let span = now.saturating_duration_since(state.mean.1);
        if span >= SPAN {
            state.accumulate_load(now);
            let busy = std::mem::take(&mut state.busy.0);
            state.mean = (busy as f64 / span.as_micros() as f64, now);
        }
        state.mean.0
    }

    /// Returns the counters.
    pub fn counts(&self) -> &GroupCounters {
        &self.counts
    }

    /// Updates the dispatcher and delivers the resulting orders.
    fn decide<T>(&self, by: impl FnOnce(&mut Dispatcher) -> (T, Vec<DispatchOrder>)) -> T {
        let mut state = self.state.lock();
        state.accumulate_load(Instant::now());
        let (done, orders) = by(&mut state.dispatcher);
        self.deliver_orders(&mut state, orders);
        done
    }

    fn deliver_orders(&self, state: &mut State, orders: Vec<DispatchOrder>) {
        if orders.is_empty() {
            return;
        }
        let members = self.members.borrow();
        for order in orders {
            let (ticket, told) = match order {
                DispatchOrder::Ask(ticket, member) => match members.get(&member) {
                    Some(servant) => (ticket, DispatchEvent::Ask(Arc::clone(servant))),
                    None => continue,
                },
                DispatchOrder::Drop(ticket, member) => match members.get(&member) {
                    Some(servant) => (ticket, DispatchEvent::Drop(Arc::clone(servant))),
                    None => continue,
                },
                DispatchOrder::Fail(ticket, why) => (ticket, DispatchEvent::Fail(why)),
            };
            if let Some(door) = state.doors.get(&ticket) {
                // An owner that has stopped listening withdraws the request itself.
                let _ = door.send(told);
            }
        }
    }

    /// Queues a request.
    fn begin_request(self: &Arc<Self>, robot: RobotNumber, kind: Kind) -> PendingRequest {
        let (door, told) = mpsc::unbounded_channel();
        let mut state = self.state.lock();
        state.accumulate_load(Instant::now());
        let (ticket, orders) = state.dispatcher.ask(robot, &kind);
        state.doors.insert(ticket, door);
        self.deliver_orders(&mut state, orders);
        drop(state);
        PendingRequest { group: Arc::clone(self), kind, ticket, told, over: false }
    }

    /// Schedules another attempt with a servant that did not take a request or lost it: a restarting node registers its
    /// services again.
    fn resume_later(self: &Arc<Self>, servant: &MemberServant, kind: &Kind) {
        let (group, member, kind) = (Arc::downgrade(self), servant.member, kind.clone());
        let mut graph = servant.bus.graph();
        graph.mark_unchanged();
        tokio::spawn(async move {
            tokio::time::sleep(PAUSE).await;
            let _ = timeout(LONGEST_PAUSE - PAUSE, graph.changed()).await;
            if let Some(group) = group.upgrade() {
                group.decide(|dispatcher| ((), dispatcher.resume(member, &kind)));
            }
        });
    }

    /// Calls a service for a robot at one or more servants and returns the first response.
    async fn call(
        self: &Arc<Self>,
        robot: RobotNumber,
        service: &str,
        digest: &Digest,
        request: Bytes,
        patience: Duration,
    ) -> Result<Bytes, BusError> {
        type Asked<'a> = BoxFuture<'a, Result<(Arc<MemberServant>, Result<Bytes, BusError>), Aborted>>;
        let began = Instant::now();
        let deadline = began + patience;
        let mut errand = self.begin_request(robot, Kind::Call(service.into()));
        let mut asked: FuturesUnordered<Asked<'_>> = FuturesUnordered::new();
        let mut handles: Vec<(Member, AbortHandle)> = Vec::new();
        let mut last: Option<Arc<MemberServant>> = None;
        loop {
            tokio::select! {
                biased;
                Some(ended) = asked.next(), if !asked.is_empty() => {
                    let Ok((servant, answer)) = ended else { continue };
                    if errand.finish_attempt(&servant, classify_outcome(&answer)) {
                        self.counts.record_answer(began.elapsed());
                        return answer;
                    }
                    last = Some(servant);
                }
                Some(told) = errand.told.recv() => match told {
                    DispatchEvent::Ask(servant) => {
                        if last.is_some() {
                            self.counts.asked_again.fetch_add(1, Ordering::Relaxed);
                        }
                        let request = request.clone();
                        let left = deadline.saturating_duration_since(Instant::now());
                        let member = servant.member;
                        let called = async move {
                            let bus = &servant.bus;
                            let answer = bus.call_typed(service, digest, request, left).await;
                            (servant, answer)
                        };
                        let (called, handle) = abortable(called);
                        handles.push((member, handle));
                        asked.push(Box::pin(called));
                    }
                    DispatchEvent::Drop(servant) => {
                        let of = handles.iter().filter(|(member, _)| *member == servant.member);
                        of.for_each(|(_, handle)| handle.abort());
                        last = Some(servant);
                    }
                    DispatchEvent::Fail(why) => {
                        errand.over = true;
                        return Err(self.fail_request(service, last.as_deref(), why));
                    }
                },
                () = sleep_until(deadline) => {
                    self.counts.failed.fetch_add(1, Ordering::Relaxed);
                    return Err(BusError::Timeout {
                        what: format!("service {service}"),
                        after: patience,
                    });
                }
            }
        }
    }

    fn fail_request(&self, service: &str, last: Option<&MemberServant>, why: LossReason) -> BusError {
        self.counts.failed.fetch_add(1, Ordering::Relaxed);
        BusError::CallFailed { service: service.to_owned(), reason: describe_loss(last, why), fate: CallFate::Unknown }
    }
}

/// Describes why a request failed.
fn describe_loss(last: Option<&MemberServant>, why: LossReason) -> String {
    let who = match last {
        Some(servant) => {
            let reason = servant.gone.get();
            let reason = reason.map(|reason| format!(" ({reason})"));
            format!("servant {}{}", servant.id, reason.unwrap_or_default())
        }
        None => "its servant".to_owned(),
    };
    match why {
        LossReason::NotAskedAgain => format!(
            "{who} was lost while it processed this request, which is not retried, since it may have been executed; \
                push the service with --idempotent to retry such requests"
        ),
        LossReason::AskedOften => format!(
            "{} servants were lost while they processed this request, {who} last; it is not retried",
            dispatch::ATTEMPTS
        ),
    }
}

/// Classifies the outcome of a call with respect to the servant.
fn classify_outcome(answer: &Result<Bytes, BusError>) -> AttemptOutcome {
    match answer {
        Err(BusError::CallFailed { fate, .. }) => match fate {
            CallFate::Answered => AttemptOutcome::Answered,
            CallFate::NotTaken => AttemptOutcome::NotTaken,
            CallFate::Unknown => AttemptOutcome::Lost,
        },
        Err(BusError::NoService(_) | BusError::Io { .. }) => AttemptOutcome::NotTaken,
        Err(BusError::Closed) => AttemptOutcome::Lost,
        _ => AttemptOutcome::Answered,
    }
}

impl State {
    /// Adds the load since the last call to the integral.
    fn accumulate_load(&mut self, now: Instant) {
        let GroupLoad { waiting, under_way } = self.dispatcher.load();
        let micros = now.saturating_duration_since(self.busy.1).as_micros();
        self.busy.0 += micros * (waiting + under_way) as u128;
        self.busy.1 = now;
    }
}

/// A pending request; withdrawn when dropped.
struct PendingRequest {
    group: Arc<ServantGroup>,
    kind: Kind,
    ticket: Ticket,
    told: mpsc::UnboundedReceiver<DispatchEvent>,
    over: bool,
}

impl PendingRequest {
    /// Reports the end of a servant's work; returns whether its outcome is the response.
    fn finish_attempt(&mut self, servant: &MemberServant, end: AttemptOutcome) -> bool {
        let ticket = self.ticket;
        let (answered, wasted) = self.group.decide(|dispatcher| {
            let (answered, orders) = dispatcher.finish_attempt(ticket, servant.member, end);
            let others = |order: &&DispatchOrder| matches!(order, DispatchOrder::Drop(of, _) if *of == ticket);
            let wasted = orders.iter().filter(others).count() as u64;
            ((answered, wasted), orders)
        });
        self.group.counts.wasted.fetch_add(wasted, Ordering::Relaxed);
        self.over |= answered;
        if end != AttemptOutcome::Answered {
            self.group.resume_later(servant, &self.kind);
        }
        answered
    }
}

impl Drop for PendingRequest {
    fn drop(&mut self) {
        let mut state = self.group.state.lock();
        state.doors.remove(&self.ticket);
        if !self.over {
            state.accumulate_load(Instant::now());
            let orders = state.dispatcher.withdraw(self.ticket);
            self.group.deliver_orders(&mut state, orders);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn requests_at_a_time_are_a_mean_over_time() {
        let rules = Rules { window: 1, replicas: 1, idempotent: false };
        let group = ServantGroup::new(RosVersion::One, "noetic", &Interface::default(), rules);
        let second = Duration::from_secs(1);
        let begin = || group.begin_request(1, Kind::Call("/work".into()));
        let one = begin();
        tokio::time::sleep(second).await;
        let other = begin();
        tokio::time::sleep(second).await;
        assert_eq!(group.mean_load(), 1.5, "one for a second, two for another");
        // A moment later the value is still the same.
        drop((one, other));
        tokio::time::sleep(second / 1000).await;
        assert_eq!(group.mean_load(), 1.5);
        tokio::time::sleep(second).await;
        let load = group.mean_load();
        assert!((0.0..0.01).contains(&load), "{load}");
    }
}
