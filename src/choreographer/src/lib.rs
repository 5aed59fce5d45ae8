//! Decides which servants live: one for each robot of each service, started when the robot first connects and kept for
//! a grace time after it left; for a shared service a group of servants for all its robots.
//!
//! ```text
//!              no capacity             engine, node or time-out
//!          ┌───────────────┬─────────────┬────────────┬───────────┐
//!          │               │             │            │           ▼
//!      Requested ──▶ Admitted ──▶ Created ──▶ Starting ──▶ Ready ─┬▶ Draining ──▶ Failed
//!      (requested)   (capacity) (container)  (nodes)   (interface)└▶ Draining ──▶ Stopped
//!                                    ▲                   idle, stopped, removed
//!                                    └── adopted: an earlier daemon started it
//! ```
//!
//! The decisions are pure functions in [`decide`] of the current state, the request and the time; the tasks of
//! [`lives`] carry them out, and only these wait, lock and talk to the engine.
//!
//! ```text
//!   robots, stubs, pushes, operators           connections, node exits, the graph, time
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
//! Each servant has one task ([`lives::driver`]) that alone changes its state; everyone else requests its end,
//! registers as a connection ([`Lease`]), and watches. Which robot gets which servant is decided and recorded under one
//! short lock: a servant that is being ended is never given to anyone.

#![forbid(unsafe_code)]

mod decide;
mod description;
mod error;
pub mod limits;
mod lives;
mod memory;
mod options;
mod request;
mod tracer;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use bridge::BridgeOptions;
use catalogue::{Catalogue, names};
use parking_lot::Mutex;
use reach::{Material, Opener, ReplayPace, RequestTimes};
use servant::engine::Engine;
use store::{Journal, State};
use tokio::sync::{broadcast, watch};

pub use decide::Amount;
pub use decide::admission::{AdmissionError, Position};
pub use decide::back_off::seconds;
pub use decide::controller;
pub use decide::dictionary::{MOST_ROWS, RowError, check as check_row};
pub use decide::quota::{Quota, QuotaFile, find_files_to_evict};
pub use decide::terms::{Cap, CapSource, TermsError};
pub use description::usage;
pub use error::{Error, ResizeError, with_last_log_line};
pub use lives::Choreographer;
pub use lives::adoption::AdoptionResult;
pub use lives::calibration::CalibrationRequests;
pub use lives::capture::CaptureBounds;
pub use lives::handle::Handle;
pub use lives::lease::Lease;
pub use lives::recent::AnsweredRequest;
pub use lives::rollouts::check_terms;
pub use lives::waiting::{Admission, Permit, QueueStanding};
pub use memory::{Memory, MemoryOptions};
pub use options::{ClassOptions, DEFAULT_CLASS, HungPolicy, KeptLogOptions, Options};
pub use request::ServantRequest;
pub use tracer::{RequestTracer, TracedServant};

use decide::admission::AdmissionRequest;
use decide::dictionary::Aux;
use decide::placement::{Placement, place};
use decide::terms::explain;
use lives::ChoreographerInner;
use lives::back_off::BackOffs;
use lives::driver::{self, ServantSource};
use lives::group::is_place;
use lives::hung;
use lives::lease::NewStatement;
use lives::warm_pool::{self, WarmPool};

/// Timeout for one answer in a trial: a recorded message without an answer must not delay the rest.
const TRIAL_ANSWER_TIMEOUT: Duration = Duration::from_secs(2);
/// Number of requests with which a picture is tried.
const TRIAL_PICTURES: usize = 20;

impl Choreographer {
    /// Creates a choreographer that starts servants by `engine` and reaches them by `opener`.
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
        let inner = ChoreographerInner {
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
            kept_logs: Default::default(),
            ending: AtomicBool::new(false),
            refusals: Mutex::default(),
        };
        Choreographer { inner: Arc::new(inner) }
    }

    /// Returns a lease of the requested servant: the existing one, or a new one. Returns at once; the lease reports
    /// when the servant can be used, and keeps it alive.
    ///
    /// # Errors
    /// [`Error::Terms`] if a new servant is needed and the terms cannot be granted. The terms for an existing one are
    /// checked by [`Lease::wait_admitted`].
    pub fn ensure(&self, request: ServantRequest) -> Result<Lease, Error> {
        let inner = &self.inner;
        let key = (request.service.clone(), request.robot.clone());
        // Not under the lock, which all other robots wait for: reading the dictionary may take long.
        let is_new = !inner.servants.lock().given.contains_key(&key);
        let ahead = is_new.then(|| inner.terms_ahead(&request)).transpose()?;
        let (handle, lease, warm, takes_canary) = {
            let mut servants = inner.servants.lock();
            // Under the lock: a revision that is published meanwhile ends the servants that it finds, and no servant of
            // the previous revision may be added after that.
            let (revision, takes_canary) = inner.revision_for(&request)?;
            if inner.ending.load(Ordering::SeqCst) {
                return Err(Error::Ending);
            }
            let has = servants.given.get(&key).map(|handle| inner.facts(handle));
            if has.as_ref().is_none_or(|has| has.ending) {
                inner.check_back_off(&revision, &request.robot, request.anonymous)?;
            }
            // A container with promised capacity must not overtake waiting requests, nor have nodes running with more
            // memory than the robot may use.
            let bounded = request.set.memory.is_some();
            let default_names = request.stub.is_none() && !bounded && inner.admission.is_uncontended();
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
                    let lease = Lease::new(Arc::clone(&servants.all[id]), request.client());
                    return Ok(lease.with_statement(NewStatement { inner: Arc::clone(inner), stated: request.stated }));
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
                rollouts.add_canary_robot(&request.service, &request.robot);
            }
            let id = warm.as_ref().map(|warm| warm.container.id().to_owned());
            let who = request.client().to_owned();
            let handle = Arc::new(Handle::new(
                id.unwrap_or_else(|| names::servant_id(&request.service)),
                request.robot,
                request.anonymous,
                decide::demand::LimitSources { set: request.set, ..inner.limit_sources(terms) },
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
            // At once: if this daemon is killed, the next one would otherwise give the canary's place to another robot.
            inner.write_changed();
        }
        let beginning = ServantSource::Asked(warm.map(Box::new));
        driver::start(inner, handle, beginning);
        Ok(lease)
    }

    /// Returns all live servants, oldest first.
    pub fn servants(&self) -> Vec<Arc<Handle>> {
        let mut servants: Vec<_> = self.inner.servants.lock().all.values().cloned().collect();
        servants.sort_by(|one, other| (one.created, &one.id).cmp(&(other.created, &other.id)));
        servants
    }

    /// Returns a servant by id.
    pub fn servant(&self, id: &str) -> Result<Arc<Handle>, Error> {
        let servants = self.inner.servants.lock();
        servants.all.get(id).cloned().ok_or_else(|| {
            let mut exists: Vec<String> = servants.all.keys().cloned().collect();
            exists.sort();
            Error::UnknownServant { id: id.to_owned(), exists }
        })
    }

    /// Ends the servants selected by `chosen` and waits until they are gone; returns their ids.
    pub async fn stop(&self, reason: &str, chosen: impl Fn(&Handle) -> bool) -> Vec<String> {
        let leaving: Vec<Arc<Handle>> = {
            let servants = self.inner.servants.lock();
            let leaving = servants.all.values().filter(|handle| chosen(handle)).cloned().collect::<Vec<_>>();
            for handle in &leaving {
                handle.end(reason);
            }
            leaving
        };
        let mut ids = Vec::new();
        for handle in leaving {
            handle.wait_ended().await;
            ids.push(handle.id.clone());
        }
        ids.sort();
        ids
    }

    /// Stops starting servants.
    pub fn close(&self) {
        let _servants = self.inner.servants.lock();
        self.inner.ending.store(true, Ordering::SeqCst);
    }

    /// Starts maintaining the warm pool; returns at once.
    pub fn keep_warm_pool(&self) {
        tokio::spawn(warm_pool::run(Arc::clone(&self.inner)));
        self.inner.warm_pool.wake();
    }

    /// Starts watching for hung nodes; returns at once.
    pub fn watch_nodes(&self) {
        tokio::spawn(hung::watch(Arc::clone(&self.inner)));
    }

    /// Triggers making warm containers for the published revisions.
    pub fn refill_warm_pool(&self) {
        self.inner.warm_pool.wake();
    }

    /// Ends the warm containers of revisions that are not published any more.
    pub async fn end_stale_warm(&self) -> Result<(), Error> {
        warm_pool::tidy(&self.inner, false).await
    }

    /// Ends all warm containers and makes no more.
    pub async fn end_warm_pool(&self) {
        warm_pool::end_all(&self.inner).await;
    }

    /// Starts watching the machine, moving cores if configured, resizing servants by the size of their robots' messages
    /// and by the clients that have left, and removing old logs of ended servants; returns at once.
    pub fn keep_watch(&self) {
        tokio::spawn(lives::controller::watch(Arc::clone(&self.inner)));
        tokio::spawn(lives::measuring::watch(Arc::clone(&self.inner)));
        tokio::spawn(lives::leaving::watch(Arc::clone(&self.inner)));
        tokio::spawn(lives::kept_logs::watch(Arc::clone(&self.inner)));
    }

    /// Returns how often cores were moved.
    pub fn move_count(&self) -> u64 {
        self.inner.moves.load(Ordering::Relaxed)
    }

    /// Returns the response times of robots' requests.
    pub fn request_times(&self) -> &RequestTimes {
        &self.inner.request_times
    }

    /// Returns what makes traces of robots' requests, if anything does.
    pub fn tracer(&self) -> Option<&dyn RequestTracer> {
        self.inner.options.tracer.as_deref()
    }

    /// Returns the journal of events.
    pub fn journal(&self) -> &Journal {
        &self.inner.journal
    }

    /// Subscribes to answered requests of robots.
    pub fn subscribe_answers(&self) -> broadcast::Receiver<AnsweredRequest> {
        self.inner.recent.subscribe()
    }

    /// Returns the maximum response time that the servant's robot accepts, in milliseconds; `None` if it has not stated
    /// one.
    pub fn accepted_time(&self, handle: &Handle) -> Option<f64> {
        let goal = lives::controller::response_goal(&self.inner, handle)?;
        goal.upper_bound()
    }

    /// Returns the number of containers in the warm pool, and of those with running nodes.
    pub fn warm_pool(&self) -> (usize, usize) {
        self.inner.warm_pool.count()
    }

    /// Returns the robots whose servants have failed repeatedly and are not restarted yet.
    pub fn back_offs(&self) -> Vec<api::BackOff> {
        self.inner.back_offs()
    }

    /// Returns the memory budgets of clients and servants.
    pub fn memory(&self) -> &Memory {
        &self.inner.memory
    }

    /// Returns the admission control of the machine.
    pub fn admission(&self) -> &Admission {
        &self.inner.admission
    }

    /// Admits work of a push that is started like a servant with these limits: with their memory, and at most the
    /// reserved cores of servants without limits, since robots take precedence there. Calls `on_wait` if there is no
    /// capacity at once. When [`Permit::wait_needed`] returns, a robot waits for the capacity.
    pub async fn admit_like_a_servant(
        &self,
        asked: &api::Limits,
        deadline: Duration,
        on_wait: impl FnOnce(),
    ) -> Result<Permit, Error> {
        let cpus = self.inner.options.reserve_cpus;
        let wanted = self
            .inner
            .promised_amount(&api::Limits { cpus: Some(asked.cpus.map_or(cpus, |asked| asked.min(cpus))), ..*asked });
        let make_room = || {
            on_wait();
            self.inner.make_room();
        };
        let admission = &self.inner.admission;
        let stands = watch::Sender::new(None);
        Ok(admission.admit(AdmissionRequest::push(wanted), deadline, stands, make_room).await?)
    }

    /// Returns the limits of servants whose push states none.
    pub fn default_limits(&self) -> api::Limits {
        self.inner.options.limits
    }

    /// Returns the options of the rosbridge sessions of each servant.
    pub fn bridge_options(&self) -> &BridgeOptions {
        &self.inner.options.bridge
    }

    /// Checks the grants requested by a push: refuses those not allowed or not present; returns, in words, what
    /// servants will lack.
    pub fn check_grants(&self, asked: &api::Grants) -> Result<Vec<String>, Error> {
        Ok(self.inner.engine.check_grants(asked)?)
    }

    /// Tries the current revision of a service, with a servant started for the trial only.
    pub async fn trial(&self, service: &str, material: Material) -> Result<api::trial::Trial, Error> {
        let measured = self.start_measured(service, "try", api::Limits::default())?;
        measured.lease.wait_admitted().await?;
        let reach = measured.lease.wait_ready().await?;
        let interface = &measured.lease.handle().revision.interface;
        let mut pace = ReplayPace::once(TRIAL_ANSWER_TIMEOUT);
        if let Material::Pictures(_) = material {
            pace.again = true;
            pace.requests = TRIAL_PICTURES;
        }
        let replay = reach.replay(service, interface, &material, &pace).await?;
        Ok(replay.into_trial(service))
    }

    /// Starts a servant without a robot, to be measured; `why` becomes part of its robot's name. For a shared service
    /// it is a servant of its own, beside the group. It has the limits of `set` from the start.
    fn start_measured(&self, service: &str, why: &str, set: api::Limits) -> Result<MeasuredServant, Error> {
        let robot = format!("~{why}-{}", names::random(6));
        let request = ServantRequest::new(service, &robot).with_limits(set);
        let lease = self.ensure(request.anonymous())?;
        Ok(MeasuredServant { lease })
    }

    /// Returns what a robot with this statement would get from a service, and why.
    pub fn explain_terms(&self, service: &str, stated: &api::Stated) -> Result<api::dictionary::Explained, Error> {
        let inner = &self.inner;
        let revision = inner.catalogue.current_revision(service)?;
        inner.with_offer(&revision, |_| Aux::new(), |offer| explain(stated, offer))
    }

    /// Refuses limits that can never be admitted.
    pub fn check_limits(&self, limits: &api::Limits) -> Result<(), Error> {
        Ok(self.inner.admission.check(self.inner.promised_amount(limits))?)
    }

    /// Returns the images of live servants and warm containers, which must be kept.
    pub fn images_in_use(&self) -> Vec<String> {
        let mut images = self.inner.warm_pool.images();
        let servants = self.inner.servants.lock();
        images.extend(servants.all.values().map(|handle| handle.revision.image.clone()));
        images
    }
}

/// A servant without a robot; it is ended when this value is dropped, also if the measurement is cancelled.
pub(crate) struct MeasuredServant {
    pub(crate) lease: Lease,
}

impl Drop for MeasuredServant {
    fn drop(&mut self) {
        self.lease.handle().end("its measurement is complete");
    }
}

#[cfg(test)]
mod tests;
