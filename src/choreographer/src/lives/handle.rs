//! A servant as seen by everyone but its driver.

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use api::{Limits, Millis, Phase, Terms};
use async_trait::async_trait;
use parking_lot::Mutex;
use reach::{Reach, Tenant};
use tokio::sync::watch;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tracing::Span;
use tracing::span::Id;

use crate::Error;
use crate::decide::admission::AdmissionError;
use crate::decide::demand::LimitSources;
use crate::lives::waiting::{Promise, QueueStanding};
use store::{NewEvent, RevisionRecord};

/// Reason for a servant's failure.
#[derive(Debug, Clone, PartialEq)]
pub enum Failure {
    /// There was no capacity for it.
    Full(AdmissionError),
    /// The start failed for another reason.
    Broken {
        /// The failure, as a phrase that starts with a verb.
        reason: String,
        /// Last lines of its log.
        log: Vec<String>,
    },
}

impl Failure {
    /// Creates a failure without a log.
    pub fn from_reason(reason: impl Into<String>) -> Failure {
        Failure::Broken { reason: reason.into(), log: Vec::new() }
    }
}

/// Lifecycle state of a servant.
#[derive(Debug, Clone, PartialEq)]
pub struct Life {
    /// Current phase.
    pub phase: Phase,
    /// Set as soon as it has failed, while it is still being cleaned up.
    pub failure: Option<Failure>,
    /// Reason why it was ended, if that was requested.
    pub ended: Option<String>,
}

impl Life {
    /// Returns the reason why it is ending or has ended.
    pub fn reason(&self) -> Option<String> {
        match &self.failure {
            Some(Failure::Full(refused)) => Some(refused.to_string()),
            Some(Failure::Broken { reason, .. }) => Some(reason.clone()),
            None => self.ended.clone(),
        }
    }

    pub(crate) fn is_over(&self) -> bool {
        self.failure.is_some() || self.phase >= Phase::Draining
    }
}

/// A client of a robot, or several that are not told apart.
struct ClientConnections {
    connections: usize,
    /// Time of the last change of the number of connections.
    since: Instant,
}

/// Handle of a servant.
pub struct Handle {
    /// Id of the servant.
    pub id: String,
    /// Name of the robot.
    pub robot: String,
    /// The robot gave no name and cannot come back to this servant.
    pub anonymous: bool,
    /// Revision that it is started from.
    pub revision: Arc<RevisionRecord>,
    /// Time of the request.
    pub created: Millis,
    stands: watch::Sender<Option<QueueStanding>>,
    life: watch::Sender<Life>,
    asked: Mutex<LimitSources>,
    limits_turn: tokio::sync::Mutex<()>,
    promise: OnceLock<Promise>,
    ready_since: OnceLock<Instant>,
    connections: watch::Sender<usize>,
    /// Connections by client: the node of a stub, or an empty name for rosbridge clients.
    users: Mutex<HashMap<String, ClientConnections>>,
    /// A client with a statement but no connection since then has left.
    began: Instant,
    /// 0: not idle.
    idle_until: AtomicU64,
    /// A robot's stubs start and end its nodes.
    linked: AtomicBool,
    /// The kernel has killed one of its nodes for lack of memory.
    out_of_memory: AtomicBool,
    down: Mutex<Vec<api::NodeDown>>,
    /// Hung nodes, in words, by the client that uses them.
    hung: Mutex<BTreeMap<String, String>>,
    /// Number of observed starts by node.
    starts: Mutex<HashMap<String, u64>>,
    end: CancellationToken,
    end_reason: OnceLock<String>,
    container: OnceLock<Arc<dyn servant::engine::ServantHandle>>,
    reach: Mutex<Option<Arc<dyn Reach>>>,
}

impl Handle {
    /// Creates the handle of a requested servant.
    pub(crate) fn new(
        id: String,
        robot: String,
        anonymous: bool,
        asked: LimitSources,
        revision: Arc<RevisionRecord>,
        created: Millis,
    ) -> Handle {
        Handle {
            id,
            robot,
            anonymous,
            revision,
            created,
            stands: watch::Sender::new(None),
            life: watch::Sender::new(Life { phase: Phase::Requested, failure: None, ended: None }),
            asked: Mutex::new(asked),
            limits_turn: tokio::sync::Mutex::default(),
            promise: OnceLock::new(),
            ready_since: OnceLock::new(),
            connections: watch::Sender::new(0),
            users: Mutex::default(),
            began: Instant::now(),
            idle_until: AtomicU64::new(0),
            linked: AtomicBool::new(false),
            out_of_memory: AtomicBool::new(false),
            down: Mutex::default(),
            hung: Mutex::default(),
            starts: Mutex::default(),
            end: CancellationToken::new(),
            end_reason: OnceLock::new(),
            container: OnceLock::new(),
            reach: Mutex::default(),
        }
    }

    /// Records that the kernel has killed one of its nodes for lack of memory.
    pub(crate) fn note_out_of_memory(&self) {
        self.out_of_memory.store(true, Ordering::Relaxed);
    }

    /// Returns true if the kernel has killed one of its nodes for lack of memory.
    pub(crate) fn was_out_of_memory(&self) -> bool {
        self.out_of_memory.load(Ordering::Relaxed)
    }

    /// Returns the name of the service.
    pub fn service(&self) -> &str {
        &self.revision.service
    }

    /// Returns the limits that it is to have.
    pub fn limits(&self) -> Limits {
        self.asked.lock().limits()
    }

    /// Returns the requested limits, which are promised to it.
    pub fn requested_limits(&self) -> Limits {
        self.asked.lock().promised_limits()
    }

    /// Returns the limits that would be promised after this change, with no weight but an explicitly set one.
    pub fn requested_limits_after(&self, change: Limits) -> Limits {
        let asked = self.asked.lock();
        Limits { cpu_weight: change.cpu_weight.or(asked.set.cpu_weight), ..change.or(asked.promised_limits()) }
    }

    /// Returns the terms: its robot's statements and the consequences.
    pub fn terms(&self) -> Terms {
        self.asked.lock().terms.clone()
    }

    /// Returns the priority of its robot; greater ones are served first.
    pub fn priority(&self) -> i32 {
        self.asked.lock().terms.priority
    }

    /// Returns all requested limits by source.
    pub(crate) fn limit_sources(&self) -> LimitSources {
        self.asked.lock().clone()
    }

    pub(crate) fn set_limit_sources(&self, asked: LimitSources) {
        *self.asked.lock() = asked;
    }

    /// Locks the limits for a change.
    pub(crate) async fn lock_limits(&self) -> tokio::sync::MutexGuard<'_, ()> {
        self.limits_turn.lock().await
    }

    /// Returns its promise, once it was admitted.
    pub(crate) fn promise(&self) -> Option<&Promise> {
        self.promise.get()
    }

    pub(crate) fn set_promise(&self, promise: Promise) {
        let _ = self.promise.set(promise);
    }

    /// Watches its position in the admission queue; `None` while it does not wait.
    pub fn watch_standing(&self) -> watch::Receiver<Option<QueueStanding>> {
        self.stands.subscribe()
    }

    /// Returns the sender of its position in the queue.
    pub(crate) fn standing_sender(&self) -> watch::Sender<Option<QueueStanding>> {
        self.stands.clone()
    }

    /// Creates a span of the log about this servant. Its parent is that of a connection to it; none for its own tasks.
    pub fn span(&self, parent: Option<Id>) -> Span {
        let (id, service, robot) = (&*self.id, self.service(), &*self.robot);
        tracing::error_span!(parent: parent, "servant", id, service, robot)
    }

    /// Returns the context of its events.
    pub fn event_context(&self) -> NewEvent<'_> {
        NewEvent { service: Some(self.service()), servant: Some(&self.id), robot: Some(&self.robot) }
    }

    /// Returns the current lifecycle state.
    pub fn life(&self) -> Life {
        self.life.borrow().clone()
    }

    /// Watches the lifecycle state.
    pub fn watch(&self) -> watch::Receiver<Life> {
        self.life.subscribe()
    }

    /// Returns the current number of connections.
    pub fn connections(&self) -> usize {
        *self.connections.borrow()
    }

    /// Returns true if a robot's stubs start and end its nodes.
    pub fn is_linked(&self) -> bool {
        self.linked.load(Ordering::Relaxed)
    }

    /// Marks its nodes as managed by stubs; returns true if they were not before.
    pub fn set_linked(&self) -> bool {
        !self.linked.swap(true, Ordering::Relaxed)
    }

    /// Returns its container, once made.
    pub fn container(&self) -> Option<Arc<dyn servant::engine::ServantHandle>> {
        self.container.get().cloned()
    }

    /// Returns an error for a robot's place in a group, which never has a container.
    pub fn check_container(&self) -> Result<(), Error> {
        if !self.is_place() {
            return Ok(());
        }
        Err(Error::Place { id: self.id.clone(), service: self.service().to_owned(), robot: self.robot.clone() })
    }

    /// Returns access to its ROS and its bridge, once reached.
    pub fn reach(&self) -> Option<Arc<dyn Reach>> {
        self.reach.lock().clone()
    }

    /// Returns the time at which it is ended unless a client connects before.
    pub fn idle_until(&self) -> Option<Millis> {
        Some(self.idle_until.load(Ordering::Relaxed)).filter(|until| *until > 0)
    }

    /// Returns its failed nodes that are not restarted yet.
    pub fn nodes_down(&self) -> Vec<api::NodeDown> {
        self.down.lock().clone()
    }

    /// Sets the failures in a row of `node` and the time until its restart; `None` if it is not down any more.
    pub(crate) fn set_down(&self, node: &str, until: Option<(u32, Duration)>) {
        let mut down = self.down.lock();
        down.retain(|one| one.node != node);
        down.extend(until.map(|(failures, after)| api::NodeDown {
            node: node.to_owned(),
            failures,
            again: store::now() + after.as_millis() as u64,
        }));
    }

    /// Returns its hung nodes, with what they leave unanswered.
    pub fn hung_nodes(&self) -> Vec<String> {
        self.hung.lock().values().cloned().collect()
    }

    /// Replaces the hung nodes, by the client that uses them.
    pub(crate) fn set_hung(&self, hung: BTreeMap<String, String>) {
        *self.hung.lock() = hung;
    }

    /// Returns the number of observed starts of the node; of all nodes for an empty name.
    pub(crate) fn starts(&self, node: &str) -> u64 {
        let starts = self.starts.lock();
        match node {
            "" => starts.values().sum(),
            node => starts.get(node).copied().unwrap_or_default(),
        }
    }

    pub(crate) fn note_start(&self, node: &str) {
        *self.starts.lock().entry(node.to_owned()).or_default() += 1;
    }

    /// Requests its end. The first reason is kept.
    pub fn end(&self, reason: &str) {
        let _ = self.end_reason.set(reason.to_owned());
        self.end.cancel();
    }

    /// Returns true if its end has been requested.
    pub fn is_ending(&self) -> bool {
        self.end.is_cancelled()
    }

    /// Waits until its end is requested; returns the reason.
    pub(crate) async fn wait_end_requested(&self) -> String {
        self.end.cancelled().await;
        self.end_reason.get().cloned().unwrap_or_default()
    }

    /// Waits until nothing is left of it.
    pub async fn wait_ended(&self) {
        let mut life = self.watch();
        let _ = life.wait_for(|life| matches!(life.phase, Phase::Stopped | Phase::Failed)).await;
    }

    /// Returns how long it has been ready, if it ever was.
    pub(crate) fn ready_for(&self) -> Option<Duration> {
        self.ready_since.get().map(Instant::elapsed)
    }

    pub(crate) fn set_phase(&self, phase: Phase) {
        if phase == Phase::Ready {
            let _ = self.ready_since.set(Instant::now());
        }
        self.life.send_modify(|life| life.phase = phase);
    }

    pub(crate) fn set_over(&self, outcome: &Result<String, Failure>) {
        self.life.send_modify(|life| {
            life.phase = Phase::Draining;
            match outcome {
                Ok(reason) => life.ended = Some(reason.clone()),
                Err(failure) => life.failure = Some(failure.clone()),
            }
        });
    }

    pub(crate) fn set_container(&self, container: Arc<dyn servant::engine::ServantHandle>) {
        let _ = self.container.set(container);
    }

    pub(crate) fn set_reach(&self, reach: Arc<dyn Reach>) {
        *self.reach.lock() = Some(reach);
    }

    /// Withdraws access to its ROS; returns the previous access.
    pub(crate) fn take_reach(&self) -> Option<Arc<dyn Reach>> {
        self.reach.lock().take()
    }

    pub(crate) fn set_idle_until(&self, until: Option<Millis>) {
        self.idle_until.store(until.unwrap_or(0), Ordering::Relaxed);
    }

    /// Adds a connection of this client of the robot.
    pub(crate) fn add_connection(&self, who: &str) {
        let mut users = self.users.lock();
        let user = users.entry(who.to_owned()).or_insert(ClientConnections { connections: 0, since: Instant::now() });
        user.connections += 1;
        self.connections.send_modify(|count| *count += 1);
    }

    /// Removes a connection of this client.
    pub(crate) fn remove_connection(&self, who: &str) {
        let mut users = self.users.lock();
        if let Some(user) = users.get_mut(who) {
            user.connections -= 1;
            user.since = Instant::now();
        }
        let asked = self.asked.lock();
        // For the others, the time away does not matter.
        users.retain(|who, user| user.connections > 0 || asked.terms.stated.contains_key(who));
        drop(asked);
        self.connections.send_modify(|count| *count -= 1);
    }

    /// Returns the clients with a statement that have been away for this time.
    pub(crate) fn clients_away_for(&self, time: Duration) -> Vec<String> {
        let users = self.users.lock();
        let asked = self.asked.lock();
        let is_away = |who: &&String| match users.get(*who) {
            Some(user) => user.connections == 0 && user.since.elapsed() >= time,
            None => self.began.elapsed() >= time,
        };
        let stated = asked.terms.stated.keys();
        stated.filter(is_away).cloned().collect()
    }

    /// Watches the number of connections.
    pub(crate) fn watch_connections(&self) -> watch::Receiver<usize> {
        self.connections.subscribe()
    }

    /// Returns the error of using a servant whose life is over.
    pub(crate) fn error(&self, life: &Life) -> Error {
        match &life.failure {
            Some(Failure::Full(refused)) => Error::Full(refused.clone()),
            Some(Failure::Broken { reason, log }) => Error::Servant {
                service: self.service().to_owned(),
                robot: self.robot.clone(),
                reason: reason.clone(),
                log: log.clone(),
            },
            None => Error::Servant {
                service: self.service().to_owned(),
                robot: self.robot.clone(),
                reason: format!("was ended: {}", life.ended.as_deref().unwrap_or("the daemon is ending")),
                log: Vec::new(),
            },
        }
    }
}

#[async_trait]
impl Tenant for Handle {
    fn robot(&self) -> &str {
        &self.robot
    }

    async fn take_over(&self) -> bool {
        self.set_linked()
    }
}
