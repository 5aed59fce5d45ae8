//! A servant as everybody but its driver sees it.

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use api::{Limits, Millis, Phase, Terms};
use parking_lot::Mutex;
use reach::{Reach, Tenant};
use tokio::sync::watch;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use crate::Error;
use crate::decide::admission::Refused;
use crate::decide::demand::Asked;
use crate::lives::waiting::{Promise, Standing};
use store::{NewEvent, RevisionRecord};

/// Why a servant failed.
#[derive(Debug, Clone, PartialEq)]
pub enum Failure {
    /// There was no room for it.
    Full(Refused),
    /// Anything else.
    Broken {
        /// What happened, beginning with a verb.
        reason: String,
        /// Last lines of its log.
        log: Vec<String>,
    },
}

impl Failure {
    /// Without a log.
    pub fn broken(reason: impl Into<String>) -> Failure {
        Failure::Broken {
            reason: reason.into(),
            log: Vec::new(),
        }
    }
}

/// Where a servant is in its life.
#[derive(Debug, Clone, PartialEq)]
pub struct Life {
    /// The state.
    pub phase: Phase,
    /// Set as soon as it has failed, while it is still being cleaned up.
    pub failure: Option<Failure>,
    /// Why it was ended, when that was asked for.
    pub ended: Option<String>,
}

impl Life {
    /// Why it is ending or has ended.
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

/// One of the clients of a robot, or several that are not told apart.
struct User {
    connections: usize,
    /// Since when there are so many.
    since: Instant,
}

/// A servant.
pub struct Handle {
    /// Its id.
    pub id: String,
    /// Its robot.
    pub robot: String,
    /// The robot named no name; nobody can come back to this servant.
    pub anonymous: bool,
    /// What it is started from.
    pub revision: Arc<RevisionRecord>,
    /// When it was asked for.
    pub created: Millis,
    stands: watch::Sender<Option<Standing>>,
    life: watch::Sender<Life>,
    asked: Mutex<Asked>,
    limits_turn: tokio::sync::Mutex<()>,
    promise: OnceLock<Promise>,
    ready_since: OnceLock<Instant>,
    connections: watch::Sender<usize>,
    /// Whose they are: of a stub its node, of rosbridge clients nothing.
    users: Mutex<HashMap<String, User>>,
    /// Who has stated something and was not connected since then has left.
    began: Instant,
    /// 0: not idle.
    idle_until: AtomicU64,
    /// Its nodes are started and ended by a robot's stubs.
    linked: AtomicBool,
    /// The kernel has ended one of its nodes for want of memory.
    out_of_memory: AtomicBool,
    down: Mutex<Vec<api::NodeDown>>,
    /// What of its nodes hangs, in words, by who uses them.
    hung: Mutex<BTreeMap<String, String>>,
    /// How often its nodes were started, as far as that was seen.
    starts: Mutex<HashMap<String, u64>>,
    end: CancellationToken,
    end_reason: OnceLock<String>,
    container: OnceLock<Arc<dyn servant::engine::Servant>>,
    reach: Mutex<Option<Arc<dyn Reach>>>,
}

impl Handle {
    /// A servant that has been asked for.
    pub(crate) fn new(
        id: String,
        robot: String,
        anonymous: bool,
        asked: Asked,
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
            life: watch::Sender::new(Life {
                phase: Phase::Requested,
                failure: None,
                ended: None,
            }),
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

    /// The kernel has ended one of its nodes for want of memory.
    pub(crate) fn note_out_of_memory(&self) {
        self.out_of_memory.store(true, Ordering::Relaxed);
    }

    /// Whether the kernel has ended one of its nodes for want of memory.
    pub(crate) fn was_out_of_memory(&self) -> bool {
        self.out_of_memory.load(Ordering::Relaxed)
    }

    /// Its service.
    pub fn service(&self) -> &str {
        &self.revision.service
    }

    /// The limits that it is to have.
    pub fn limits(&self) -> Limits {
        self.asked.lock().limits()
    }

    /// Those of them that somebody asked for, which are promised to it.
    pub fn asked(&self) -> Limits {
        self.asked.lock().promised()
    }

    /// Those that would be promised to it after this change, with no weight but one that somebody set.
    pub fn asked_after(&self, change: Limits) -> Limits {
        let asked = self.asked.lock();
        Limits {
            cpu_weight: change.cpu_weight.or(asked.set.cpu_weight),
            ..change.or(asked.promised())
        }
    }

    /// What its robot stated, and what follows.
    pub fn terms(&self) -> Terms {
        self.asked.lock().terms.clone()
    }

    /// Who has the greater one is served first.
    pub fn priority(&self) -> i32 {
        self.asked.lock().terms.priority
    }

    /// All limits that somebody asked for, by who did.
    pub(crate) fn all_asked(&self) -> Asked {
        self.asked.lock().clone()
    }

    pub(crate) fn set_asked(&self, asked: Asked) {
        *self.asked.lock() = asked;
    }

    /// Whoever changes its limits holds this.
    pub(crate) async fn limits_turn(&self) -> tokio::sync::MutexGuard<'_, ()> {
        self.limits_turn.lock().await
    }

    /// What it is promised, once it was admitted.
    pub(crate) fn promise(&self) -> Option<&Promise> {
        self.promise.get()
    }

    pub(crate) fn set_promise(&self, promise: Promise) {
        let _ = self.promise.set(promise);
    }

    /// Where it stands among those that wait to be admitted, now and later; none where it does not wait.
    pub fn watch_standing(&self) -> watch::Receiver<Option<Standing>> {
        self.stands.subscribe()
    }

    /// Where that is told.
    pub(crate) fn stands(&self) -> watch::Sender<Option<Standing>> {
        self.stands.clone()
    }

    /// What its events are about.
    pub fn about(&self) -> NewEvent<'_> {
        NewEvent {
            service: Some(self.service()),
            servant: Some(&self.id),
            robot: Some(&self.robot),
        }
    }

    /// The present state of its life.
    pub fn life(&self) -> Life {
        self.life.borrow().clone()
    }

    /// The state of its life, and each change.
    pub fn watch(&self) -> watch::Receiver<Life> {
        self.life.subscribe()
    }

    /// Connections that use it now.
    pub fn connections(&self) -> usize {
        *self.connections.borrow()
    }

    /// Whether a robot's stubs start and end its nodes.
    pub fn is_linked(&self) -> bool {
        self.linked.load(Ordering::Relaxed)
    }

    /// From now on they do; whether they did not before.
    pub fn set_linked(&self) -> bool {
        !self.linked.swap(true, Ordering::Relaxed)
    }

    /// Its container, once made.
    pub fn container(&self) -> Option<Arc<dyn servant::engine::Servant>> {
        self.container.get().cloned()
    }

    /// Refuses a robot's place in a group, which never has a container.
    pub fn check_container(&self) -> Result<(), Error> {
        if !self.is_place() {
            return Ok(());
        }
        Err(Error::Place {
            id: self.id.clone(),
            service: self.service().to_owned(),
            robot: self.robot.clone(),
        })
    }

    /// Its ROS and its bridge, once reached.
    pub fn reach(&self) -> Option<Arc<dyn Reach>> {
        self.reach.lock().clone()
    }

    /// When it is ended if nobody connects before.
    pub fn idle_until(&self) -> Option<Millis> {
        Some(self.idle_until.load(Ordering::Relaxed)).filter(|until| *until > 0)
    }

    /// Its nodes that failed and are not started again yet.
    pub fn down(&self) -> Vec<api::NodeDown> {
        self.down.lock().clone()
    }

    /// Of `node`: until when it is down, with its failures in a row; none: it is not any more.
    pub(crate) fn set_down(&self, node: &str, until: Option<(u32, Duration)>) {
        let mut down = self.down.lock();
        down.retain(|one| one.node != node);
        down.extend(until.map(|(failures, after)| api::NodeDown {
            node: node.to_owned(),
            failures,
            again: store::now() + after.as_millis() as u64,
        }));
    }

    /// Its nodes that hang: which, and what they leave unanswered.
    pub fn hung(&self) -> Vec<String> {
        self.hung.lock().values().cloned().collect()
    }

    /// That is all of them, by who uses them.
    pub(crate) fn set_hung(&self, hung: BTreeMap<String, String>) {
        *self.hung.lock() = hung;
    }

    /// How often the node was started, as far as that was seen; without a name: all of them.
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

    /// Asks for its end. The first reason stays.
    pub fn end(&self, reason: &str) {
        let _ = self.end_reason.set(reason.to_owned());
        self.end.cancel();
    }

    /// Whether its end has been asked for.
    pub fn is_ending(&self) -> bool {
        self.end.is_cancelled()
    }

    /// Comes back when its end is asked for, with the reason.
    pub(crate) async fn end_asked(&self) -> String {
        self.end.cancelled().await;
        self.end_reason.get().cloned().unwrap_or_default()
    }

    /// Comes back when nothing is left of it.
    pub async fn ended(&self) {
        let mut life = self.watch();
        let _ = life
            .wait_for(|life| matches!(life.phase, Phase::Stopped | Phase::Failed))
            .await;
    }

    /// How long it has been ready, if it ever was.
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

    pub(crate) fn set_container(&self, container: Arc<dyn servant::engine::Servant>) {
        let _ = self.container.set(container);
    }

    pub(crate) fn set_reach(&self, reach: Arc<dyn Reach>) {
        *self.reach.lock() = Some(reach);
    }

    /// Nobody reaches its ROS from here on; gives what was there.
    pub(crate) fn take_reach(&self) -> Option<Arc<dyn Reach>> {
        self.reach.lock().take()
    }

    pub(crate) fn set_idle_until(&self, until: Option<Millis>) {
        self.idle_until.store(until.unwrap_or(0), Ordering::Relaxed);
    }

    /// Counts one more connection of this client of the robot.
    pub(crate) fn enters(&self, who: &str) {
        let mut users = self.users.lock();
        let user = users.entry(who.to_owned()).or_insert(User {
            connections: 0,
            since: Instant::now(),
        });
        user.connections += 1;
        self.connections.send_modify(|count| *count += 1);
    }

    /// Counts one connection of this client less.
    pub(crate) fn leaves(&self, who: &str) {
        let mut users = self.users.lock();
        if let Some(user) = users.get_mut(who) {
            user.connections -= 1;
            user.since = Instant::now();
        }
        let asked = self.asked.lock();
        // How long the others are away says nothing.
        users.retain(|who, user| user.connections > 0 || asked.terms.stated.contains_key(who));
        drop(asked);
        self.connections.send_modify(|count| *count -= 1);
    }

    /// Who has stated something and has been away for so long.
    pub(crate) fn away_for(&self, time: Duration) -> Vec<String> {
        let users = self.users.lock();
        let asked = self.asked.lock();
        let is_away = |who: &&String| match users.get(*who) {
            Some(user) => user.connections == 0 && user.since.elapsed() >= time,
            None => self.began.elapsed() >= time,
        };
        let stated = asked.terms.stated.keys();
        stated.filter(is_away).cloned().collect()
    }

    /// The number of connections now and later.
    pub(crate) fn watch_connections(&self) -> watch::Receiver<usize> {
        self.connections.subscribe()
    }

    /// Why a servant whose life is over cannot be used.
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
                reason: format!(
                    "was ended: {}",
                    life.ended.as_deref().unwrap_or("the daemon is ending")
                ),
                log: Vec::new(),
            },
        }
    }
}

impl Tenant for Handle {
    fn robot(&self) -> &str {
        &self.robot
    }

    fn limits(&self) -> Limits {
        Handle::limits(self)
    }

    fn take_over(&self) -> bool {
        self.set_linked()
    }
}
