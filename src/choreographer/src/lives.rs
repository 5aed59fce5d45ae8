//! The tasks that carry decisions out: one for each servant ([`driver`]), which alone changes its state, one that
//! maintains the warm pool ([`warm_pool`]), and one that watches the machine and moves cores ([`controller`]). Servants
//! of an earlier daemon are taken over here ([`adoption`]).

pub(crate) mod adoption;
pub(crate) mod back_off;
pub(crate) mod calibration;
pub(crate) mod capture;
pub(crate) mod controller;
pub(crate) mod driver;
mod fit;
pub(crate) mod group;
pub(crate) mod handle;
pub(crate) mod hung;
pub(crate) mod kept_logs;
pub(crate) mod lease;
pub(crate) mod leaving;
mod lifetime;
pub(crate) mod limits;
pub(crate) mod measuring;
mod nodes;
pub(crate) mod reaching;
pub(crate) mod recent;
pub(crate) mod rollouts;
pub(crate) mod shadow;
mod shared_group;
mod starting;
mod visits;
pub(crate) mod waiting;
pub(crate) mod warm_pool;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use api::dictionary::Row;
use catalogue::Catalogue;
use parking_lot::Mutex;
use reach::{Opener, RequestTimes};
use servant::engine::Engine;
use store::{Journal, RevisionRecord, State};

use crate::decide::capacity::RoomPlan;
use crate::decide::demand::{self, LimitSources};
use crate::decide::dictionary::Aux;
use crate::decide::refusal_reports::RefusalLog;
use crate::decide::terms::{Offer, compute_terms};
use crate::decide::{Amount, ServantFacts, StopOrder, capacity};
use crate::lives::handle::Handle;
use crate::memory::SharedMemory;
use crate::options::Options;
use crate::{Error, ServantRequest};
use back_off::BackOffs;
use kept_logs::KeptLogs;
use recent::RecentRequests;
use rollouts::Rollouts;
use shared_group::Groups;
use waiting::Admission;
use warm_pool::WarmPool;

/// Decides which servants live. Cheap to clone.
#[derive(Clone)]
pub struct Choreographer {
    pub(crate) inner: Arc<ChoreographerInner>,
}

/// State shared by the choreographer and its tasks.
pub(crate) struct ChoreographerInner {
    pub(crate) options: Options,
    pub(crate) state: Arc<State>,
    pub(crate) journal: Journal,
    pub(crate) catalogue: Arc<Catalogue>,
    pub(crate) engine: Arc<dyn Engine>,
    pub(crate) opener: Arc<dyn Opener>,
    pub(crate) admission: Admission,
    pub(crate) request_times: Arc<RequestTimes>,
    pub(crate) recent: Arc<RecentRequests>,
    /// Number of times the controller has changed a servant's cores.
    pub(crate) moves: AtomicU64,
    pub(crate) memory: SharedMemory,
    pub(crate) servants: Mutex<Servants>,
    pub(crate) warm_pool: WarmPool,
    pub(crate) groups: Groups,
    pub(crate) back_offs: BackOffs,
    pub(crate) rollouts: Arc<Rollouts>,
    /// Images whose nodes did not register all of their interface within the full start time.
    pub(crate) incomplete: Mutex<BTreeSet<String>>,
    pub(crate) kept_logs: KeptLogs,
    pub(crate) ending: AtomicBool,
    /// Recently reported refusals.
    pub(crate) refusals: Mutex<RefusalLog>,
}

#[derive(Default)]
pub(crate) struct Servants {
    /// All live servants, by id.
    pub(crate) all: HashMap<String, Arc<Handle>>,
    /// Servants that a robot may be given, by service and robot.
    pub(crate) given: HashMap<(String, String), Arc<Handle>>,
}

impl ChoreographerInner {
    pub(crate) fn is_ending(&self) -> bool {
        self.ending.load(Ordering::SeqCst)
    }

    /// Returns the limits of a servant of this revision whose robot stated nothing.
    pub(crate) fn push_limits(&self, revision: &RevisionRecord) -> LimitSources {
        // If the owner is unknown, the service is treated as a deployer's.
        let limits = if self.is_deployers(&revision.service).unwrap_or(true) {
            demand::with_bounded_weight(revision.plan.limits)
        } else {
            revision.plan.limits
        };
        self.limit_sources(api::Terms { limits, ..api::Terms::default() })
    }

    /// Returns the limits of a servant with these terms.
    pub(crate) fn limit_sources(&self, terms: api::Terms) -> LimitSources {
        LimitSources { set: api::Limits::default(), terms, default: self.options.limits }
    }

    /// Derives the terms of a servant of this revision from the statements of one robot's clients.
    pub(crate) fn terms(
        &self,
        stated: &BTreeMap<String, api::Stated>,
        revision: &RevisionRecord,
    ) -> Result<api::Terms, Error> {
        self.with_offer(revision, |_| Aux::new(), |offer| Ok(compute_terms(stated, offer)?))?
    }

    /// Derives the terms of a servant of the revision that a robot would be given now.
    #[allow(clippy::type_complexity)]
    pub(crate) fn terms_ahead(
        &self,
        request: &ServantRequest,
    ) -> Result<(Arc<RevisionRecord>, Result<api::Terms, Error>), Error> {
        let (revision, _) = self.revision_for(request)?;
        let terms = self.terms(&request.statement(), &revision);
        Ok((revision, terms))
    }

    /// Calls `work` with the context from which terms for a servant of this revision are derived; `measured` returns,
    /// given the dictionary's rows, the measured auxiliary parameters of its robot.
    pub(crate) fn with_offer<T>(
        &self,
        revision: &RevisionRecord,
        measured: impl FnOnce(&[Row]) -> Aux,
        work: impl FnOnce(&Offer<'_>) -> T,
    ) -> Result<T, Error> {
        let options = &self.options;
        let rows = self.state.dictionary(&revision.service)?;
        Ok(work(&Offer {
            service: &revision.service,
            limits: revision.plan.limits,
            is_deployers: self.is_deployers(&revision.service)?,
            caps: revision.plan.caps,
            classes: &options.classes,
            rows: &rows,
            measured: &measured(&rows),
            reserve: (options.reserve_cpus, options.reserve_memory),
            capacity: self.admission.snapshot().0,
        }))
    }

    /// Returns true if the service belongs to a deployer rather than an operator.
    fn is_deployers(&self, service: &str) -> Result<bool, Error> {
        Ok(self.state.service_owner(service)?.flatten().is_some())
    }

    /// Returns the capacity promised to a servant with these limits.
    pub(crate) fn promised_amount(&self, asked: &api::Limits) -> Amount {
        let options = &self.options;
        demand::promised_amount(asked, (options.reserve_cpus, options.reserve_memory))
    }

    /// Returns a servant as input for decisions.
    pub(crate) fn facts<'a>(&self, handle: &'a Handle) -> ServantFacts<'a> {
        let admitted = handle.promise().is_some();
        ServantFacts {
            id: &handle.id,
            revision: handle.revision.number,
            connections: handle.connections(),
            promised: admitted.then(|| self.promised_amount(&handle.requested_limits())),
            idle_until: handle.idle_until(),
            ending: handle.is_ending(),
        }
    }

    /// Makes room for waiting requests: ends prepared servants, then idle ones, and asks pushes to give way.
    pub(crate) fn make_room(self: &Arc<Self>) {
        let servants = self.servants.lock();
        let warm = self.warm_pool.promised_servants(self);
        let warm = warm_facts(&warm);
        let all = servants.all.values().map(|handle| self.facts(handle));
        let (lacking, pushes) = self.admission.shortage();
        let RoomPlan { ends, give_way } = capacity::make_room(lacking, warm.chain(all), &pushes);
        let (warm, used): (Vec<StopOrder<'_>>, Vec<StopOrder<'_>>) =
            ends.into_iter().partition(|end| !servants.all.contains_key(end.id));
        for end in warm {
            self.warm_pool.end_for_room(self, end.id);
        }
        servants.end(used);
        self.admission.give_way(&give_way);
    }

    /// Withdraws the servant from its robot if no client is connected; returns true if so.
    pub(crate) fn retire_if_idle(&self, handle: &Arc<Handle>) -> bool {
        let mut servants = self.servants.lock();
        let idle = handle.connections() == 0;
        if idle {
            servants.unassign(handle);
        }
        idle
    }

    /// Withdraws the servant from its robot.
    pub(crate) fn retire(&self, handle: &Arc<Handle>) {
        self.servants.lock().unassign(handle);
    }

    pub(crate) fn forget(&self, handle: &Arc<Handle>) {
        let mut servants = self.servants.lock();
        servants.unassign(handle);
        servants.all.remove(&handle.id);
    }
}

/// Returns prepared containers with a promise as input for decisions; given as id, promise, and whether it is being
/// ended.
pub(crate) fn warm_facts(warm: &[(String, Amount, bool)]) -> impl Iterator<Item = ServantFacts<'_>> {
    warm.iter().map(|(id, promised, ending)| ServantFacts {
        id,
        revision: 0,
        connections: 0,
        promised: Some(*promised),
        // Before any servant that a robot may come back to.
        idle_until: Some(0),
        ending: *ending,
    })
}

impl Servants {
    /// Requests the end of these servants.
    pub(crate) fn end<'a>(&self, ends: impl IntoIterator<Item = StopOrder<'a>>) {
        for end in ends {
            self.all[end.id].end(end.reason);
        }
    }

    fn unassign(&mut self, handle: &Arc<Handle>) {
        let key = (handle.service().to_owned(), handle.robot.clone());
        if self.given.get(&key).is_some_and(|given| Arc::ptr_eq(given, handle)) {
            self.given.remove(&key);
        }
    }
}
