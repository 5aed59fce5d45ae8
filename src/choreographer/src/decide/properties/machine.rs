//! The machine of the property tests: simulates what the daemon does with decisions on plain data, and checks the
//! invariants.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use super::{MachineStep, SERVICES};
use crate::decide::admission::{
    AdmissionLedger, AdmissionRequest, AdmissionVerdict, AdmittedRequest, MAX_OVERTAKES, Ticket,
};
use crate::decide::capacity::{PushPromise, RoomPlan};
use crate::decide::lifetime::{Retention, ServantStage, Tenancy, retention};
use crate::decide::placement::{Placement, place};
use crate::decide::warm_pool::{
    PoolShortage, PoolSize, WantedPool, WarmContainer, choose_container, deserving_services, pool_shortage,
    stale_containers,
};
use crate::decide::{Amount, ServantFacts, StopOrder, capacity};

const GRACE: Duration = Duration::from_secs(60);
const QUEUE: usize = 4;
const POOL: usize = 2;

fn cores(millicpus: u64) -> Amount {
    Amount { millicpus, memory: 0 }
}

struct ModelServant {
    id: String,
    ticket: Ticket,
    key: (usize, usize),
    revision: u64,
    stage: ServantStage,
    wants: Amount,
    promised: Option<Amount>,
    connections: usize,
    idle_since: Option<Instant>,
    ending: bool,
}

impl ModelServant {
    /// Robot 0 gives no name.
    fn anonymous(&self) -> bool {
        self.key.1 == 0
    }

    fn tenancy(&self) -> Tenancy {
        Tenancy {
            stage: self.stage,
            adopted: false,
            anonymous: self.anonymous(),
            connections: self.connections,
            idle_since: self.idle_since,
            grace: if self.anonymous() { Duration::ZERO } else { GRACE },
        }
    }

    fn facts(&self, began: Instant) -> ServantFacts<'_> {
        let until = |since: Instant| (since - began + GRACE).as_millis() as u64;
        ServantFacts {
            id: &self.id,
            revision: self.revision,
            connections: self.connections,
            promised: self.promised,
            idle_until: self.idle_since.map(until),
            ending: self.ending,
        }
    }
}

struct ModelWarm {
    id: String,
    service: usize,
    revision: u64,
    runs: bool,
    /// Capacity promised to its running nodes.
    promised: Option<Amount>,
}

impl ModelWarm {
    /// Returns it as an unused servant.
    fn as_idle_servant(&self) -> ServantFacts<'_> {
        ServantFacts {
            id: &self.id,
            revision: self.revision,
            connections: 0,
            promised: self.promised,
            idle_until: Some(0),
            ending: false,
        }
    }

    fn facts(&self) -> WarmContainer<'_> {
        WarmContainer {
            id: &self.id,
            service: SERVICES[self.service].0,
            revision: self.revision,
            image: "an image",
            runs: self.runs,
            nodes: self.promised.is_some(),
        }
    }
}

/// A waiting or admitted push.
#[derive(Default)]
struct ModelPush {
    promised: Option<Amount>,
    gives_way: bool,
}

/// A robot in the queue.
struct QueuedRobot {
    ticket: Ticket,
    priority: i32,
    /// Number of later robots that were admitted before it.
    overtaken: u32,
}

pub(super) struct MachineModel {
    began: Instant,
    now: Instant,
    book: AdmissionLedger,
    servants: Vec<ModelServant>,
    /// Ids of the servants that may be given, by service and robot.
    given: BTreeMap<(usize, usize), String>,
    pushes: BTreeMap<Ticket, ModelPush>,
    pool: Vec<ModelWarm>,
    asked_for: Vec<String>,
    revisions: [u64; SERVICES.len()],
    /// Waiting robots, in order of arrival.
    line: Vec<QueuedRobot>,
    made: u64,
    /// Containers that were given to a robot.
    used: BTreeSet<String>,
}

fn nth<T>(all: impl Iterator<Item = T>, which: usize) -> Option<T> {
    let mut all: Vec<T> = all.collect();
    (!all.is_empty()).then(|| all.swap_remove(which % all.len()))
}

impl MachineModel {
    pub(super) fn new() -> MachineModel {
        let now = Instant::now();
        MachineModel {
            began: now,
            now,
            book: AdmissionLedger::new(cores(4000), QUEUE),
            servants: Vec::new(),
            given: BTreeMap::new(),
            pushes: BTreeMap::new(),
            pool: Vec::new(),
            asked_for: Vec::new(),
            revisions: [1; SERVICES.len()],
            line: Vec::new(),
            made: 0,
            used: BTreeSet::new(),
        }
    }

    fn next_id(&mut self) -> (Ticket, String) {
        self.made += 1;
        (self.made, format!("made-{}", self.made))
    }

    fn servant(&mut self, id: &str) -> &mut ModelServant {
        let found = self.servants.iter_mut().find(|servant| servant.id == id);
        found.expect("decisions are about servants that live")
    }

    /// Requests the end of a servant. It stays where its robot finds it until its task has seen that.
    fn end(&mut self, id: &str) {
        let servant = self.servant(id);
        assert!(!servant.ending, "{id} is being ended already");
        servant.ending = true;
        let (queued, ticket) = (servant.stage == ServantStage::Queued, servant.ticket);
        if queued {
            self.line.retain(|one| one.ticket != ticket);
            let admitted = self.book.withdraw(ticket);
            self.apply_admitted(admitted);
        }
    }

    /// Handles admissions: robots of one priority in order of arrival, and none is overtaken without bound.
    fn apply_admitted(&mut self, admitted: Vec<AdmittedRequest>) {
        for AdmittedRequest { ticket, amount } in admitted {
            assert_eq!(self.book.stall_reason(), None);
            if let Some(push) = self.pushes.get_mut(&ticket) {
                push.promised = Some(amount);
                continue;
            }
            let at = self.line.iter().position(|one| one.ticket == ticket);
            let stood = self.line.remove(at.expect("who waits is in the line"));
            self.record_overtaking(at.unwrap_or_default(), stood.priority);
            let servant = self.servants.iter_mut().find(|one| one.ticket == ticket);
            let servant = servant.expect("who waits is there");
            assert!(!servant.ending, "it waits no longer");
            servant.promised = Some(amount);
            servant.stage = ServantStage::Admitted;
        }
    }

    /// Records that a robot of this priority is admitted before the earlier ones, the first of the queue.
    fn record_overtaking(&mut self, earlier: usize, priority: i32) {
        for one in &mut self.line[..earlier] {
            assert!(one.priority < priority, "a robot was overtaken");
            one.overtaken += 1;
            assert!(one.overtaken <= MAX_OVERTAKES, "a robot waits for ever");
        }
    }

    fn make_room(&mut self) {
        let lacking = self.book.shortage();
        let began = self.began;
        let pushes: Vec<PushPromise> = self
            .pushes
            .iter()
            .filter_map(|(ticket, push)| {
                Some(PushPromise { ticket: *ticket, has: push.promised?, gives_way: push.gives_way })
            })
            .collect();
        let decide = || {
            let used = self.servants.iter().map(|it| it.facts(began));
            let all = self.pool.iter().map(ModelWarm::as_idle_servant).chain(used);
            capacity::make_room(lacking, all, &pushes)
        };
        let RoomPlan { ends, give_way } = decide();
        assert_eq!(ends, decide().ends, "the same facts, another decision");
        let having = |ids: &[StopOrder<'_>], pushes: &[Ticket]| {
            let all = self.servants.iter();
            let free = all.filter(|it| it.ending || ids.iter().any(|end| end.id == it.id));
            let free = free.filter_map(|it| it.promised);
            let pooled = self.pool.iter();
            let pooled = pooled.filter(|it| ids.iter().any(|end| end.id == it.id));
            let pooled = pooled.filter_map(|it| it.promised);
            let leave = self.pushes.iter();
            let leave = leave.filter(|(ticket, it)| it.gives_way || pushes.contains(ticket));
            let leave = leave.filter_map(|(_, it)| it.promised);
            free.chain(pooled).chain(leave).fold(Amount::NONE, Amount::plus)
        };
        let warm = |id: &str| self.pool.iter().any(|it| it.id == id);
        let order: Vec<bool> = ends.iter().map(|end| warm(end.id)).collect();
        assert!(order.is_sorted_by(|one, other| one >= other), "a robot's servant ends before what was made ahead");
        if let Some((_, others)) = ends.split_last() {
            assert_ne!(lacking.all.minus(having(others, &[])), Amount::NONE, "one end too many");
        }
        let first = lacking.first_robot;
        let every: Vec<Ticket> = self.pushes.keys().copied().collect();
        assert!(
            first.minus(having(&ends, &give_way)) == Amount::NONE || first.minus(having(&ends, &every)) != Amount::NONE,
            "a push keeps a robot from being admitted"
        );
        if let Some((_, others)) = give_way.split_last() {
            assert_ne!(first.minus(having(&ends, others)), Amount::NONE, "one push too many");
        }
        let ids: Vec<String> = ends.iter().map(|end| end.id.to_owned()).collect();
        for id in ids {
            if let Some(index) = self.pool.iter().position(|it| it.id == id) {
                let warm = self.pool.remove(index);
                let admitted = self.book.release(warm.promised.unwrap_or_default());
                self.apply_admitted(admitted);
                continue;
            }
            let servant = self.servant(&id);
            assert!(servant.connections == 0 && servant.stage == ServantStage::Ready);
            self.end(&id);
        }
        for ticket in give_way {
            if let Some(push) = self.pushes.get_mut(&ticket) {
                push.gives_way = true;
            }
        }
    }

    /// Returns how much more capacity would have to be free for all waiting robots.
    fn shortage_for_robots(&self) -> Amount {
        let waiting = self.servants.iter().filter(|it| self.line.iter().any(|one| one.ticket == it.ticket));
        let wanted = waiting.fold(Amount::NONE, |sum, it| sum.plus(it.wants));
        wanted.minus(self.book.capacity().minus(self.book.promised_total()))
    }

    fn request_servant(&mut self, service: usize, robot: usize, priority: i32) {
        let began = self.began;
        let key = (service, robot);
        let name = SERVICES[service].0;
        self.asked_for.retain(|it| it != name);
        self.asked_for.push(name.to_owned());
        let current = self.revisions[service];
        let has = self.given.get(&key).map(|id| {
            let found = self.servants.iter().find(|servant| &servant.id == id);
            found.expect("what is given lives")
        });
        let facts = has.map(|it| it.facts(began));
        let default_names = robot % 2 == 0 && self.book.is_uncontended();
        let of = (name, current, "an image");
        let warm = choose_container(self.pool.iter().map(ModelWarm::facts), of, default_names);
        let decide = || place(facts.as_ref(), warm.as_ref(), current, "an image");
        let placement = decide();
        assert_eq!(placement, decide(), "the same facts, another decision");
        let chosen = warm.map(|warm| warm.id.to_owned());
        let (ends, warm) = match placement {
            Placement::Keep(id) => {
                let id = id.to_owned();
                let servant = self.servant(&id);
                assert!(!servant.ending, "a servant that is being ended was given");
                servant.connections += 1;
                servant.idle_since = None;
                return;
            }
            Placement::Start { ends, warm } => (ends.map(|end| end.id.to_owned()), warm),
        };
        if let Some(id) = ends {
            assert_eq!(self.servant(&id).connections, 0, "its robot uses it");
            self.end(&id);
        }
        let (ticket, fresh) = self.next_id();
        let mut ahead = None;
        let warm = chosen.filter(|_| warm).map(|id| {
            let index = self.pool.iter().position(|it| it.id == id);
            let warm = self.pool.remove(index.expect("the pool has it"));
            let of = (warm.service, warm.revision, warm.runs);
            assert_eq!(of, (service, current, true));
            assert!(robot % 2 == 0 || warm.promised.is_none(), "it has other names");
            ahead = warm.promised;
            assert!(self.used.insert(warm.id.clone()), "two robots have the same container");
            warm.id
        });
        let wants = cores(SERVICES[service].1);
        let (verdict, others) = match ahead {
            Some(_) => (AdmissionVerdict::Admitted, Vec::new()),
            None => self.book.request(ticket, AdmissionRequest::robot(wants, priority)),
        };
        let promised = match verdict {
            AdmissionVerdict::Admitted => {
                self.record_overtaking(self.line.len(), priority);
                Some(wants)
            }
            AdmissionVerdict::Waits => None,
            AdmissionVerdict::Refused(_) => {
                assert_eq!(others, [], "nobody was overtaken");
                return;
            }
        };
        self.apply_admitted(others);
        let id = warm.unwrap_or(fresh);
        self.given.insert(key, id.clone());
        self.servants.push(ModelServant {
            id,
            ticket,
            key,
            revision: current,
            stage: if promised.is_some() { ServantStage::Admitted } else { ServantStage::Queued },
            wants,
            promised,
            connections: 1,
            idle_since: None,
            ending: false,
        });
        if promised.is_none() {
            self.line.push(QueuedRobot { ticket, priority, overtaken: 0 });
            self.make_room();
        }
    }

    fn tidy(&mut self) {
        let published: Vec<String> = SERVICES.iter().map(|it| it.0.to_owned()).collect();
        let wanted = deserving_services(&published, &self.asked_for, POOL);
        let number = |name: &String| SERVICES.iter().position(|it| it.0 == name).expect("known");
        let wanted: Vec<usize> = wanted.iter().map(number).collect();
        let revisions = self.revisions;
        let facts: Vec<WantedPool<'_>> = wanted
            .iter()
            .map(|service| WantedPool {
                service: SERVICES[*service].0,
                revision: revisions[*service],
                image: "an image",
                size: PoolSize { makes: 1, keeps: 1 + *service, nodes: 1 },
            })
            .collect();
        let pool: Vec<WarmContainer<'_>> = self.pool.iter().map(ModelWarm::facts).collect();
        let ends = stale_containers(&pool, &facts);
        let ends: Vec<String> = ends.iter().map(|end| end.id.to_owned()).collect();
        for id in &ends {
            assert!(!self.used.contains(id), "{id} is a robot's");
        }
        for id in ends {
            let index = self.pool.iter().position(|it| it.id == id);
            let warm = self.pool.remove(index.expect("it is the pool's"));
            let admitted = self.book.release(warm.promised.unwrap_or_default());
            self.apply_admitted(admitted);
        }
        for (service, wanted) in wanted.into_iter().zip(&facts) {
            loop {
                let pool: Vec<WarmContainer<'_>> = self.pool.iter().map(ModelWarm::facts).collect();
                match pool_shortage(&pool, wanted) {
                    PoolShortage::Nothing => break,
                    PoolShortage::Containers(_) => {
                        let (_, id) = self.next_id();
                        self.pool.push(ModelWarm {
                            id,
                            service,
                            revision: revisions[service],
                            runs: true,
                            promised: None,
                        });
                    }
                    PoolShortage::Nodes(id) => {
                        let (id, before) = (id.to_owned(), self.book.clone());
                        let wants = cores(SERVICES[service].1);
                        if !self.book.take_spare(wants) {
                            assert_eq!(self.book, before, "refused, and yet promised");
                            break;
                        }
                        assert_eq!(before.waiting_count(), 0, "those who wait were overtaken");
                        let warm = self.pool.iter_mut().find(|it| it.id == id);
                        warm.expect("it is the pool's").promised = Some(wants);
                    }
                }
            }
        }
        assert!(self.pool.iter().filter(|it| it.promised.is_some()).count() <= POOL);
    }

    pub(super) fn apply(&mut self, step: MachineStep) {
        match step {
            MachineStep::Asks { service, robot, priority } => self.request_servant(service, robot, priority),
            MachineStep::Leaves(which) => {
                let used = self.servants.iter_mut().filter(|it| it.connections > 0);
                if let Some(servant) = nth(used, which) {
                    servant.connections -= 1;
                }
            }
            MachineStep::Proceeds(which) => {
                let admitted = self.servants.iter_mut();
                let admitted = admitted.filter(|it| it.promised.is_some() && !it.ending);
                if let Some(servant) = nth(admitted, which) {
                    servant.stage = match servant.stage {
                        ServantStage::Queued | ServantStage::Admitted => ServantStage::Starting,
                        ServantStage::Starting | ServantStage::Ready => ServantStage::Ready,
                    };
                }
            }
            MachineStep::Stopped(which) => {
                let lives = self.servants.iter().filter(|it| !it.ending);
                if let Some(id) = nth(lives.map(|it| it.id.clone()), which) {
                    self.end(&id);
                }
            }
            MachineStep::Gone(which) => {
                let ending = self.servants.iter().filter(|it| it.ending);
                if let Some(id) = nth(ending.map(|it| it.id.clone()), which) {
                    let index = self.servants.iter().position(|it| it.id == id);
                    let gone = self.servants.remove(index.expect("just seen"));
                    if self.given.get(&gone.key) == Some(&gone.id) {
                        self.given.remove(&gone.key);
                    }
                    let admitted = self.book.release(gone.promised.unwrap_or_default());
                    self.apply_admitted(admitted);
                    self.make_room();
                }
            }
            MachineStep::Resized(which, size) => {
                let running = self.servants.iter().filter(|it| it.promised.is_some());
                if let Some(id) = nth(running.map(|it| it.id.clone()), which) {
                    let promised = self.servant(&id).promised.unwrap_or_default();
                    let (before, lacked) = (self.book.clone(), self.shortage_for_robots());
                    match self.book.change_promise(promised, cores(size)) {
                        Ok(admitted) => {
                            self.servant(&id).promised = Some(cores(size));
                            self.apply_admitted(admitted);
                        }
                        Err(_) => assert_eq!(self.book, before, "refused, and yet changed"),
                    }
                    let grew = !cores(size).fits(promised);
                    assert!(!grew || self.shortage_for_robots().fits(lacked), "a servant overtook who waits");
                }
            }
            MachineStep::GivesUp(which) => {
                let queued = self.servants.iter();
                let queued = queued.filter(|it| it.stage == ServantStage::Queued && !it.ending);
                if let Some(id) = nth(queued.map(|it| it.id.clone()), which) {
                    self.end(&id);
                }
            }
            MachineStep::Pushes(size) => {
                let (ticket, _) = self.next_id();
                let (verdict, others) = self.book.request(ticket, AdmissionRequest::push(cores(size)));
                let promised = match verdict {
                    AdmissionVerdict::Admitted => {
                        assert!(self.line.is_empty(), "a push goes before a robot");
                        Some(cores(size))
                    }
                    AdmissionVerdict::Waits => None,
                    AdmissionVerdict::Refused(_) => {
                        assert!(size > 4000, "it would fit");
                        return;
                    }
                };
                let push = ModelPush { promised, gives_way: false };
                self.pushes.insert(ticket, push);
                self.apply_admitted(others);
                self.make_room();
            }
            MachineStep::Pushed(which) => {
                if let Some(ticket) = nth(self.pushes.keys().copied(), which) {
                    let push = self.pushes.remove(&ticket).unwrap_or_default();
                    let admitted = match push.promised {
                        Some(amount) => self.book.release(amount),
                        None => self.book.withdraw(ticket),
                    };
                    self.apply_admitted(admitted);
                    self.make_room();
                }
            }
            MachineStep::Stalls(stalls) => {
                let admitted = self.book.set_stall(stalls.then(|| "it swaps".to_owned()));
                self.apply_admitted(admitted);
            }
            MachineStep::Published(service) => self.revisions[service] += 1,
            MachineStep::Tidied => self.tidy(),
            MachineStep::WarmDies(which) => {
                if let Some(warm) = nth(self.pool.iter_mut(), which) {
                    warm.runs = false;
                }
            }
            MachineStep::Passes(seconds) => self.now += Duration::from_secs(seconds),
        }
        self.end_unneeded();
    }

    /// Ends servants that are not needed.
    fn end_unneeded(&mut self) {
        let now = self.now;
        for servant in self.servants.iter_mut().filter(|it| !it.ending) {
            let idle = servant.stage == ServantStage::Ready && servant.connections == 0;
            servant.idle_since = idle.then(|| servant.idle_since.unwrap_or(now));
        }
        let over: Vec<String> = self
            .servants
            .iter()
            .filter(|it| !it.ending)
            .filter(|it| {
                let need = retention(&it.tenancy(), now);
                assert!(it.connections == 0 || need == Retention::Stays, "its robot uses it");
                matches!(need, Retention::Over(_))
            })
            .map(|it| it.id.clone())
            .collect();
        for id in over {
            self.end(&id);
        }
    }

    pub(super) fn check_invariants(&self) {
        let servants = self.servants.iter().filter_map(|it| it.promised);
        let pushes = self.pushes.values().filter_map(|push| push.promised);
        let pooled = self.pool.iter().filter_map(|it| it.promised);
        let promised = servants.chain(pushes).chain(pooled).fold(Amount::NONE, Amount::plus);
        assert_eq!(self.book.promised_total(), promised);
        assert!(promised.fits(self.book.capacity()), "more is promised than there is");
        assert!(self.line.len() <= QUEUE);
        let waiting = self.pushes.values().filter(|it| it.promised.is_none()).count();
        assert_eq!(self.book.waiting_count(), self.line.len() + waiting);
        let free = self.book.capacity().minus(promised);
        let places: Vec<(Ticket, usize)> = self.book.queue_positions().map(|one| (one.0, one.1.place)).collect();
        assert_eq!(places.len(), self.line.len());
        let first = places.first().filter(|_| self.book.stall_reason().is_none());
        if let Some((first, _)) = first {
            let first = self.servants.iter().find(|it| it.ticket == *first);
            let first = first.expect("who waits is there");
            assert!(!first.wants.fits(free), "it waits for what is free");
        }
        let mut given = BTreeSet::new();
        for servant in self.servants.iter().filter(|it| !it.ending) {
            assert!(given.insert(servant.key), "a robot has two servants of one service");
            assert_eq!(self.given.get(&servant.key), Some(&servant.id));
        }
    }

    /// Lets all admitted servants and pushes leave, one after the other.
    pub(super) fn drain(&mut self) {
        self.apply(MachineStep::Stalls(false));
        for _ in 0..1000 {
            let push = self.pushes.iter().find(|it| it.1.promised.is_some());
            let push = push.map(|it| *it.0);
            let lives = self.servants.iter().find(|it| it.promised.is_some());
            let lives = lives.map(|it| (it.id.clone(), it.ending));
            match (push, lives) {
                (Some(_), _) => {
                    self.apply(MachineStep::Pushed(self.pushes.values().take_while(|it| it.promised.is_none()).count()))
                }
                (None, Some((id, ending))) => {
                    if !ending {
                        self.end(&id);
                    }
                    let ending = self.servants.iter().filter(|it| it.ending);
                    let which = ending.take_while(|it| it.id != id).count();
                    self.apply(MachineStep::Gone(which));
                }
                (None, None) => break,
            }
            self.check_invariants();
        }
        let pooled = self.pool.iter().filter_map(|it| it.promised);
        assert_eq!(self.book.promised_total(), pooled.fold(Amount::NONE, Amount::plus));
        assert_eq!(self.book.waiting_count(), 0, "somebody waits for ever");
    }
}
