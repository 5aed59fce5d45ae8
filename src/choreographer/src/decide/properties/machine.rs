//! The machine of the properties: what the daemon does with decisions, done with plain data, and what has to hold of it.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use super::{SERVICES, Step};
use crate::decide::admission::{Admitted, Ask, Book, OVERTAKEN, Ticket, Verdict};
use crate::decide::capacity::{Push, Room};
use crate::decide::lifetime::{Need, Stage, Tenancy, needed};
use crate::decide::placement::{Placement, place};
use crate::decide::warm_pool::{Missing, Size, Wanted, Warm, choose, deserving, missing, stale};
use crate::decide::{Amount, End, Servant, capacity};

const GRACE: Duration = Duration::from_secs(60);
const QUEUE: usize = 4;
const POOL: usize = 2;

fn cores(millicpus: u64) -> Amount {
    Amount {
        millicpus,
        memory: 0,
    }
}

struct Lives {
    id: String,
    ticket: Ticket,
    key: (usize, usize),
    revision: u64,
    stage: Stage,
    wants: Amount,
    promised: Option<Amount>,
    connections: usize,
    idle_since: Option<Instant>,
    ending: bool,
}

impl Lives {
    /// Robot 0 names no name.
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
            grace: if self.anonymous() {
                Duration::ZERO
            } else {
                GRACE
            },
        }
    }

    fn facts(&self, began: Instant) -> Servant<'_> {
        let until = |since: Instant| (since - began + GRACE).as_millis() as u64;
        Servant {
            id: &self.id,
            revision: self.revision,
            connections: self.connections,
            promised: self.promised,
            idle_until: self.idle_since.map(until),
            ending: self.ending,
        }
    }
}

struct Pooled {
    id: String,
    service: usize,
    revision: u64,
    runs: bool,
    /// Its nodes run, for which it is promised so much.
    promised: Option<Amount>,
}

impl Pooled {
    /// As a servant that nobody needs.
    fn idle(&self) -> Servant<'_> {
        Servant {
            id: &self.id,
            revision: self.revision,
            connections: 0,
            promised: self.promised,
            idle_until: Some(0),
            ending: false,
        }
    }

    fn facts(&self) -> Warm<'_> {
        Warm {
            id: &self.id,
            service: SERVICES[self.service].0,
            revision: self.revision,
            image: "an image",
            runs: self.runs,
            nodes: self.promised.is_some(),
        }
    }
}

/// A push that waits, or is promised something.
#[derive(Default)]
struct Pushing {
    promised: Option<Amount>,
    gives_way: bool,
}

/// A robot in the line.
struct Stands {
    ticket: Ticket,
    priority: i32,
    /// So many who came later were admitted before it.
    overtaken: u32,
}

pub(super) struct Machine {
    began: Instant,
    now: Instant,
    book: Book,
    servants: Vec<Lives>,
    /// By service and robot: the ids of those that may be given.
    given: BTreeMap<(usize, usize), String>,
    pushes: BTreeMap<Ticket, Pushing>,
    pool: Vec<Pooled>,
    asked_for: Vec<String>,
    revisions: [u64; SERVICES.len()],
    /// Robots that wait, as they came.
    line: Vec<Stands>,
    made: u64,
    /// Containers that a robot was given.
    used: BTreeSet<String>,
}

fn nth<T>(all: impl Iterator<Item = T>, which: usize) -> Option<T> {
    let mut all: Vec<T> = all.collect();
    (!all.is_empty()).then(|| all.swap_remove(which % all.len()))
}

impl Machine {
    pub(super) fn new() -> Machine {
        let now = Instant::now();
        Machine {
            began: now,
            now,
            book: Book::new(cores(4000), QUEUE),
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

    fn name(&mut self) -> (Ticket, String) {
        self.made += 1;
        (self.made, format!("made-{}", self.made))
    }

    fn servant(&mut self, id: &str) -> &mut Lives {
        let found = self.servants.iter_mut().find(|servant| servant.id == id);
        found.expect("decisions are about servants that live")
    }

    /// Its end is asked for. It stays where its robot finds it until its task has seen that.
    fn end(&mut self, id: &str) {
        let servant = self.servant(id);
        assert!(!servant.ending, "{id} is being ended already");
        servant.ending = true;
        let (queued, ticket) = (servant.stage == Stage::Queued, servant.ticket);
        if queued {
            self.line.retain(|one| one.ticket != ticket);
            let admitted = self.book.leave(ticket);
            self.admitted(admitted);
        }
    }

    /// Those who waited are admitted: robots of one priority in the order in which they came, and none is overtaken for ever.
    fn admitted(&mut self, admitted: Vec<Admitted>) {
        for Admitted { ticket, amount } in admitted {
            assert_eq!(self.book.stalled(), None);
            if let Some(push) = self.pushes.get_mut(&ticket) {
                push.promised = Some(amount);
                continue;
            }
            let at = self.line.iter().position(|one| one.ticket == ticket);
            let stood = self.line.remove(at.expect("who waits is in the line"));
            self.overtakes(at.unwrap_or_default(), stood.priority);
            let servant = self.servants.iter_mut().find(|one| one.ticket == ticket);
            let servant = servant.expect("who waits is there");
            assert!(!servant.ending, "it waits no longer");
            servant.promised = Some(amount);
            servant.stage = Stage::Admitted;
        }
    }

    /// One of this priority goes before those who came before it, who are the first of the line.
    fn overtakes(&mut self, earlier: usize, priority: i32) {
        for one in &mut self.line[..earlier] {
            assert!(one.priority < priority, "a robot was overtaken");
            one.overtaken += 1;
            assert!(one.overtaken <= OVERTAKEN, "a robot waits for ever");
        }
    }

    fn make_room(&mut self) {
        let lacking = self.book.lacking();
        let began = self.began;
        let pushes: Vec<Push> = self
            .pushes
            .iter()
            .filter_map(|(ticket, push)| {
                Some(Push {
                    ticket: *ticket,
                    has: push.promised?,
                    gives_way: push.gives_way,
                })
            })
            .collect();
        let decide = || {
            let used = self.servants.iter().map(|it| it.facts(began));
            let all = self.pool.iter().map(Pooled::idle).chain(used);
            capacity::make_room(lacking, all, &pushes)
        };
        let Room { ends, give_way } = decide();
        assert_eq!(ends, decide().ends, "the same facts, another decision");
        let having = |ids: &[End<'_>], pushes: &[Ticket]| {
            let all = self.servants.iter();
            let free = all.filter(|it| it.ending || ids.iter().any(|end| end.id == it.id));
            let free = free.filter_map(|it| it.promised);
            let pooled = self.pool.iter();
            let pooled = pooled.filter(|it| ids.iter().any(|end| end.id == it.id));
            let pooled = pooled.filter_map(|it| it.promised);
            let leave = self.pushes.iter();
            let leave = leave.filter(|(ticket, it)| it.gives_way || pushes.contains(ticket));
            let leave = leave.filter_map(|(_, it)| it.promised);
            free.chain(pooled)
                .chain(leave)
                .fold(Amount::NONE, Amount::plus)
        };
        let warm = |id: &str| self.pool.iter().any(|it| it.id == id);
        let order: Vec<bool> = ends.iter().map(|end| warm(end.id)).collect();
        assert!(
            order.is_sorted_by(|one, other| one >= other),
            "a robot's servant ends before what was made ahead"
        );
        if let Some((_, others)) = ends.split_last() {
            assert_ne!(
                lacking.all.minus(having(others, &[])),
                Amount::NONE,
                "one end too many"
            );
        }
        let first = lacking.first_robot;
        let every: Vec<Ticket> = self.pushes.keys().copied().collect();
        assert!(
            first.minus(having(&ends, &give_way)) == Amount::NONE
                || first.minus(having(&ends, &every)) != Amount::NONE,
            "a push keeps a robot from being admitted"
        );
        if let Some((_, others)) = give_way.split_last() {
            assert_ne!(
                first.minus(having(&ends, others)),
                Amount::NONE,
                "one push too many"
            );
        }
        let ids: Vec<String> = ends.iter().map(|end| end.id.to_owned()).collect();
        for id in ids {
            if let Some(index) = self.pool.iter().position(|it| it.id == id) {
                let warm = self.pool.remove(index);
                let admitted = self.book.release(warm.promised.unwrap_or_default());
                self.admitted(admitted);
                continue;
            }
            let servant = self.servant(&id);
            assert!(servant.connections == 0 && servant.stage == Stage::Ready);
            self.end(&id);
        }
        for ticket in give_way {
            if let Some(push) = self.pushes.get_mut(&ticket) {
                push.gives_way = true;
            }
        }
    }

    /// How much more would have to be free for all robots that wait.
    fn lacked(&self) -> Amount {
        let waiting = self
            .servants
            .iter()
            .filter(|it| self.line.iter().any(|one| one.ticket == it.ticket));
        let wanted = waiting.fold(Amount::NONE, |sum, it| sum.plus(it.wants));
        wanted.minus(self.book.capacity().minus(self.book.promised()))
    }

    fn asks(&mut self, service: usize, robot: usize, priority: i32) {
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
        let default_names = robot % 2 == 0 && self.book.is_calm();
        let of = (name, current, "an image");
        let warm = choose(self.pool.iter().map(Pooled::facts), of, default_names);
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
        let (ticket, fresh) = self.name();
        let mut ahead = None;
        let warm = chosen.filter(|_| warm).map(|id| {
            let index = self.pool.iter().position(|it| it.id == id);
            let warm = self.pool.remove(index.expect("the pool has it"));
            let of = (warm.service, warm.revision, warm.runs);
            assert_eq!(of, (service, current, true));
            assert!(
                robot % 2 == 0 || warm.promised.is_none(),
                "it has other names"
            );
            ahead = warm.promised;
            assert!(
                self.used.insert(warm.id.clone()),
                "two robots have the same container"
            );
            warm.id
        });
        let wants = cores(SERVICES[service].1);
        let (verdict, others) = match ahead {
            Some(_) => (Verdict::Admitted, Vec::new()),
            None => self.book.ask(ticket, Ask::robot(wants, priority)),
        };
        let promised = match verdict {
            Verdict::Admitted => {
                self.overtakes(self.line.len(), priority);
                Some(wants)
            }
            Verdict::Waits => None,
            Verdict::Refused(_) => {
                assert_eq!(others, [], "nobody was overtaken");
                return;
            }
        };
        self.admitted(others);
        let id = warm.unwrap_or(fresh);
        self.given.insert(key, id.clone());
        self.servants.push(Lives {
            id,
            ticket,
            key,
            revision: current,
            stage: if promised.is_some() {
                Stage::Admitted
            } else {
                Stage::Queued
            },
            wants,
            promised,
            connections: 1,
            idle_since: None,
            ending: false,
        });
        if promised.is_none() {
            self.line.push(Stands {
                ticket,
                priority,
                overtaken: 0,
            });
            self.make_room();
        }
    }

    fn tidy(&mut self) {
        let published: Vec<String> = SERVICES.iter().map(|it| it.0.to_owned()).collect();
        let wanted = deserving(&published, &self.asked_for, POOL);
        let number = |name: &String| SERVICES.iter().position(|it| it.0 == name).expect("known");
        let wanted: Vec<usize> = wanted.iter().map(number).collect();
        let revisions = self.revisions;
        let facts: Vec<Wanted<'_>> = wanted
            .iter()
            .map(|service| Wanted {
                service: SERVICES[*service].0,
                revision: revisions[*service],
                image: "an image",
                size: Size {
                    makes: 1,
                    keeps: 1 + *service,
                    nodes: 1,
                },
            })
            .collect();
        let pool: Vec<Warm<'_>> = self.pool.iter().map(Pooled::facts).collect();
        let ends = stale(&pool, &facts);
        let ends: Vec<String> = ends.iter().map(|end| end.id.to_owned()).collect();
        for id in &ends {
            assert!(!self.used.contains(id), "{id} is a robot's");
        }
        for id in ends {
            let index = self.pool.iter().position(|it| it.id == id);
            let warm = self.pool.remove(index.expect("it is the pool's"));
            let admitted = self.book.release(warm.promised.unwrap_or_default());
            self.admitted(admitted);
        }
        for (service, wanted) in wanted.into_iter().zip(&facts) {
            loop {
                let pool: Vec<Warm<'_>> = self.pool.iter().map(Pooled::facts).collect();
                match missing(&pool, wanted) {
                    Missing::Nothing => break,
                    Missing::Containers(_) => {
                        let (_, id) = self.name();
                        self.pool.push(Pooled {
                            id,
                            service,
                            revision: revisions[service],
                            runs: true,
                            promised: None,
                        });
                    }
                    Missing::Nodes(id) => {
                        let (id, before) = (id.to_owned(), self.book.clone());
                        let wants = cores(SERVICES[service].1);
                        if !self.book.take_spare(wants) {
                            assert_eq!(self.book, before, "refused, and yet promised");
                            break;
                        }
                        assert_eq!(before.waiting(), 0, "those who wait were overtaken");
                        let warm = self.pool.iter_mut().find(|it| it.id == id);
                        warm.expect("it is the pool's").promised = Some(wants);
                    }
                }
            }
        }
        assert!(self.pool.iter().filter(|it| it.promised.is_some()).count() <= POOL);
    }

    pub(super) fn takes(&mut self, step: Step) {
        match step {
            Step::Asks {
                service,
                robot,
                priority,
            } => self.asks(service, robot, priority),
            Step::Leaves(which) => {
                let used = self.servants.iter_mut().filter(|it| it.connections > 0);
                if let Some(servant) = nth(used, which) {
                    servant.connections -= 1;
                }
            }
            Step::Proceeds(which) => {
                let admitted = self.servants.iter_mut();
                let admitted = admitted.filter(|it| it.promised.is_some() && !it.ending);
                if let Some(servant) = nth(admitted, which) {
                    servant.stage = match servant.stage {
                        Stage::Queued | Stage::Admitted => Stage::Starting,
                        Stage::Starting | Stage::Ready => Stage::Ready,
                    };
                }
            }
            Step::Stopped(which) => {
                let lives = self.servants.iter().filter(|it| !it.ending);
                if let Some(id) = nth(lives.map(|it| it.id.clone()), which) {
                    self.end(&id);
                }
            }
            Step::Gone(which) => {
                let ending = self.servants.iter().filter(|it| it.ending);
                if let Some(id) = nth(ending.map(|it| it.id.clone()), which) {
                    let index = self.servants.iter().position(|it| it.id == id);
                    let gone = self.servants.remove(index.expect("just seen"));
                    if self.given.get(&gone.key) == Some(&gone.id) {
                        self.given.remove(&gone.key);
                    }
                    let admitted = self.book.release(gone.promised.unwrap_or_default());
                    self.admitted(admitted);
                    self.make_room();
                }
            }
            Step::Resized(which, size) => {
                let running = self.servants.iter().filter(|it| it.promised.is_some());
                if let Some(id) = nth(running.map(|it| it.id.clone()), which) {
                    let promised = self.servant(&id).promised.unwrap_or_default();
                    let (before, lacked) = (self.book.clone(), self.lacked());
                    match self.book.change(promised, cores(size)) {
                        Ok(admitted) => {
                            self.servant(&id).promised = Some(cores(size));
                            self.admitted(admitted);
                        }
                        Err(_) => assert_eq!(self.book, before, "refused, and yet changed"),
                    }
                    let grew = !cores(size).fits(promised);
                    assert!(
                        !grew || self.lacked().fits(lacked),
                        "a servant overtook who waits"
                    );
                }
            }
            Step::GivesUp(which) => {
                let queued = self.servants.iter();
                let queued = queued.filter(|it| it.stage == Stage::Queued && !it.ending);
                if let Some(id) = nth(queued.map(|it| it.id.clone()), which) {
                    self.end(&id);
                }
            }
            Step::Pushes(size) => {
                let (ticket, _) = self.name();
                let (verdict, others) = self.book.ask(ticket, Ask::push(cores(size)));
                let promised = match verdict {
                    Verdict::Admitted => {
                        assert!(self.line.is_empty(), "a push goes before a robot");
                        Some(cores(size))
                    }
                    Verdict::Waits => None,
                    Verdict::Refused(_) => {
                        assert!(size > 4000, "it would fit");
                        return;
                    }
                };
                let push = Pushing {
                    promised,
                    gives_way: false,
                };
                self.pushes.insert(ticket, push);
                self.admitted(others);
                self.make_room();
            }
            Step::Pushed(which) => {
                if let Some(ticket) = nth(self.pushes.keys().copied(), which) {
                    let push = self.pushes.remove(&ticket).unwrap_or_default();
                    let admitted = match push.promised {
                        Some(amount) => self.book.release(amount),
                        None => self.book.leave(ticket),
                    };
                    self.admitted(admitted);
                    self.make_room();
                }
            }
            Step::Stalls(stalls) => {
                let admitted = self.book.stall(stalls.then(|| "it swaps".to_owned()));
                self.admitted(admitted);
            }
            Step::Published(service) => self.revisions[service] += 1,
            Step::Tidied => self.tidy(),
            Step::WarmDies(which) => {
                if let Some(warm) = nth(self.pool.iter_mut(), which) {
                    warm.runs = false;
                }
            }
            Step::Passes(seconds) => self.now += Duration::from_secs(seconds),
        }
        self.settles();
    }

    /// What nobody needs is ended.
    fn settles(&mut self) {
        let now = self.now;
        for servant in self.servants.iter_mut().filter(|it| !it.ending) {
            let idle = servant.stage == Stage::Ready && servant.connections == 0;
            servant.idle_since = idle.then(|| servant.idle_since.unwrap_or(now));
        }
        let over: Vec<String> = self
            .servants
            .iter()
            .filter(|it| !it.ending)
            .filter(|it| {
                let need = needed(&it.tenancy(), now);
                assert!(
                    it.connections == 0 || need == Need::Stays,
                    "its robot uses it"
                );
                matches!(need, Need::Over(_))
            })
            .map(|it| it.id.clone())
            .collect();
        for id in over {
            self.end(&id);
        }
    }

    pub(super) fn holds(&self) {
        let servants = self.servants.iter().filter_map(|it| it.promised);
        let pushes = self.pushes.values().filter_map(|push| push.promised);
        let pooled = self.pool.iter().filter_map(|it| it.promised);
        let promised = servants
            .chain(pushes)
            .chain(pooled)
            .fold(Amount::NONE, Amount::plus);
        assert_eq!(self.book.promised(), promised);
        assert!(
            promised.fits(self.book.capacity()),
            "more is promised than there is"
        );
        assert!(self.line.len() <= QUEUE);
        let waiting = self
            .pushes
            .values()
            .filter(|it| it.promised.is_none())
            .count();
        assert_eq!(self.book.waiting(), self.line.len() + waiting);
        let free = self.book.capacity().minus(promised);
        let places: Vec<(Ticket, usize)> =
            self.book.places().map(|one| (one.0, one.1.place)).collect();
        assert_eq!(places.len(), self.line.len());
        let first = places.first().filter(|_| self.book.stalled().is_none());
        if let Some((first, _)) = first {
            let first = self.servants.iter().find(|it| it.ticket == *first);
            let first = first.expect("who waits is there");
            assert!(!first.wants.fits(free), "it waits for what is free");
        }
        let mut given = BTreeSet::new();
        for servant in self.servants.iter().filter(|it| !it.ending) {
            assert!(
                given.insert(servant.key),
                "a robot has two servants of one service"
            );
            assert_eq!(self.given.get(&servant.key), Some(&servant.id));
        }
    }

    /// All that are admitted leave, one after the other.
    pub(super) fn empties(&mut self) {
        self.takes(Step::Stalls(false));
        for _ in 0..1000 {
            let push = self.pushes.iter().find(|it| it.1.promised.is_some());
            let push = push.map(|it| *it.0);
            let lives = self.servants.iter().find(|it| it.promised.is_some());
            let lives = lives.map(|it| (it.id.clone(), it.ending));
            match (push, lives) {
                (Some(_), _) => self.takes(Step::Pushed(
                    self.pushes
                        .values()
                        .take_while(|it| it.promised.is_none())
                        .count(),
                )),
                (None, Some((id, ending))) => {
                    if !ending {
                        self.end(&id);
                    }
                    let ending = self.servants.iter().filter(|it| it.ending);
                    let which = ending.take_while(|it| it.id != id).count();
                    self.takes(Step::Gone(which));
                }
                (None, None) => break,
            }
            self.holds();
        }
        let pooled = self.pool.iter().filter_map(|it| it.promised);
        assert_eq!(
            self.book.promised(),
            pooled.fold(Amount::NONE, Amount::plus)
        );
        assert_eq!(self.book.waiting(), 0, "somebody waits for ever");
    }
}
