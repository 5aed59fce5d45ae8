//! Decides which servants live: one for each robot of each service, started when the robot first connects, kept
//! for a grace time after it left; of a shared service a group of servants for all its robots.
//!
//! ```text
//!              no room                 engine, node or time-out
//!          ┌───────────────┬─────────────┬────────────┬───────────┐
//!          │               │             │            │           ▼
//!      Requested ──▶ Admitted ──▶ Created ──▶ Starting ──▶ Ready ─┬▶ Draining ──▶ Failed
//!      (asked for)   (room)     (container)  (nodes)   (interface)└▶ Draining ──▶ Stopped
//!                                    ▲                   idle, stopped, removed
//!                                    └── adopted: an earlier daemon started it
//! ```
//!
//! What is decided, [`decide`] decides by pure functions of what is, what is asked and the time; what it says is carried out
//! by the tasks of [`lives`], which alone wait, lock and talk to the engine.
//!
//! ```text
//!   robots, stubs, pushes, operators           connections, ends of nodes, the graph, time
//!             │ ask                                          │ facts
//!             ▼                                              ▼
//!   ┌ lives ───────────────────────────────────────────────────────────────────────────┐
//!   │ ensure, waiting, limits,    driver ─ starting ─ lifetime ─ nodes,    warm_pool,  │
//!   │ rollouts, group             controller, measuring, hung              shadow, …   │
//!   └──────┬──────────────────────────────────┬──────────────────────────────┬─────────┘
//!      facts ▼ ▲ what to do, and why      facts ▼ ▲                      facts ▼ ▲
//!   ┌ decide ──────────────────────────────────────────────────────────────────────────┐
//!   │ terms, dictionary,                lifetime, nodes,                warm_pool,     │
//!   │ placement, admission,             adoption, controller,           forecast,      │
//!   │ capacity, rollout, group          measured, hung, stall           shadow, …      │
//!   └──────────────────────────────────────────────────────────────────────────────────┘
//! ```
//!
//! Each servant has one task ([`lives::driver`]) that alone changes its state; everybody else asks for its end, counts
//! themselves in and out as a connection ([`Lease`]), and watches. Who gets which servant is decided and recorded under one
//! short lock: a servant that is being ended is never given to anyone.

#![forbid(unsafe_code)]

mod decide;
mod error;
pub mod limits;
mod lives;
mod memory;
mod options;
mod request;
mod shown;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use bridge::BridgeOptions;
use catalogue::{Catalogue, names};
use parking_lot::Mutex;
use reach::{Material, Opener, Pace, RequestTimes};
use servant::engine::Engine;
use store::{Journal, State};
use tokio::sync::{broadcast, watch};

pub use decide::Amount;
pub use decide::admission::{Position, Refused};
pub use decide::back_off::seconds;
pub use decide::controller;
pub use decide::dictionary::{MOST_ROWS, check as check_row};
pub use decide::terms::{Cap, Capper, Untenable};
pub use error::{Error, Unchanged, with_last_words};
pub use limits::engine_limits;
pub use lives::adoption::Inheritance;
pub use lives::calibration::Requests;
pub use lives::capture::Bounds;
pub use lives::handle::Handle;
pub use lives::lease::Lease;
pub use lives::recent::Answered;
pub use lives::rollouts::check_terms;
pub use lives::waiting::{Admission, Permit, Standing};
pub use memory::{Memory, MemoryOptions};
pub use options::{Class, DEFAULT_CLASS, Hung, Options};
pub use request::ServantRequest;
pub use shown::usage;

use decide::admission::Ask;
use decide::dictionary::Aux;
use decide::placement::{Placement, place};
use decide::terms::explain;
use lives::Inner;
use lives::back_off::BackOffs;
use lives::driver::{self, Beginning};
use lives::group::is_place;
use lives::hung;
use lives::lease::Anew;
use lives::warm_pool::{self, WarmPool};

/// In a trial, for one answer: a message of a recording that is answered by nothing must not hold up the rest.
const TRIED: Duration = Duration::from_secs(2);
/// A picture is tried with so many requests.
const SHOWN: usize = 20;

/// Decides which servants live. Cheap to clone.
#[derive(Clone)]
pub struct Choreographer {
    inner: Arc<Inner>,
}

impl Choreographer {
    /// One that starts servants by `engine` and reaches them by `opener`.
    pub fn new(
        options: Options,
        state: Arc<State>,
        catalogue: Arc<Catalogue>,
        engine: Arc<dyn Engine>,
        opener: Arc<dyn Opener>,
        admission: Admission,
    ) -> Choreographer {
        let journal = Journal::new(Arc::clone(&state));
        let memory = Memory::new(&options.memory, journal.clone());
        let inner = Inner {
            memory: Arc::new(memory),
            options,
            state,
            journal,
            catalogue,
            engine,
            opener,
            admission,
            request_times: Arc::default(),
            recent: Arc::default(),
            moves: AtomicU64::new(0),
            servants: Mutex::default(),
            warm_pool: WarmPool::default(),
            groups: Default::default(),
            back_offs: BackOffs::default(),
            rollouts: Arc::default(),
            incomplete: Mutex::default(),
            ending: AtomicBool::new(false),
            refusals: Mutex::default(),
        };
        Choreographer {
            inner: Arc::new(inner),
        }
    }

    /// The servant that is asked for: the one that is there, or a new one. Comes back at once; the lease tells when the
    /// servant can be used, and keeps it for as long as it lives.
    ///
    /// # Errors
    /// Terms that cannot be had ([`Error::Terms`]) where a new one is needed. Those of a servant that is there are looked at by
    /// [`Lease::admitted`].
    pub fn ensure(&self, request: ServantRequest) -> Result<Lease, Error> {
        let inner = &self.inner;
        let key = (request.service.clone(), request.robot.clone());
        // Not under the lock, since all other robots wait for that: the dictionary is read, and may be long.
        let is_new = !inner.servants.lock().given.contains_key(&key);
        let ahead = is_new.then(|| inner.terms_ahead(&request)).transpose()?;
        let (handle, lease, warm, takes_canary) = {
            let mut servants = inner.servants.lock();
            // Under the lock: a revision that is published meanwhile ends the servants that it finds, and must not be
            // followed by one of the revision before.
            let (revision, takes_canary) = inner.revision_for(&request)?;
            if inner.ending.load(Ordering::SeqCst) {
                return Err(Error::Ending);
            }
            let has = servants.given.get(&key).map(|handle| inner.facts(handle));
            if has.as_ref().is_none_or(|has| has.ending) {
                inner.check_back_off(&revision, &request.robot, request.anonymous)?;
            }
            // Nobody who waits for capacity is overtaken by one that takes what was promised ahead.
            // Nor do nodes run already that may use less memory than they perhaps do.
            let bounded = request.set.memory.is_some();
            let default_names = request.stub.is_none() && !bounded && inner.admission.is_calm();
            let (placement, warm) = if is_place(&revision, &request.robot) {
                // It needs no container.
                let placement = place(has.as_ref(), None, revision.number, &revision.image);
                (placement, None)
            } else {
                let asks = (&*request.robot, default_names);
                inner.warm_pool.place(has.as_ref(), &revision, asks)
            };
            let ends = match placement {
                Placement::Keep(id) => {
                    let lease = Lease::new(Arc::clone(&servants.all[id]), request.who());
                    return Ok(lease.stating(Anew {
                        inner: Arc::clone(inner),
                        stated: request.stated,
                    }));
                }
                Placement::Start { ends, .. } => ends,
            };
            let ahead = ahead.filter(|(of, _)| of.number == revision.number);
            let terms = match ahead {
                Some((_, terms)) => terms,
                // Another revision was published meanwhile.
                None => inner.terms(&request.statement(), &revision),
            };
            let terms = match terms {
                Ok(terms) => terms,
                Err(error) => {
                    drop(servants);
                    inner.give_back(warm);
                    inner.report_refused(&request, &error);
                    return Err(error);
                }
            };
            servants.end(ends);
            if takes_canary {
                let rollouts = &inner.rollouts;
                rollouts.takes_canary(&request.service, &request.robot);
            }
            let id = warm.as_ref().map(|warm| warm.container.id().to_owned());
            let who = request.who().to_owned();
            let handle = Arc::new(Handle::new(
                id.unwrap_or_else(|| names::servant_id(&request.service)),
                request.robot,
                request.anonymous,
                decide::demand::Asked {
                    set: request.set,
                    ..inner.asked(terms)
                },
                revision,
                store::now(),
            ));
            if request.stub.is_some() {
                handle.set_linked();
            }
            servants.all.insert(handle.id.clone(), Arc::clone(&handle));
            servants.given.insert(key, Arc::clone(&handle));
            let lease = Lease::new(Arc::clone(&handle), &who);
            (handle, lease, warm, takes_canary)
        };
        if takes_canary {
            // At once: a daemon that is started after this one was killed would give its place to another robot.
            inner.write_changed();
        }
        let beginning = Beginning::Asked(warm);
        tokio::spawn(driver::drive(Arc::clone(inner), handle, beginning));
        Ok(lease)
    }

    /// All servants that live, oldest first.
    pub fn servants(&self) -> Vec<Arc<Handle>> {
        let mut servants: Vec<_> = self.inner.servants.lock().all.values().cloned().collect();
        servants.sort_by(|one, other| (one.created, &one.id).cmp(&(other.created, &other.id)));
        servants
    }

    /// One servant.
    pub fn servant(&self, id: &str) -> Result<Arc<Handle>, Error> {
        let servants = self.inner.servants.lock();
        servants.all.get(id).cloned().ok_or_else(|| {
            let mut exists: Vec<String> = servants.all.keys().cloned().collect();
            exists.sort();
            Error::UnknownServant {
                id: id.to_owned(),
                exists,
            }
        })
    }

    /// Ends the servants that `chosen` picks and waits until nothing is left of them; gives their ids.
    pub async fn stop(&self, reason: &str, chosen: impl Fn(&Handle) -> bool) -> Vec<String> {
        let leaving: Vec<Arc<Handle>> = {
            let servants = self.inner.servants.lock();
            let leaving = servants
                .all
                .values()
                .filter(|handle| chosen(handle))
                .cloned()
                .collect::<Vec<_>>();
            for handle in &leaving {
                handle.end(reason);
            }
            leaving
        };
        let mut ids = Vec::new();
        for handle in leaving {
            handle.ended().await;
            ids.push(handle.id.clone());
        }
        ids.sort();
        ids
    }

    /// Starts no more servants.
    pub fn close(&self) {
        let _servants = self.inner.servants.lock();
        self.inner.ending.store(true, Ordering::SeqCst);
    }

    /// Keeps the warm pool from now on; comes back at once.
    pub fn keep_warm_pool(&self) {
        tokio::spawn(warm_pool::keep(Arc::clone(&self.inner)));
        self.inner.warm_pool.look();
    }

    /// Looks from now on for nodes that hang; comes back at once.
    pub fn watch_nodes(&self) {
        tokio::spawn(hung::keep(Arc::clone(&self.inner)));
    }

    /// Has warm containers made for what is published now.
    pub fn refill_warm_pool(&self) {
        self.inner.warm_pool.look();
    }

    /// Ends the warm containers of what is not published any more.
    pub async fn end_stale_warm(&self) -> Result<(), Error> {
        warm_pool::tidy(&self.inner, false).await
    }

    /// Ends all warm containers and makes no more.
    pub async fn end_warm_pool(&self) {
        warm_pool::end_all(&self.inner).await;
    }

    /// Looks after the machine from now on, moves cores where that is wanted, and resizes servants by how large what their
    /// robots send is, and by who of their clients has left; comes back at once.
    pub fn keep_watch(&self) {
        tokio::spawn(lives::controller::watch(Arc::clone(&self.inner)));
        tokio::spawn(lives::measuring::watch(Arc::clone(&self.inner)));
        tokio::spawn(lives::leaving::watch(Arc::clone(&self.inner)));
    }

    /// So often cores were moved.
    pub fn moves(&self) -> u64 {
        self.inner.moves.load(Ordering::Relaxed)
    }

    /// How long requests of robots take.
    pub fn request_times(&self) -> &RequestTimes {
        &self.inner.request_times
    }

    /// Where what happens is told.
    pub fn journal(&self) -> &Journal {
        &self.inner.journal
    }

    /// Requests of robots that are answered from now on.
    pub fn answered(&self) -> broadcast::Receiver<Answered> {
        self.inner.recent.answered()
    }

    /// The longest that the robot of a servant accepts for a request, in milliseconds; none where it has not said.
    pub fn accepts(&self, handle: &Handle) -> Option<f64> {
        let goal = lives::controller::goal(&self.inner, handle)?;
        goal.bound()
    }

    /// Containers of the warm pool, and those of them in which the nodes run.
    pub fn warm_pool(&self) -> (usize, usize) {
        self.inner.warm_pool.count()
    }

    /// Whose servants have failed again and again, and are not started again yet.
    pub fn back_offs(&self) -> Vec<api::BackOff> {
        self.inner.back_offs()
    }

    /// What may be held for clients and servants.
    pub fn memory(&self) -> &Memory {
        &self.inner.memory
    }

    /// What the machine promises.
    pub fn admission(&self) -> &Admission {
        &self.inner.admission
    }

    /// Room for something of a push that is started like a servant of these limits: the memory of those, and the cores that
    /// are set aside for servants that ask for none, since robots go before it there. Calls `on_wait` when there is none at
    /// once. When [`Permit::is_needed`] comes back, a robot waits for it.
    pub async fn admit_like_a_servant(
        &self,
        asked: &api::Limits,
        deadline: Duration,
        on_wait: impl FnOnce(),
    ) -> Result<Permit, Error> {
        let cpus = self.inner.options.reserve_cpus;
        let wanted = self.inner.promised(&api::Limits {
            cpus: Some(asked.cpus.map_or(cpus, |asked| asked.min(cpus))),
            ..*asked
        });
        let make_room = || {
            on_wait();
            self.inner.make_room();
        };
        let admission = &self.inner.admission;
        let stands = watch::Sender::new(None);
        Ok(admission
            .admit(Ask::push(wanted), deadline, stands, make_room)
            .await?)
    }

    /// Limits of a servant where its push says nothing.
    pub fn default_limits(&self) -> api::Limits {
        self.inner.options.limits
    }

    /// Sessions of rosbridge before each servant.
    pub fn bridge_options(&self) -> &BridgeOptions {
        &self.inner.options.bridge
    }

    /// Refuses what a push asks for beyond a container if it is not allowed or not there; answers, in words, what of it
    /// servants will lack.
    pub fn check_grants(&self, asked: &api::Grants) -> Result<Vec<String>, Error> {
        Ok(self.inner.engine.check(asked)?)
    }

    /// Tries the current revision of a service, with a servant that is there for the trial alone.
    pub async fn trial(
        &self,
        service: &str,
        material: Material,
    ) -> Result<api::trial::Trial, Error> {
        let measured = self.measured(service, "try", api::Limits::default())?;
        measured.lease.admitted().await?;
        let reach = measured.lease.ready().await?;
        let interface = &measured.lease.handle().revision.interface;
        let mut pace = Pace::once(TRIED);
        if let Material::Pictures(_) = material {
            pace.again = true;
            pace.requests = SHOWN;
        }
        let replay = reach.replay(service, interface, &material, &pace).await?;
        Ok(replay.into_trial(service))
    }

    /// A servant that serves no robot, to be measured; `why` becomes part of its robot's name. Of a service that robots share
    /// it is one of its own, beside the group. It has the limits of `set` from its start on.
    fn measured(&self, service: &str, why: &str, set: api::Limits) -> Result<Measured, Error> {
        let robot = format!("~{why}-{}", names::random(6));
        let request = ServantRequest::new(service, &robot).setting(set);
        let lease = self.ensure(request.anonymous())?;
        Ok(Measured { lease })
    }

    /// What a robot would get that states this to a service, and why.
    pub fn explain_terms(
        &self,
        service: &str,
        stated: &api::Stated,
    ) -> Result<api::dictionary::Explained, Error> {
        let inner = &self.inner;
        let revision = inner.catalogue.current(service)?;
        inner.offering(&revision, |_| Aux::new(), |offer| explain(stated, offer))
    }

    /// Refuses limits that would never be admitted.
    pub fn check_limits(&self, limits: &api::Limits) -> Result<(), Error> {
        Ok(self.inner.admission.check(self.inner.promised(limits))?)
    }

    /// Images that live servants and warm containers were started from; they must stay.
    pub fn images_in_use(&self) -> Vec<String> {
        let mut images = self.inner.warm_pool.images();
        let servants = self.inner.servants.lock();
        images.extend(
            servants
                .all
                .values()
                .map(|handle| handle.revision.image.clone()),
        );
        images
    }
}

/// A servant that serves no robot; it is ended with this value, also where what measures it is given up halfway.
pub(crate) struct Measured {
    pub(crate) lease: Lease,
}

impl Drop for Measured {
    fn drop(&mut self) {
        self.lease.handle().end("it has been measured");
    }
}

#[cfg(test)]
mod tests;
