//! Services of the robot, for nodes of the servant. The bus tells of a node that looks for a service which is not there (in ROS 1
//! the Master is asked for it, in ROS 2 the node has a client without a server); it is passed to the robot, whose answer holds until the robot says otherwise; it is asked again now and then, since a server that
//! starts anew under the same name may serve another type. See docs/adr/025.
//!
//! ```text
//!             Lookup                        Lent: there
//!  unknown ───────────▶ Asked ─────────────────────────────▶ There ── calls ──▶ the robot
//!     ▲                   │ Lent: not there                    │
//!     │                   ▼                                    │ Lent: gone
//!     └── in a moment ── Not there ◀───────────────────────────┘
//! ```

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{BusError, Lender, Lent, RosVersion, ServiceHandler, ServiceType};
use tokio::sync::{oneshot, watch};
use tokio::time::{Instant as Moment, timeout_at};

use super::node_link::NodeLink;
use super::{Hub, types};
use link::control::{FromCloud, Served};
use link::skew::{Direction, Skew};
use ros::codec::Stamps;

/// A node's lookup waits so long for the robot's answer; the Master waits a little longer.
const PATIENCE: Duration = Duration::from_millis(1200);
/// "Not there" holds so long: roscpp asks fifty times a second while it waits for a service.
const NOT_THERE: Duration = Duration::from_millis(200);
/// "There" holds longer, but who looks after so long makes the robot look again, without waiting for it.
const CONFIRM: Duration = Duration::from_secs(1);
/// The robot answers every question, however it may have been lost: one that it has not answered for so long is asked again.
const ANSWERS: Duration = Duration::from_secs(3);
/// Names asked for at a time, and remembered.
const NAMES: usize = 1000;

/// What one link knows of the robot's services.
pub(super) struct RobotServices {
    /// The robot's end answers lookups.
    answers: bool,
    names: Mutex<HashMap<String, State>>,
    /// Grows with everything that the robot tells of them.
    told: watch::Sender<u64>,
    /// Calls under way.
    calls: Mutex<Calls>,
}

enum State {
    /// The robot was asked; a lookup may have waited for its answer in vain, and no other shall.
    Asked {
        since: Instant,
        in_vain: bool,
    },
    NotThere {
        since: Instant,
    },
    There {
        there: Arc<There>,
        asked: Instant,
    },
}

/// A service that the robot has.
struct There {
    channel: u32,
    service_type: ServiceType,
    request: Stamps,
    response: Stamps,
    gone: watch::Sender<bool>,
}

impl There {
    /// Whether the robot tells of the same once more.
    fn is(&self, served: &Served) -> bool {
        let ours = &self.service_type;
        self.channel == served.channel && *ours == served.service_type(ours.format.version())
    }
}

#[derive(Default)]
struct Calls {
    waiting: HashMap<u32, oneshot::Sender<Result<Bytes, String>>>,
    /// The link has ended: none is answered any more.
    over: bool,
}

impl RobotServices {
    pub(super) fn new(answers: bool) -> Self {
        Self {
            answers,
            names: Mutex::default(),
            told: watch::Sender::new(0),
            calls: Mutex::default(),
        }
    }

    /// The robot has answered a call.
    pub(super) fn answered(&self, id: u32, response: Result<Bytes, String>) {
        if let Some(caller) = self.calls.lock().waiting.remove(&id) {
            let _ = caller.send(response);
        }
    }

    /// The link has ended: nothing is lent any more, and calls under way have failed.
    pub(super) fn end(&self) {
        let mut calls = self.calls.lock();
        calls.over = true;
        for (_, caller) in calls.waiting.drain() {
            let _ = caller.send(Err(lost()));
        }
        drop(calls);
        for (_, state) in self.names.lock().drain() {
            if let State::There { there, .. } = state {
                there.gone.send_replace(true);
            }
        }
    }

    /// Whether the robot is known to have this service.
    pub(super) fn has(&self, service: &str) -> bool {
        self.there(service).is_some()
    }

    fn there(&self, service: &str) -> Option<Arc<There>> {
        match self.names.lock().get(service) {
            Some(State::There { there, .. }) => Some(Arc::clone(there)),
            _ => None,
        }
    }
}

fn lost() -> String {
    "the link to the robot was lost, and with it this call: the robot may or may not have done what was asked"
        .to_owned()
}

impl NodeLink {
    /// The robot tells what it has under a name.
    pub(super) fn lends(&self, service: String, of: Option<Served>) {
        let Some(hub) = self.hub.upgrade() else {
            return;
        };
        let now = Instant::now();
        {
            let mut names = self.lent.names.lock();
            // What nobody asked for is not kept.
            let Some(known) = names.get_mut(&service) else {
                return;
            };
            let before = match &*known {
                State::There { there, .. } => Some(Arc::clone(there)),
                _ => None,
            };
            let after = match of {
                Some(served) if before.as_ref().is_some_and(|before| before.is(&served)) => return,
                Some(served) => Some(there(&hub, self, served)),
                None => None,
            };
            // To nodes the same type is the service that they are connected to, whoever serves it by whatever number: were it taken back for
            // a moment, what they ask in that moment would never be answered.
            let stays = |before: &There, after: &There| before.service_type == after.service_type;
            let after = match (before, after) {
                (Some(before), Some(after)) if stays(&before, &after) => Some(There {
                    gone: before.gone.clone(),
                    ..after
                }),
                (Some(before), after) => {
                    before.gone.send_replace(true);
                    after
                }
                (None, after) => after,
            };
            *known = match after {
                Some(there) => State::There {
                    there: Arc::new(there),
                    asked: now,
                },
                None => State::NotThere { since: now },
            };
        }
        self.lent.told.send_modify(|told| *told += 1);
    }

    /// What the robot has under a name; asks where that is not known.
    async fn look_up(&self, service: &str) -> Option<Arc<There>> {
        let mut told = self.lent.told.subscribe();
        let deadline = Moment::now() + PATIENCE;
        loop {
            told.borrow_and_update();
            match self.ask(service) {
                Lookup::Known(there) => return there,
                Lookup::Wait => {}
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

    fn ask(&self, service: &str) -> Lookup {
        let mut names = self.lent.names.lock();
        match names.get_mut(service) {
            Some(State::There { there, asked }) => {
                if asked.elapsed() > CONFIRM {
                    *asked = Instant::now();
                    self.report_lookup(service);
                }
                return Lookup::Known(Some(Arc::clone(there)));
            }
            Some(State::NotThere { since }) if since.elapsed() < NOT_THERE => {
                return Lookup::Known(None);
            }
            // The next lookup waits for no longer than this one has.
            Some(State::Asked {
                since,
                in_vain: true,
            }) => {
                if since.elapsed() > ANSWERS {
                    *since = Instant::now();
                    self.report_lookup(service);
                }
                return Lookup::Known(None);
            }
            Some(State::Asked { in_vain: false, .. }) => return Lookup::Wait,
            Some(State::NotThere { .. }) | None => {}
        }
        if names.len() >= NAMES && !names.contains_key(service) {
            names.retain(|_, state| !matches!(state, State::NotThere { .. }));
            if names.len() >= NAMES {
                return Lookup::Known(None);
            }
        }
        let since = Instant::now();
        let asked = State::Asked {
            since,
            in_vain: false,
        };
        names.insert(service.to_owned(), asked);
        self.report_lookup(service);
        Lookup::Wait
    }

    fn report_lookup(&self, service: &str) {
        let service = service.to_owned();
        self.session.report(&FromCloud::Lookup { service });
    }

    /// Calls a service of the robot. Over a cut the call waits; it fails with the link.
    async fn call_robot(&self, channel: u32, request: Bytes) -> Result<Bytes, String> {
        let (sender, answer) = oneshot::channel();
        let id = {
            let mut calls = self.lent.calls.lock();
            if calls.over {
                return Err(lost());
            }
            // The answer may come at once: it must find its caller.
            let id = self.session.call(channel, request);
            calls.waiting.insert(id, sender);
            id
        };
        let _abandoned = Abandoned { link: self, id };
        answer.await.unwrap_or_else(|_| Err(lost()))
    }
}

enum Lookup {
    Known(Option<Arc<There>>),
    Wait,
}

/// Forgets a call whose caller has gone.
struct Abandoned<'a> {
    link: &'a NodeLink,
    id: u32,
}

impl Drop for Abandoned<'_> {
    fn drop(&mut self) {
        self.link.lent.calls.lock().waiting.remove(&self.id);
    }
}

fn there(hub: &Hub, link: &NodeLink, served: Served) -> There {
    let of = served.service_type(hub.bus.version());
    let known = types::service(&hub.registry, &of);
    let differs = |skew: &Skew| skew.difference() != 0;
    if known.is_none() && link.skew(hub).is_some_and(differs) {
        link.session.report(&FromCloud::Notice {
            warning: true,
            text: format!(
                "the clocks differ, and stamps in calls of {} stay as they are: the image has no definition of {} with {}; push the package with the Debian package that holds it (--with DEB)",
                served.name, of.name, told_apart(&of)
            ),
        });
    }
    let (request, response) = types::stamps_of_calls(known.as_deref());
    There {
        channel: served.channel,
        service_type: of,
        request,
        response,
        gone: watch::Sender::new(false),
    }
}

/// What tells a type from others of its name, in the words of its ROS.
fn told_apart(of: &ServiceType) -> String {
    match of.format.version() {
        RosVersion::One => format!("md5sum {}", of.digest),
        RosVersion::Two => format!("type hashes {} and {}", of.request, of.response),
    }
}

/// Lends the robot's services to the servant, from the first link on.
pub(super) async fn begin(hub: &Arc<Hub>) {
    let lender = Arc::new(Robot(Arc::downgrade(hub)));
    let begun = hub
        .lends
        .get_or_try_init(|| async { hub.bus.lending()?.lend(lender).await });
    match begun.await {
        Ok(()) | Err(BusError::NotOffered(_)) => {}
        Err(error) => {
            tracing::warn!(servant = hub.servant, %error, "its nodes cannot call services of the robot")
        }
    }
}

impl Hub {
    /// The link by which a node's lookups and calls go: its own, else one that is up, since all are on one robot.
    fn way(&self, node: &str, suits: impl Fn(&NodeLink) -> bool) -> Option<Arc<NodeLink>> {
        let graph = self.bus.graph().borrow().clone();
        let links = self.links.lock();
        let suitable = || links.values().filter(|link| suits(link));
        let own = suitable().find(|link| graph.is_of_process(&link.node, node));
        let up = || suitable().find(|link| link.session.is_up());
        own.or_else(up).or_else(|| suitable().next()).cloned()
    }

    /// The link of the process that a node is of.
    fn link_of(&self, node: &str) -> Option<Arc<NodeLink>> {
        let graph = self.bus.graph().borrow().clone();
        let links = self.links.lock();
        let mut links = links.values();
        links
            .find(|link| graph.is_of_process(&link.node, node))
            .cloned()
    }
}

/// The robot, as the servant's bus asks it.
struct Robot(Weak<Hub>);

#[async_trait]
impl Lender for Robot {
    async fn find(&self, service: &str, node: &str) -> Option<Lent> {
        let hub = self.0.upgrade()?;
        let link = hub.way(node, |link| link.lent.answers)?;
        let there = link.look_up(service).await?;
        Some(Lent {
            service_type: there.service_type.clone(),
            gone: there.gone.subscribe(),
            handler: Arc::new(Passing {
                hub: self.0.clone(),
                service: service.to_owned(),
                of: there.service_type.clone(),
            }),
        })
    }
}

/// Passes calls of one service to the robot.
struct Passing {
    hub: Weak<Hub>,
    service: String,
    /// As the node was told.
    of: ServiceType,
}

#[async_trait]
impl ServiceHandler for Passing {
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, String> {
        let hub = self.hub.upgrade().ok_or_else(lost)?;
        let has = |link: &NodeLink| link.lent.there(&self.service);
        let link = hub.way(caller, |link| has(link).is_some());
        let found = link.and_then(|link| Some((has(&link)?, link)));
        let (there, link) =
            found.ok_or_else(|| format!("nobody on the robot serves {} any more", self.service))?;
        if there.service_type != self.of {
            return Err(format!(
                "{} is served on the robot with {} now, not {} as when it was connected to",
                self.service,
                told_apart(&there.service_type),
                told_apart(&self.of)
            ));
        }
        // Whichever way it goes, its stamps are those of the node that calls.
        let calling = hub.link_of(caller);
        let calling = calling.unwrap_or_else(|| Arc::clone(&link));
        let request = calling.shift(&hub, Direction::Out, &there.request, request);
        let response = link.call_robot(there.channel, request).await?;
        Ok(calling.shift(&hub, Direction::In, &there.response, response))
    }
}
