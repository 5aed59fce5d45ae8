//! The tasks that carry out what was decided: one for each servant ([`driver`]), which alone changes its state, and one that
//! keeps the warm pool ([`warm_pool`]), and one that looks at the machine and moves cores ([`controller`]). Servants of an earlier daemon are taken over here ([`adoption`]).

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

use crate::decide::capacity::Room;
use crate::decide::demand::{self, Asked};
use crate::decide::dictionary::Aux;
use crate::decide::terms::{Offer, terms};
use crate::decide::told::Told;
use crate::decide::{Amount, End, Servant, capacity};
use crate::lives::handle::Handle;
use crate::memory::SharedMemory;
use crate::options::Options;
use crate::{Error, ServantRequest};
use back_off::BackOffs;
use group::Groups;
use recent::Recent;
use rollouts::Rollouts;
use waiting::Admission;
use warm_pool::WarmPool;

/// What the choreographer and its tasks share.
pub(crate) struct Inner {
    pub(crate) options: Options,
    pub(crate) state: Arc<State>,
    pub(crate) journal: Journal,
    pub(crate) catalogue: Arc<Catalogue>,
    pub(crate) engine: Arc<dyn Engine>,
    pub(crate) opener: Arc<dyn Opener>,
    pub(crate) admission: Admission,
    pub(crate) request_times: Arc<RequestTimes>,
    pub(crate) recent: Arc<Recent>,
    /// So often the controller has changed what a servant has.
    pub(crate) moves: AtomicU64,
    pub(crate) memory: SharedMemory,
    pub(crate) servants: Mutex<Servants>,
    pub(crate) warm_pool: WarmPool,
    pub(crate) groups: Groups,
    pub(crate) back_offs: BackOffs,
    pub(crate) rollouts: Arc<Rollouts>,
    /// Images whose nodes did not show all of their interface although they had all the time of a start.
    pub(crate) incomplete: Mutex<BTreeSet<String>>,
    pub(crate) ending: AtomicBool,
    /// Of which refusals was told.
    pub(crate) refusals: Mutex<Told>,
}

#[derive(Default)]
pub(crate) struct Servants {
    /// All that live, by id.
    pub(crate) all: HashMap<String, Arc<Handle>>,
    /// Those that a robot may be given, by service and robot.
    pub(crate) given: HashMap<(String, String), Arc<Handle>>,
}

impl Inner {
    pub(crate) fn is_ending(&self) -> bool {
        self.ending.load(Ordering::SeqCst)
    }

    /// The limits of a servant of this revision where no robot stated anything.
    pub(crate) fn of_push(&self, revision: &RevisionRecord) -> Asked {
        // Where it cannot be found out whose it is, it is no operator's.
        let limits = if self.is_deployers(&revision.service).unwrap_or(true) {
            demand::with_bounded_weight(revision.plan.limits)
        } else {
            revision.plan.limits
        };
        self.asked(api::Terms {
            limits,
            ..api::Terms::default()
        })
    }

    /// The limits of a servant that its robot has on these terms.
    pub(crate) fn asked(&self, terms: api::Terms) -> Asked {
        Asked {
            set: api::Limits::default(),
            terms,
            default: self.options.limits,
        }
    }

    /// The terms for what the clients of one robot state to a servant of this revision.
    pub(crate) fn terms(
        &self,
        stated: &BTreeMap<String, api::Stated>,
        revision: &RevisionRecord,
    ) -> Result<api::Terms, Error> {
        self.offering(revision, |_| Aux::new(), |offer| Ok(terms(stated, offer)?))?
    }

    /// The terms of a servant of the revision that a robot would be given now.
    #[allow(clippy::type_complexity)]
    pub(crate) fn terms_ahead(
        &self,
        request: &ServantRequest,
    ) -> Result<(Arc<RevisionRecord>, Result<api::Terms, Error>), Error> {
        let (revision, _) = self.revision_for(request)?;
        let terms = self.terms(&request.statement(), &revision);
        Ok((revision, terms))
    }

    /// What terms for a servant of this revision are made from; `measured` says, of the dictionary's rows, which auxiliary
    /// parameters of its robot were measured.
    pub(crate) fn offering<T>(
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
            capacity: self.admission.look().0,
        }))
    }

    /// Whether a deployer, and no operator, publishes a service.
    fn is_deployers(&self, service: &str) -> Result<bool, Error> {
        Ok(self.state.service_owner(service)?.flatten().is_some())
    }

    /// What is promised to a servant of these limits.
    pub(crate) fn promised(&self, asked: &api::Limits) -> Amount {
        let options = &self.options;
        demand::promised(asked, (options.reserve_cpus, options.reserve_memory))
    }

    /// A servant as decisions see it.
    pub(crate) fn facts<'a>(&self, handle: &'a Handle) -> Servant<'a> {
        let admitted = handle.promise().is_some();
        Servant {
            id: &handle.id,
            revision: handle.revision.number,
            connections: handle.connections(),
            promised: admitted.then(|| self.promised(&handle.asked())),
            idle_until: handle.idle_until(),
            ending: handle.is_ending(),
        }
    }

    /// Ends servants that were made ahead, then idle ones, and has pushes give way, for those who wait for capacity.
    pub(crate) fn make_room(self: &Arc<Self>) {
        let servants = self.servants.lock();
        let warm = self.warm_pool.promised(self);
        let warm = warm_facts(&warm);
        let all = servants.all.values().map(|handle| self.facts(handle));
        let (lacking, pushes) = self.admission.lacking();
        let Room { ends, give_way } = capacity::make_room(lacking, warm.chain(all), &pushes);
        let (warm, used): (Vec<End<'_>>, Vec<End<'_>>) = ends
            .into_iter()
            .partition(|end| !servants.all.contains_key(end.id));
        for end in warm {
            self.warm_pool.end_for_room(self, end.id);
        }
        servants.end(used);
        self.admission.give_way(&give_way);
    }

    /// Takes the servant out of reach if nobody is connected; true when so.
    pub(crate) fn retire_if_idle(&self, handle: &Arc<Handle>) -> bool {
        let mut servants = self.servants.lock();
        let idle = handle.connections() == 0;
        if idle {
            servants.take_back(handle);
        }
        idle
    }

    /// Takes the servant out of reach.
    pub(crate) fn retire(&self, handle: &Arc<Handle>) {
        self.servants.lock().take_back(handle);
    }

    pub(crate) fn forget(&self, handle: &Arc<Handle>) {
        let mut servants = self.servants.lock();
        servants.take_back(handle);
        servants.all.remove(&handle.id);
    }
}

/// Containers that were made ahead and are promised something, as decisions see them: id, promise, whether it ends.
pub(crate) fn warm_facts(warm: &[(String, Amount, bool)]) -> impl Iterator<Item = Servant<'_>> {
    warm.iter().map(|(id, promised, ending)| Servant {
        id,
        revision: 0,
        connections: 0,
        promised: Some(*promised),
        // Before any that a robot may come back to.
        idle_until: Some(0),
        ending: *ending,
    })
}

impl Servants {
    /// Asks for the end of those that are to end.
    pub(crate) fn end<'a>(&self, ends: impl IntoIterator<Item = End<'a>>) {
        for end in ends {
            self.all[end.id].end(end.reason);
        }
    }

    fn take_back(&mut self, handle: &Arc<Handle>) {
        let key = (handle.service().to_owned(), handle.robot.clone());
        if self
            .given
            .get(&key)
            .is_some_and(|given| Arc::ptr_eq(given, handle))
        {
            self.given.remove(&key);
        }
    }
}
