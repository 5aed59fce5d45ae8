//! Services of the robot for nodes of the servant. The bus reports a node that looks up a service which has no server
//! (in ROS 1 by a lookup at the Master, in ROS 2 by a client without a server). The lookup is passed to the robot,
//! whose answer is valid until the robot changes it. It is repeated now and then, because a server that restarts under
//! the same name may have another type. See docs/adr/025.
//!
//! ```text
//!             Lookup                        Lent: there
//!  unknown ───────────▶ Asked ─────────────────────────────▶ There ── calls ──▶ the robot
//!     ▲                   │ Lent: not there                    │
//!     │                   ▼                                    │ Lent: gone
//!     └── soon ──────── Not there ◀────────────────────────────┘
//! ```
//! Between ROSes, services are translated one by one, but of actions only goals, feedback and results: the view of such
//! robots looks up the parts of their actions itself.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{BusError, FailureReason, Lender, LentService, RosVersion, ServiceHandler, ServiceType};
use ros::ros2::names;
use tokio::sync::{oneshot, watch};
use tokio::time::{Instant as Moment, timeout_at};

use super::state::{Hub, NodeLink};
use super::types;
use link::control::{FromCloud, ServiceChannel};
use link::skew::{Direction, Skew};
use ros::codec::Stamps;

/// Time a node's lookup waits for the robot's answer; the Master waits a little longer.
const PATIENCE: Duration = Duration::from_millis(1200);
/// Validity of "not there"; roscpp asks fifty times a second while it waits for a service.
const NOT_THERE: Duration = Duration::from_millis(200);
/// Age of "there" after which a lookup makes the robot check again, without waiting for it.
const CONFIRM: Duration = Duration::from_secs(1);
/// Time after which a lookup that the robot has not answered is repeated; the robot answers every lookup unless it is
/// lost.
const ANSWERS: Duration = Duration::from_secs(3);
/// Maximum number of names asked for at a time and remembered.
const NAMES: usize = 1000;

/// State of the robot's services as known to one link.
pub(super) struct RobotServices {
    /// The robot's end answers lookups.
    answers: bool,
    names: Mutex<HashMap<String, State>>,
    /// Incremented with everything that the robot reports about them.
    told: watch::Sender<u64>,
    /// Calls in progress.
    calls: Mutex<RobotCalls>,
}

enum State {
    /// The robot was asked. If one lookup has waited in vain for its answer, no further one waits.
    Asked {
        since: Instant,
        in_vain: bool,
    },
    NotThere {
        since: Instant,
    },
    There {
        there: Arc<RobotService>,
        asked: Instant,
    },
}

/// A service of the robot.
struct RobotService {
    channel: u32,
    service_type: ServiceType,
    request: Stamps,
    response: Stamps,
    gone: watch::Sender<bool>,
}

impl RobotService {
    /// Returns whether the robot reports the same service again.
    fn is_same_as(&self, served: &ServiceChannel) -> bool {
        let ours = &self.service_type;
        self.channel == served.channel && *ours == served.service_type(ours.format.version())
    }
}

#[derive(Default)]
struct RobotCalls {
    waiting: HashMap<u32, oneshot::Sender<Result<Bytes, FailureReason>>>,
    /// The link has ended, so no call is answered any more.
    over: bool,
}

impl RobotServices {
    pub(super) fn new(answers: bool) -> Self {
        Self { answers, names: Mutex::default(), told: watch::Sender::new(0), calls: Mutex::default() }
    }

    /// Completes a call with the robot's response.
    pub(super) fn resolve_call(&self, id: u32, response: Result<Bytes, FailureReason>) {
        if let Some(caller) = self.calls.lock().waiting.remove(&id) {
            let _ = caller.send(response);
        }
    }

    /// Withdraws all services and fails all calls in progress, because the link has ended.
    pub(super) fn fail_all(&self) {
        let mut calls = self.calls.lock();
        calls.over = true;
        for (_, caller) in calls.waiting.drain() {
            let _ = caller.send(Err(link_lost_error()));
        }
        drop(calls);
        for (_, state) in self.names.lock().drain() {
            if let State::There { there, .. } = state {
                there.gone.send_replace(true);
            }
        }
    }

    /// Returns whether the robot is known to have this service.
    pub(super) fn has(&self, service: &str) -> bool {
        self.find_known(service).is_some()
    }

    fn find_known(&self, service: &str) -> Option<Arc<RobotService>> {
        match self.names.lock().get(service) {
            Some(State::There { there, .. }) => Some(Arc::clone(there)),
            _ => None,
        }
    }
}

fn link_lost_error() -> FailureReason {
    FailureReason::new("the link to the robot was lost during this call: the robot may or may not have executed it")
}

impl NodeLink {
    /// Handles the robot's report about a service.
    pub(super) fn on_lent(&self, service: String, of: Option<ServiceChannel>) {
        let Some(hub) = self.hub.upgrade() else {
            return;
        };
        let now = Instant::now();
        {
            let mut names = self.lent.names.lock();
            // Unsolicited reports are ignored.
            let Some(known) = names.get_mut(&service) else {
                return;
            };
            let before = match &*known {
                State::There { there, .. } => Some(Arc::clone(there)),
                _ => None,
            };
            let after = match of {
                Some(served) if before.as_ref().is_some_and(|before| before.is_same_as(&served)) => {
                    return;
                }
                Some(served) => Some(make_service(&hub, self, served)),
                None => None,
            };
            // For nodes, a service of the same type is the one to which they are connected, regardless of its server or
            // channel. If it were withdrawn for a moment, calls made in that moment would never be answered.
            let stays = |before: &RobotService, after: &RobotService| before.service_type == after.service_type;
            let after = match (before, after) {
                (Some(before), Some(after)) if stays(&before, &after) => {
                    Some(RobotService { gone: before.gone.clone(), ..after })
                }
                (Some(before), after) => {
                    before.gone.send_replace(true);
                    after
                }
                (None, after) => after,
            };
            *known = match after {
                Some(there) => State::There { there: Arc::new(there), asked: now },
                None => State::NotThere { since: now },
            };
        }
        self.lent.told.send_modify(|told| *told += 1);
    }

    /// Looks up a service of the robot, asking the robot if necessary.
    async fn look_up(&self, service: &str) -> Option<Arc<RobotService>> {
        let mut told = self.lent.told.subscribe();
        let deadline = Moment::now() + PATIENCE;
        loop {
            told.borrow_and_update();
            match self.query(service) {
                LookupState::Known(there) => return there,
                LookupState::Wait => {}
            }
            match timeout_at(deadline, told.changed()).await {
                Ok(Ok(())) => {}
                Ok(Err(_)) => return None,
                Err(_) => {
                    let mut names = self.lent.names.lock();
                    if let Some(State::Asked { in_vain, .. }) = names.get_mut(service) {
                        *in_vain = true;
                    }
                    return None;
                }
            }
        }
    }

    /// Finds a service of the robot, as the robot has it.
    async fn find_lent(&self, service: &str) -> Option<LentService> {
        let there = self.look_up(service).await?;
        let of = there.service_type.clone();
        let handler = RobotServiceHandler { hub: self.hub.clone(), service: service.to_owned(), of: of.clone() };
        Some(LentService { service_type: of, handler: Arc::new(handler), gone: there.gone.subscribe() })
    }

    fn query(&self, service: &str) -> LookupState {
        let mut names = self.lent.names.lock();
        match names.get_mut(service) {
            Some(State::There { there, asked }) => {
                if asked.elapsed() > CONFIRM {
                    *asked = Instant::now();
                    self.report_lookup(service);
                }
                return LookupState::Known(Some(Arc::clone(there)));
            }
            Some(State::NotThere { since }) if since.elapsed() < NOT_THERE => {
                return LookupState::Known(None);
            }
            // The next lookup waits no longer than this one has.
            Some(State::Asked { since, in_vain: true }) => {
                if since.elapsed() > ANSWERS {
                    *since = Instant::now();
                    self.report_lookup(service);
                }
                return LookupState::Known(None);
            }
            Some(State::Asked { in_vain: false, .. }) => return LookupState::Wait,
            Some(State::NotThere { .. }) | None => {}
        }
        if names.len() >= NAMES && !names.contains_key(service) {
            names.retain(|_, state| !matches!(state, State::NotThere { .. }));
            if names.len() >= NAMES {
                return LookupState::Known(None);
            }
        }
        let since = Instant::now();
        let asked = State::Asked { since, in_vain: false };
        names.insert(service.to_owned(), asked);
        self.report_lookup(service);
        LookupState::Wait
    }

    fn report_lookup(&self, service: &str) {
        let service = service.to_owned();
        self.session.send_control(&FromCloud::Lookup { service });
    }

    /// Calls a service of the robot. The call survives a lost connection and fails with the link.
    async fn call_robot(&self, channel: u32, request: Bytes) -> Result<Bytes, FailureReason> {
        let (sender, answer) = oneshot::channel();
        let id = {
            let mut calls = self.lent.calls.lock();
            if calls.over {
                return Err(link_lost_error());
            }
            // Locked until the caller is registered, because the response may arrive immediately.
            let id = self.session.call(channel, request);
            calls.waiting.insert(id, sender);
            id
        };
        let _abandoned = PendingCallGuard { link: self, id };
        answer.await.unwrap_or_else(|_| Err(link_lost_error()))
    }
}

enum LookupState {
    Known(Option<Arc<RobotService>>),
    Wait,
}

/// Forgets a call whose caller is gone.
struct PendingCallGuard<'a> {
    link: &'a NodeLink,
    id: u32,
}

impl Drop for PendingCallGuard<'_> {
    fn drop(&mut self) {
        self.link.lent.calls.lock().waiting.remove(&self.id);
    }
}

fn make_service(hub: &Hub, link: &NodeLink, served: ServiceChannel) -> RobotService {
    let of = served.service_type(link.view.bus.version());
    let known = link.view.types.find_service(&of);
    let differs = |skew: &Skew| skew.difference() != 0;
    if known.is_none() && link.skew(hub).is_some_and(differs) {
        link.session.send_control(&FromCloud::Notice {
            warning: true,
            text: format!(
                "the clocks differ, but stamps in calls of {} are not converted: the image has no definition of {} \
                    with {}; push the package with the Debian package that contains it (--with DEB)",
                served.name,
                of.name,
                describe_type(&of)
            ),
        });
    }
    let (request, response) = types::call_stamps(known.as_deref());
    RobotService { channel: served.channel, service_type: of, request, response, gone: watch::Sender::new(false) }
}

/// Describes what distinguishes a type from others with its name, in the terms of its ROS version.
fn describe_type(of: &ServiceType) -> String {
    match of.format.version() {
        RosVersion::One => format!("md5sum {}", of.digest),
        RosVersion::Two => format!("type hashes {} and {}", of.request, of.response),
    }
}

/// Starts lending the robot's services to the servant, when the first link begins.
pub(super) async fn start_lending(hub: &Arc<Hub>) {
    let lender = Arc::new(HubLender(Arc::downgrade(hub)));
    let begun = hub.lends.get_or_try_init(|| async { hub.bus.lending()?.lend(lender).await });
    match begun.await {
        Ok(()) | Err(BusError::NotOffered(_)) => {}
        Err(error) => {
            tracing::warn!(%error, "its nodes cannot call services of the robot")
        }
    }
}

impl Hub {
    /// Returns the link for a node's lookups and calls: its own, otherwise one that is up, since all lead to one robot.
    fn route_link(&self, node: &str, suits: impl Fn(&NodeLink) -> bool) -> Option<Arc<NodeLink>> {
        let graph = self.bus.graph().borrow().clone();
        let links = self.links.lock();
        let suitable = || links.values().filter(|link| suits(link));
        let own = suitable().find(|link| graph.is_in_process(&link.node, node));
        let up = || suitable().find(|link| link.session.is_up());
        own.or_else(up).or_else(|| suitable().next()).cloned()
    }

    /// Returns the link of a node's process.
    fn link_of(&self, node: &str) -> Option<Arc<NodeLink>> {
        let graph = self.bus.graph().borrow().clone();
        let links = self.links.lock();
        let mut links = links.values();
        links.find(|link| graph.is_in_process(&link.node, node)).cloned()
    }
}

/// The robot as the lender of services for the servant's bus.
struct HubLender(Weak<Hub>);

#[async_trait]
impl Lender for HubLender {
    async fn find_service(&self, service: &str, node: &str) -> Option<LentService> {
        let hub = self.0.upgrade()?;
        let link = hub.route_link(node, |link| link.lent.answers)?;
        match link.view.translated_bus() {
            Some(_) if names::action_part(service).is_some() => None,
            // A type that has no counterpart was reported to the robot.
            Some(bus) => bus.lend_to_servant(service, link.find_lent(service).await?).ok(),
            None => link.find_lent(service).await,
        }
    }
}

/// Robots of one ROS as lenders of the parts of their actions, in the terms of that ROS.
pub(super) struct PartLender {
    pub(super) hub: Weak<Hub>,
    pub(super) version: RosVersion,
}

#[async_trait]
impl Lender for PartLender {
    async fn find_service(&self, service: &str, node: &str) -> Option<LentService> {
        let hub = self.hub.upgrade()?;
        let suits = |link: &NodeLink| link.lent.answers && link.view.bus.version() == self.version;
        let link = hub.route_link(node, suits)?;
        link.find_lent(service).await
    }
}

/// Forwards calls of one service to the robot.
struct RobotServiceHandler {
    hub: Weak<Hub>,
    service: String,
    /// Type announced to the node.
    of: ServiceType,
}

#[async_trait]
impl ServiceHandler for RobotServiceHandler {
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, FailureReason> {
        let hub = self.hub.upgrade().ok_or_else(link_lost_error)?;
        let has = |link: &NodeLink| link.lent.find_known(&self.service);
        let link = hub.route_link(caller, |link| has(link).is_some());
        let found = link.and_then(|link| Some((has(&link)?, link)));
        let (there, link) = found
            .ok_or_else(|| FailureReason::new(format!("no node on the robot serves {} any more", self.service)))?;
        if there.service_type != self.of {
            return Err(FailureReason::new(format!(
                "{} is served on the robot with {} now, not {} as when it was connected to",
                self.service,
                describe_type(&there.service_type),
                describe_type(&self.of)
            )));
        }
        // Regardless of the link used, stamps are converted for the calling node.
        let calling = hub.link_of(caller);
        let calling = calling.unwrap_or_else(|| Arc::clone(&link));
        let request = calling.shift_stamps(&hub, Direction::Out, &there.request, request);
        let response = link.call_robot(there.channel, request).await?;
        Ok(calling.shift_stamps(&hub, Direction::In, &there.response, response))
    }
}
