//! Servants that answer many robots: each request of a robot goes to one of them ([`dispatch`]), its answer to the robot that
//! asked.
//!
//! ```text
//!  robot A ─▶ Bridge, links ─▶ GroupBus A ─┐             ┌─▶ Bus of servant 1
//!                                          ├─ Dispatcher ┤
//!  robot B ─▶ Bridge, links ─▶ GroupBus B ─┘             └─▶ Bus of servant 2
//! ```
//!
//! A robot reaches the group by buses of its own that show services and actions of the interface, and nothing else: no
//! topic, no parameter, no node of another robot. Its rosbridge clients have the deployer's names, its stubs those that the
//! nodes would have on the robot. What can be shared so is told by [`shareable`].

mod action_ends;
mod action_parts;
mod action_topics;
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

use dispatch::{Dispatcher, End, Kind, Load, Lost, Member, Order, Robot, Rules, Ticket};

use view::View;

pub use seat::seat;

/// A servant that did not take a request is asked again when its graph has changed, and not sooner than after this.
const PAUSE: Duration = Duration::from_millis(100);
/// The longest such pause.
const LONGEST_PAUSE: Duration = Duration::from_secs(1);

/// A mean of less tells of single requests.
const SPAN: Duration = Duration::from_millis(200);

/// What was counted of a group's requests.
#[derive(Debug, Default)]
pub struct Counts {
    /// Answered, be it that the node said no.
    pub answered: AtomicU64,
    /// Failed, since their servant was lost or none was there in time.
    pub failed: AtomicU64,
    /// Asked again after their servant was lost.
    pub asked_again: AtomicU64,
    /// How many answers were timed lately, and microseconds in all.
    times: Mutex<(u64, u64)>,
    /// Work of replicas that nobody needed: one more for each answer that came second or was not waited for.
    pub wasted: AtomicU64,
}

/// Of so many answers the mean is of late; older ones count half.
const LATELY: u64 = 200;

impl Counts {
    /// Mean time from a request to its answer, of late.
    pub fn mean(&self) -> Option<Duration> {
        let (count, micros) = *self.times.lock();
        micros.checked_div(count).map(Duration::from_micros)
    }

    fn answered(&self, took: Duration) {
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
pub struct Group {
    ros: RosVersion,
    distribution: String,
    interface: Interface,
    /// What parameters its nodes had when the interface was found, by name.
    values: BTreeMap<String, serde_json::Value>,
    state: Mutex<State>,
    members: watch::Sender<BTreeMap<Member, Arc<Servant>>>,
    /// What robots see of the interface as it was deployed.
    whole: Arc<View>,
    counts: Counts,
    robots: AtomicU64,
}

/// What is decided under one lock.
struct State {
    dispatcher: Dispatcher,
    doors: HashMap<Ticket, mpsc::UnboundedSender<Told>>,
    /// Requests times microseconds, and until when they are counted.
    busy: (u128, Instant),
    /// Requests at a time in the mean, until then.
    mean: (f64, Instant),
}

/// What whoever follows a request is told.
enum Told {
    Ask(Arc<Servant>),
    Drop(Arc<Servant>),
    Fail(Lost),
}

/// One servant.
struct Servant {
    member: Member,
    /// The servant's id.
    id: String,
    bus: Arc<dyn Bus>,
    actions: Mutex<HashMap<String, Arc<dyn ActionClient>>>,
    /// Why it left.
    gone: OnceLock<String>,
}

impl Servant {
    /// The action, to send goals to; opened once.
    fn action(&self, name: &str, of: &Arc<ActionDef>) -> Result<Arc<dyn ActionClient>, BusError> {
        let mut actions = self.actions.lock();
        if let Some(known) = actions.get(name) {
            return Ok(Arc::clone(known));
        }
        let opened: Arc<dyn ActionClient> = Arc::from(self.bus.action_client(name, of)?);
        actions.insert(name.to_owned(), Arc::clone(&opened));
        Ok(opened)
    }

    /// The action could not be opened: whoever needs it next opens it anew.
    fn forget_action(&self, name: &str) {
        self.actions.lock().remove(name);
    }
}

impl Group {
    /// One without servants, for robots of a service with this interface.
    pub fn new(
        ros: RosVersion,
        distribution: &str,
        interface: &Interface,
        rules: Rules,
    ) -> Arc<Group> {
        let values = interface.parameters.iter().filter_map(|parameter| {
            let value = parameter.value.clone()?;
            Some((parameter.name.clone(), value))
        });
        let values = values.collect();
        let interface = shareable::shown(interface);
        let whole = Arc::new(View::whole(ros, &interface));
        let state = State {
            dispatcher: Dispatcher::new(rules),
            doors: HashMap::new(),
            busy: (0, Instant::now()),
            mean: (0.0, Instant::now()),
        };
        Arc::new(Group {
            ros,
            distribution: distribution.to_owned(),
            interface,
            values,
            state: Mutex::new(state),
            members: watch::Sender::default(),
            whole,
            counts: Counts::default(),
            robots: AtomicU64::new(0),
        })
    }

    /// A servant answers from now on; gives its number.
    pub fn join(&self, id: &str, bus: Arc<dyn Bus>) -> Member {
        let mut servant = None;
        self.members.send_modify(|members| {
            let member = self.robots.fetch_add(1, Ordering::Relaxed);
            let joins = Arc::new(Servant {
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

    /// A servant is asked no more, and ends what it works at.
    pub fn retire(&self, member: Member) {
        self.decide(|dispatcher| ((), dispatcher.retire(member)));
    }

    /// A servant that was to be asked no more is asked again.
    pub fn take_back(&self, member: Member) {
        self.decide(|dispatcher| ((), dispatcher.take_back(member)));
    }

    /// A servant is gone, for this reason.
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

    /// How much is to be done now.
    pub fn load(&self) -> Load {
        self.state.lock().dispatcher.load()
    }

    /// Requests that a servant works at.
    pub fn load_of(&self, member: Member) -> usize {
        self.state.lock().dispatcher.load_of(member)
    }

    /// How many requests there have been at a time in the mean, since this was asked last: over [`SPAN`] at least, until then what
    /// it was before.
    pub fn mean_load(&self) -> f64 {
        let mut state = self.state.lock();
        let now = Instant::now();
        let span = now.saturating_duration_since(state.mean.1);
        if span >= SPAN {
            state.count(now);
            let busy = std::mem::take(&mut state.busy.0);
            state.mean = (busy as f64 / span.as_micros() as f64, now);
        }
        state.mean.0
    }

    /// What was counted.
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// Decides, and tells those whose requests it concerns.
    fn decide<T>(&self, by: impl FnOnce(&mut Dispatcher) -> (T, Vec<Order>)) -> T {
        let mut state = self.state.lock();
        state.count(Instant::now());
        let (done, orders) = by(&mut state.dispatcher);
        self.tell(&mut state, orders);
        done
    }

    fn tell(&self, state: &mut State, orders: Vec<Order>) {
        if orders.is_empty() {
            return;
        }
        let members = self.members.borrow();
        for order in orders {
            let (ticket, told) = match order {
                Order::Ask(ticket, member) => match members.get(&member) {
                    Some(servant) => (ticket, Told::Ask(Arc::clone(servant))),
                    None => continue,
                },
                Order::Drop(ticket, member) => match members.get(&member) {
                    Some(servant) => (ticket, Told::Drop(Arc::clone(servant))),
                    None => continue,
                },
                Order::Fail(ticket, why) => (ticket, Told::Fail(why)),
            };
            if let Some(door) = state.doors.get(&ticket) {
                // Whoever has stopped listening withdraws it.
                let _ = door.send(told);
            }
        }
    }

    /// Begins to ask for something.
    fn begin(self: &Arc<Self>, robot: Robot, kind: Kind) -> Errand {
        let (door, told) = mpsc::unbounded_channel();
        let mut state = self.state.lock();
        state.count(Instant::now());
        let (ticket, orders) = state.dispatcher.ask(robot, &kind);
        state.doors.insert(ticket, door);
        self.tell(&mut state, orders);
        drop(state);
        Errand {
            group: Arc::clone(self),
            kind,
            ticket,
            told,
            over: false,
        }
    }

    /// A servant that did not take a request, or lost it, is asked again soon: a node that is being started again registers its
    /// services.
    fn resume_later(self: &Arc<Self>, servant: &Servant, kind: &Kind) {
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

    /// Calls a service for a robot: one servant, or as many as are to work at it, and the first answer.
    async fn call(
        self: &Arc<Self>,
        robot: Robot,
        service: &str,
        digest: &Digest,
        request: Bytes,
        patience: Duration,
    ) -> Result<Bytes, BusError> {
        type Asked<'a> = BoxFuture<'a, Result<(Arc<Servant>, Result<Bytes, BusError>), Aborted>>;
        let began = Instant::now();
        let deadline = began + patience;
        let mut errand = self.begin(robot, Kind::Call(service.into()));
        let mut asked: FuturesUnordered<Asked<'_>> = FuturesUnordered::new();
        let mut handles: Vec<(Member, AbortHandle)> = Vec::new();
        let mut last: Option<Arc<Servant>> = None;
        loop {
            tokio::select! {
                biased;
                Some(ended) = asked.next(), if !asked.is_empty() => {
                    let Ok((servant, answer)) = ended else { continue };
                    if errand.ended(&servant, end_of(&answer)) {
                        self.counts.answered(began.elapsed());
                        return answer;
                    }
                    last = Some(servant);
                }
                Some(told) = errand.told.recv() => match told {
                    Told::Ask(servant) => {
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
                    Told::Drop(servant) => {
                        let of = handles.iter().filter(|(member, _)| *member == servant.member);
                        of.for_each(|(_, handle)| handle.abort());
                        last = Some(servant);
                    }
                    Told::Fail(why) => {
                        errand.over = true;
                        return Err(self.failed(service, last.as_deref(), why));
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

    fn failed(&self, service: &str, last: Option<&Servant>, why: Lost) -> BusError {
        self.counts.failed.fetch_add(1, Ordering::Relaxed);
        BusError::CallFailed {
            service: service.to_owned(),
            reason: lost_in_words(last, why),
            fate: CallFate::Unknown,
        }
    }
}

/// Why a request failed, in words.
fn lost_in_words(last: Option<&Servant>, why: Lost) -> String {
    let who = match last {
        Some(servant) => {
            let reason = servant.gone.get();
            let reason = reason.map(|reason| format!(" ({reason})"));
            format!("servant {}{}", servant.id, reason.unwrap_or_default())
        }
        None => "its servant".to_owned(),
    };
    match why {
        Lost::NotAskedAgain => format!(
            "{who} was lost while it worked at this request, which is not asked again, since it may have been carried out; push the service with --idempotent to have such requests asked again"
        ),
        Lost::AskedOften => format!(
            "{} servants were lost while they worked at this request, {who} last; it is not asked again",
            dispatch::ATTEMPTS
        ),
    }
}

/// What the outcome of a call says of the servant.
fn end_of(answer: &Result<Bytes, BusError>) -> End {
    match answer {
        Err(BusError::CallFailed { fate, .. }) => match fate {
            CallFate::Answered => End::Answered,
            CallFate::NotTaken => End::NotTaken,
            CallFate::Unknown => End::Lost,
        },
        Err(BusError::NoService(_) | BusError::Io { .. }) => End::NotTaken,
        Err(BusError::Closed) => End::Lost,
        _ => End::Answered,
    }
}

impl State {
    /// Counts the requests of the time until now.
    fn count(&mut self, now: Instant) {
        let Load { waiting, under_way } = self.dispatcher.load();
        let micros = now.saturating_duration_since(self.busy.1).as_micros();
        self.busy.0 += micros * (waiting + under_way) as u128;
        self.busy.1 = now;
    }
}

/// A request under way; withdrawn when it is dropped.
struct Errand {
    group: Arc<Group>,
    kind: Kind,
    ticket: Ticket,
    told: mpsc::UnboundedReceiver<Told>,
    over: bool,
}

impl Errand {
    /// A servant's work at it has ended; whether that is the answer.
    fn ended(&mut self, servant: &Servant, end: End) -> bool {
        let ticket = self.ticket;
        let (answered, wasted) = self.group.decide(|dispatcher| {
            let (answered, orders) = dispatcher.ended(ticket, servant.member, end);
            let others = |order: &&Order| matches!(order, Order::Drop(of, _) if *of == ticket);
            let wasted = orders.iter().filter(others).count() as u64;
            ((answered, wasted), orders)
        });
        self.group
            .counts
            .wasted
            .fetch_add(wasted, Ordering::Relaxed);
        self.over |= answered;
        if end != End::Answered {
            self.group.resume_later(servant, &self.kind);
        }
        answered
    }
}

impl Drop for Errand {
    fn drop(&mut self) {
        let mut state = self.group.state.lock();
        state.doors.remove(&self.ticket);
        if !self.over {
            state.count(Instant::now());
            let orders = state.dispatcher.withdraw(self.ticket);
            self.group.tell(&mut state, orders);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn requests_at_a_time_are_a_mean_over_time() {
        let rules = Rules {
            window: 1,
            replicas: 1,
            idempotent: false,
        };
        let group = Group::new(RosVersion::One, "noetic", &Interface::default(), rules);
        let second = Duration::from_secs(1);
        let begin = || group.begin(1, Kind::Call("/work".into()));
        let one = begin();
        tokio::time::sleep(second).await;
        let other = begin();
        tokio::time::sleep(second).await;
        assert_eq!(group.mean_load(), 1.5, "one for a second, two for another");
        // A moment later nothing else is known.
        drop((one, other));
        tokio::time::sleep(second / 1000).await;
        assert_eq!(group.mean_load(), 1.5);
        tokio::time::sleep(second).await;
        let load = group.mean_load();
        assert!((0.0..0.01).contains(&load), "{load}");
    }
}
