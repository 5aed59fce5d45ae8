//! Who is admitted, who waits and who is refused: each servant is promised some cores and memory, and no more is promised
//! than there is.
//!
//! Robots that wait are served in the order of their priorities, and those of one priority in the order in which they came. One
//! that was overtaken [`OVERTAKEN`] times goes before all who came after it, whatever their priority (bounded overtaking, as
//! it is asked of fair locks): so none waits for ever. Whoever is first blocks those behind it, or big servants would wait for
//! ever. Pushes come after all robots.

use std::time::Duration;

use super::Amount;
use super::capacity::Lacking;

/// So often may one that waits be overtaken.
pub const OVERTAKEN: u32 = 8;

/// Why a servant, or more for one, is not admitted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// It would not fit on an empty machine.
    #[error(
        "a servant of {} cores and {} of memory does not fit on this machine, which has {} cores and {} for servants",
        wanted.cpus(), api::Size(wanted.memory), capacity.cpus(), api::Size(capacity.memory)
    )]
    TooBig {
        /// Asked for.
        wanted: Amount,
        /// The capacity.
        capacity: Amount,
    },
    /// A servant that runs cannot be promised more.
    #[error(
        "there is no room for a servant of {} cores and {} of memory: {} cores and {} are left for it",
        wanted.cpus(), api::Size(wanted.memory), free.cpus(), api::Size(free.memory)
    )]
    NoMore {
        /// Asked for.
        wanted: Amount,
        /// What it could have.
        free: Amount,
    },
    /// Too many wait already.
    #[error("this machine is full and {waiting} robots wait for room already")]
    QueueFull {
        /// Robots that wait.
        waiting: usize,
    },
    /// No capacity came free until the deadline.
    #[error("this machine is full; no room came free within {} s{}", waited.as_secs(), at(place))]
    Deadline {
        /// How long the robot waited.
        waited: Duration,
        /// Its last position in the queue; none where it was no robot that waited.
        place: Option<Position>,
    },
    /// The machine stalled until the deadline.
    #[error("{why}; this did not end within {} s{}", waited.as_secs(), at(place))]
    Stalled {
        /// What it waits for, in words.
        why: String,
        /// How long the robot waited.
        waited: Duration,
        /// Its last position in the queue; none where it was no robot that waited.
        place: Option<Position>,
    },
    /// The machine stalls: a servant that runs is promised no more.
    #[error("{why}: no servant is promised more meanwhile")]
    NoMoreNow {
        /// What it waits for, in words.
        why: String,
    },
}

/// Behind a refusal: where it stood.
fn at(place: &Option<Position>) -> String {
    place.map_or_else(String::new, |place| format!("; it was {place}"))
}

/// Where a robot stands among those that wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Position {
    /// From 1 on.
    pub place: usize,
    /// So many wait.
    pub of: usize,
}

impl std::fmt::Display for Position {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(out, "number {} of {} that wait", self.place, self.of)
    }
}

/// Names one who asks for admission.
pub type Ticket = u64;

/// What asks, and how long it is willing to stand back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A servant of a robot.
    Robot,
    /// Work that is nobody's robot, such as a push: whoever waits and fits goes before it, or a big one would keep robots
    /// waiting; it takes no robot's place in the queue, and gives back what it has when a robot needs it.
    Push,
}

/// What is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ask {
    /// What is to be promised.
    pub wanted: Amount,
    /// The robot or push that asks.
    pub origin: Origin,
    /// Robots of a higher one go first; 0 where nothing else is said. Pushes have none.
    pub priority: i32,
}

impl Ask {
    /// For a robot of this priority.
    pub fn robot(wanted: Amount, priority: i32) -> Ask {
        Ask {
            wanted,
            origin: Origin::Robot,
            priority,
        }
    }

    /// For a push.
    pub fn push(wanted: Amount) -> Ask {
        Ask {
            wanted,
            origin: Origin::Push,
            priority: 0,
        }
    }
}

/// What is decided of one who asks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// It is promised what it asked for.
    Admitted,
    /// It is in the queue.
    Waits,
    /// It is refused.
    Refused(Refused),
}

/// One in the queue that is promised what it asked for now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Admitted {
    /// The ticket of who is admitted.
    pub ticket: Ticket,
    /// What it is promised.
    pub amount: Amount,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Waiter {
    ticket: Ticket,
    ask: Ask,
    /// So many who came later were admitted before it.
    overtaken: u32,
}

impl Waiter {
    fn is_robot(&self) -> bool {
        self.ask.origin == Origin::Robot
    }

    /// Those with less go first; of the same, those who came first.
    fn rank(&self) -> (bool, bool, std::cmp::Reverse<i32>) {
        let patient = self.overtaken < OVERTAKEN;
        let priority = if patient { self.ask.priority } else { 0 };
        (!self.is_robot(), patient, std::cmp::Reverse(priority))
    }
}

/// What the machine has, what of it is promised, and who waits for it.
#[derive(Debug, Clone, PartialEq)]
pub struct Book {
    capacity: Amount,
    promised: Amount,
    /// In the order in which they came.
    waiting: Vec<Waiter>,
    /// Most robots that may wait.
    queue: usize,
    /// Why nobody is admitted now.
    stalled: Option<String>,
}

impl Book {
    /// A machine with `capacity` for servants, before which at most `queue` robots may wait.
    pub fn new(capacity: Amount, queue: usize) -> Book {
        Book {
            capacity,
            promised: Amount::NONE,
            waiting: Vec::new(),
            queue,
            stalled: None,
        }
    }

    /// The capacity.
    pub fn capacity(&self) -> Amount {
        self.capacity
    }

    /// What of it is promised.
    pub fn promised(&self) -> Amount {
        self.promised
    }

    /// How many wait.
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Why nobody is admitted now.
    pub fn stalled(&self) -> Option<&str> {
        self.stalled.as_deref()
    }

    fn free(&self) -> Amount {
        self.capacity.minus(self.promised)
    }

    /// Where robots that wait stand.
    pub fn places(&self) -> impl Iterator<Item = (Ticket, Position)> + '_ {
        let robots = self
            .in_turn()
            .into_iter()
            .filter(|waiter| waiter.is_robot());
        let of = self
            .waiting
            .iter()
            .filter(|waiter| waiter.is_robot())
            .count();
        robots
            .zip(1..)
            .map(move |(waiter, place)| (waiter.ticket, Position { place, of }))
    }

    /// Those who wait, as they are to be admitted.
    fn in_turn(&self) -> Vec<Waiter> {
        let mut turn = self.waiting.clone();
        turn.sort_by_key(Waiter::rank);
        turn
    }

    /// How much more would have to be free.
    pub fn lacking(&self) -> Lacking {
        let free = self.free();
        let first = self.in_turn().into_iter().find(Waiter::is_robot);
        Lacking {
            all: self.wanted_by(|_| true).minus(free),
            first_robot: first.map_or(Amount::NONE, |first| first.ask.wanted.minus(free)),
        }
    }

    /// So many robots wait, if no further one may, whatever its priority.
    pub fn full(&self) -> Option<usize> {
        let robots = self.waiting.iter().filter(|one| one.is_robot()).count();
        (robots >= self.queue).then_some(robots)
    }

    /// What robots that wait asked for that would be admitted before one of this priority that came now.
    pub fn wanted_before(&self, priority: i32) -> Amount {
        let new = Waiter {
            ticket: 0,
            ask: Ask::robot(Amount::NONE, priority),
            overtaken: 0,
        };
        self.wanted_by(|waiter| waiter.is_robot() && waiter.rank() <= new.rank())
    }

    /// What robots that wait asked for.
    pub fn wanted_by_robots(&self) -> Amount {
        self.wanted_by(Waiter::is_robot)
    }

    fn wanted_by(&self, who: impl Fn(&Waiter) -> bool) -> Amount {
        let waiting = self.waiting.iter().filter(|waiter| who(waiter));
        waiting.fold(Amount::NONE, |sum, waiter| sum.plus(waiter.ask.wanted))
    }

    /// Refuses what would not fit on an empty machine.
    pub fn check(&self, wanted: Amount) -> Result<(), Refused> {
        let capacity = self.capacity;
        match wanted.fits(capacity) {
            true => Ok(()),
            false => Err(Refused::TooBig { wanted, capacity }),
        }
    }

    /// `ticket` asks. With the answer come those who are admitted since they were overtaken once more.
    pub fn ask(&mut self, ticket: Ticket, ask: Ask) -> (Verdict, Vec<Admitted>) {
        self.enter(ticket, ask, None)
    }

    /// `ticket` asks again, which has waited before and was overtaken so often then: it stands where it stood, also where as many
    /// wait as may.
    pub fn ask_again(
        &mut self,
        ticket: Ticket,
        ask: Ask,
        overtaken: u32,
    ) -> (Verdict, Vec<Admitted>) {
        self.enter(ticket, ask, Some(overtaken))
    }

    /// How often one that waits was overtaken.
    pub fn overtaken(&self, ticket: Ticket) -> Option<u32> {
        let mut waiting = self.waiting.iter();
        waiting
            .find(|one| one.ticket == ticket)
            .map(|one| one.overtaken)
    }

    fn enter(&mut self, ticket: Ticket, ask: Ask, again: Option<u32>) -> (Verdict, Vec<Admitted>) {
        if let Err(refused) = self.check(ask.wanted) {
            return (Verdict::Refused(refused), Vec::new());
        }
        let waiter = Waiter {
            ticket,
            ask,
            overtaken: again.unwrap_or(0),
        };
        let robots = self.waiting.iter().filter(|one| one.is_robot()).count();
        let at = self.waiting.partition_point(|one| one.ticket < ticket);
        self.waiting.insert(at, waiter);
        let mut admitted = self.admit();
        let own = admitted.iter().position(|one| one.ticket == ticket);
        let verdict = match own {
            Some(own) => {
                admitted.remove(own);
                Verdict::Admitted
            }
            None if waiter.is_robot() && robots >= self.queue && again.is_none() => {
                self.waiting.retain(|one| one.ticket != ticket);
                Verdict::Refused(Refused::QueueFull { waiting: robots })
            }
            None => Verdict::Waits,
        };
        (verdict, admitted)
    }

    /// Whether nobody waits, and the machine does not stall.
    pub fn is_calm(&self) -> bool {
        self.waiting.is_empty() && self.stalled.is_none()
    }

    /// Promises `amount` to what nobody waits for, if it is free and nobody waits for anything; whether it did.
    pub fn take_spare(&mut self, amount: Amount) -> bool {
        let spare = self.is_calm() && amount.fits(self.free());
        if spare {
            self.promise(amount);
        }
        spare
    }

    /// Promises `amount` even where it is not free: to a servant that runs already.
    pub fn promise(&mut self, amount: Amount) {
        self.promised = self.promised.plus(amount);
    }

    /// `ticket` waits no longer, if it did; gives those behind it who are admitted for that.
    pub fn leave(&mut self, ticket: Ticket) -> Vec<Admitted> {
        self.waiting.retain(|waiter| waiter.ticket != ticket);
        self.admit()
    }

    /// `amount` is promised no longer; gives those who are admitted for that.
    pub fn release(&mut self, amount: Amount) -> Vec<Admitted> {
        self.promised = self.promised.minus(amount);
        self.admit()
    }

    /// From now on nobody is admitted, for this reason, or all who fit are again; gives those who are.
    pub fn stall(&mut self, why: Option<String>) -> Vec<Admitted> {
        self.stalled = why;
        self.admit()
    }

    /// A servant is promised `wanted` instead of `promised`, if what is more is free and no robot waits for it; gives those
    /// who are admitted for what is less.
    pub fn change(&mut self, promised: Amount, wanted: Amount) -> Result<Vec<Admitted>, Refused> {
        let others = self.promised.minus(promised);
        let free = self.capacity.minus(others).minus(self.wanted_by_robots());
        let free = free.max(promised);
        if !wanted.fits(free) {
            return Err(Refused::NoMore { wanted, free });
        }
        if let Some(why) = self.stalled.clone().filter(|_| !wanted.fits(promised)) {
            return Err(Refused::NoMoreNow { why });
        }
        self.promised = others.plus(wanted);
        Ok(self.admit())
    }

    /// Admits those who wait in their turn as far as there is capacity.
    fn admit(&mut self) -> Vec<Admitted> {
        let mut admitted = Vec::new();
        while let Some(ticket) = self.next() {
            // Those behind it came later.
            let Some(at) = self.waiting.iter().position(|one| one.ticket == ticket) else {
                break;
            };
            let waiter = self.waiting.remove(at);
            for earlier in &mut self.waiting[..at] {
                earlier.overtaken += 1;
            }
            self.promise(waiter.ask.wanted);
            admitted.push(Admitted {
                ticket,
                amount: waiter.ask.wanted,
            });
        }
        admitted
    }

    /// Who is admitted next, if anybody.
    fn next(&self) -> Option<Ticket> {
        if self.stalled.is_some() || self.waiting.is_empty() {
            return None;
        }
        for waiter in self.in_turn() {
            if waiter.ask.wanted.fits(self.free()) {
                return Some(waiter.ticket);
            }
            if waiter.is_robot() || waiter.overtaken >= OVERTAKEN {
                return None;
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Origin::{Push, Robot};

    fn cores(cpus: f64) -> Amount {
        Amount::new(cpus, 0)
    }

    /// A machine of two cores, of which so many are promised.
    fn machine(queue: usize, promised: f64) -> Book {
        let mut book = Book::new(Amount::new(2.0, 1000), queue);
        book.promise(cores(promised));
        book
    }

    fn tickets(admitted: Vec<Admitted>) -> Vec<Ticket> {
        admitted.into_iter().map(|one| one.ticket).collect()
    }

    fn ask(book: &mut Book, ticket: Ticket, cpus: f64, origin: Origin) -> Verdict {
        asks(book, ticket, cpus, origin, 0)
    }

    fn asks(book: &mut Book, ticket: Ticket, cpus: f64, origin: Origin, priority: i32) -> Verdict {
        let ask = Ask {
            wanted: cores(cpus),
            origin,
            priority,
        };
        let (verdict, others) = book.ask(ticket, ask);
        assert!(others.is_empty(), "{others:?}");
        verdict
    }

    #[test]
    fn who_asks_is_admitted_waits_or_is_refused() {
        let full = Verdict::Refused(Refused::QueueFull { waiting: 1 });
        for (promised, waits, wanted, origin, expected) in [
            (0.0, None, 2.0, Robot, Verdict::Admitted),
            (1.5, None, 0.5, Robot, Verdict::Admitted),
            (1.5, None, 0.6, Robot, Verdict::Waits),
            // Nobody is overtaken by a robot but pushes, and robots that wait are bounded.
            (1.5, Some((1.0, Robot)), 0.5, Robot, full),
            (1.5, Some((1.0, Push)), 0.5, Robot, Verdict::Admitted),
            (1.5, Some((1.0, Push)), 1.0, Robot, Verdict::Waits),
            (1.5, Some((1.0, Push)), 0.6, Push, Verdict::Waits),
            (1.5, Some((1.0, Push)), 0.5, Push, Verdict::Admitted),
            (1.5, Some((1.0, Robot)), 0.5, Push, Verdict::Waits),
            (0.0, None, 0.5, Push, Verdict::Admitted),
        ] {
            let mut book = machine(1, promised);
            if let Some((wanted, origin)) = waits {
                assert_eq!(ask(&mut book, 1, wanted, origin), Verdict::Waits);
            }
            let verdict = ask(&mut book, 2, wanted, origin);
            assert_eq!(
                verdict, expected,
                "{promised} {waits:?} {wanted} {origin:?}"
            );
        }
        let ask = Ask::robot(Amount::new(0.0, 1001), 0);
        let (verdict, _) = machine(1, 0.0).ask(1, ask);
        assert!(matches!(verdict, Verdict::Refused(Refused::TooBig { .. })));
    }

    #[test]
    fn small_ones_do_not_overtake_a_big_one() {
        let mut book = machine(4, 1.0);
        assert_eq!(ask(&mut book, 1, 2.0, Robot), Verdict::Waits);
        assert_eq!(ask(&mut book, 2, 0.5, Robot), Verdict::Waits);
        assert!(book.release(cores(0.5)).is_empty());
        assert_eq!(tickets(book.release(cores(0.5))), [1]);
        assert_eq!(tickets(book.release(cores(2.0))), [2]);
    }

    #[test]
    fn who_gives_up_lets_the_next_in() {
        let mut book = machine(4, 1.0);
        assert_eq!(ask(&mut book, 1, 2.0, Robot), Verdict::Waits);
        assert_eq!(ask(&mut book, 2, 0.5, Robot), Verdict::Waits);
        assert_eq!(book.lacking().all, cores(1.5));
        assert_eq!(book.lacking().first_robot, cores(1.0));
        assert_eq!(tickets(book.leave(1)), [2]);
        assert_eq!((book.waiting(), book.lacking()), (0, Lacking::default()));
    }

    #[test]
    fn robots_that_fit_go_before_a_push_that_does_not() {
        let mut book = machine(1, 1.5);
        assert_eq!(ask(&mut book, 1, 2.0, Push), Verdict::Waits);
        assert_eq!(ask(&mut book, 2, 1.0, Robot), Verdict::Waits);
        assert_eq!(book.lacking().first_robot, cores(0.5));
        assert_eq!(tickets(book.release(cores(0.5))), [2]);
        assert!(book.release(cores(1.0)).is_empty());
        assert_eq!(tickets(book.release(cores(1.0))), [1]);
    }

    #[test]
    fn robots_of_a_higher_priority_go_first() {
        let mut book = machine(8, 2.0);
        for (ticket, cpus, priority) in [(1, 1.0, 0), (2, 1.0, 5), (3, 1.0, 5), (4, 0.5, -1)] {
            let verdict = asks(&mut book, ticket, cpus, Robot, priority);
            assert_eq!(verdict, Verdict::Waits);
        }
        let places: Vec<_> = book
            .places()
            .map(|(ticket, place)| (place.place, ticket))
            .collect();
        assert_eq!(places, [(1, 2), (2, 3), (3, 1), (4, 4)]);
        assert_eq!(
            book.places().next().map(|one| one.1.to_string()).as_deref(),
            Some("number 1 of 4 that wait")
        );
        assert_eq!(tickets(book.release(cores(1.0))), [2]);
        // One that is first and fits goes before all who wait.
        assert!(book.release(cores(0.5)).is_empty());
        assert_eq!(asks(&mut book, 5, 0.5, Robot, 9), Verdict::Admitted);
        assert_eq!(tickets(book.release(cores(2.0))), [3, 1]);
    }

    #[test]
    fn nobody_is_overtaken_for_ever() {
        let mut book = machine(64, 2.0);
        assert_eq!(ask(&mut book, 0, 1.0, Robot), Verdict::Waits);
        for ticket in 1..=u64::from(OVERTAKEN) + 3 {
            assert_eq!(asks(&mut book, ticket, 1.0, Robot, 9), Verdict::Waits);
        }
        let mut before = Vec::new();
        loop {
            let admitted = tickets(book.release(cores(1.0)));
            if admitted.contains(&0) {
                break;
            }
            before.extend(admitted);
        }
        assert_eq!(before, (1..=u64::from(OVERTAKEN)).collect::<Vec<_>>());
        // The last one that overtakes it lets it in.
        let mut book = machine(64, 2.0);
        assert_eq!(asks(&mut book, 0, 0.1, Robot, 0), Verdict::Waits);
        assert_eq!(asks(&mut book, 1, 1.0, Robot, 5), Verdict::Waits);
        assert!(book.release(cores(0.4)).is_empty(), "the first one blocks");
        let last = u64::from(OVERTAKEN) + 1;
        for ticket in 2..last {
            assert_eq!(asks(&mut book, ticket, 0.01, Robot, 9), Verdict::Admitted);
        }
        let (verdict, others) = book.ask(last, Ask::robot(cores(0.01), 9));
        assert_eq!((verdict, tickets(others)), (Verdict::Admitted, vec![0]));
    }

    #[test]
    fn who_comes_back_stands_where_it_stood() {
        let mut book = machine(2, 2.0);
        for ticket in [1, 2] {
            assert_eq!(ask(&mut book, ticket, 1.0, Robot), Verdict::Waits);
        }
        assert_eq!(book.overtaken(1), Some(0));
        assert!(book.leave(1).is_empty());
        assert_eq!(ask(&mut book, 3, 1.0, Robot), Verdict::Waits);
        // Two wait, which is as many as may: a new one is refused, and one that had a place is not.
        let full = Verdict::Refused(Refused::QueueFull { waiting: 2 });
        assert_eq!(ask(&mut book, 4, 1.0, Robot), full);
        let (verdict, others) = book.ask_again(1, Ask::robot(cores(1.0), 0), OVERTAKEN);
        assert_eq!((verdict, others), (Verdict::Waits, vec![]));
        assert_eq!(book.overtaken(1), Some(OVERTAKEN));
        let order: Vec<Ticket> = book.places().map(|(ticket, _)| ticket).collect();
        assert_eq!(order, [1, 2, 3]);
        assert_eq!(tickets(book.release(cores(2.0))), [1, 2]);
        // Who is served at once needs no place.
        let (verdict, _) = machine(2, 0.0).ask_again(1, Ask::robot(cores(1.0), 0), 3);
        assert_eq!(verdict, Verdict::Admitted);
        assert_eq!(book.overtaken(9), None);
    }

    #[test]
    fn a_machine_that_stalls_admits_nobody() {
        let mut book = machine(4, 0.0);
        assert!(book.stall(Some("it swaps".into())).is_empty());
        assert_eq!(ask(&mut book, 1, 1.0, Robot), Verdict::Waits);
        assert_eq!(ask(&mut book, 2, 0.1, Push), Verdict::Waits);
        assert!(book.release(Amount::NONE).is_empty() && book.leave(9).is_empty());
        assert_eq!(book.stalled(), Some("it swaps"));
        book.promise(cores(0.5));
        let why = "it swaps".to_owned();
        assert_eq!(
            book.change(cores(0.5), cores(0.6)),
            Err(Refused::NoMoreNow { why })
        );
        assert_eq!(book.change(cores(0.5), cores(0.4)), Ok(vec![]));
        assert_eq!(tickets(book.stall(None)), [1, 2]);
    }

    #[test]
    fn a_promise_grows_by_what_is_free() {
        let mut book = machine(4, 1.0);
        book.promise(cores(0.5));
        assert_eq!(book.change(cores(1.0), cores(1.5)), Ok(vec![]));
        let free = Amount::new(1.5, 1000);
        let wanted = cores(1.6);
        let refused = book.change(cores(1.5), wanted);
        assert_eq!(refused, Err(Refused::NoMore { wanted, free }));
        assert_eq!(ask(&mut book, 1, 1.0, Robot), Verdict::Waits);
        let admitted = book.change(cores(1.5), cores(0.1)).expect("less");
        assert_eq!(tickets(admitted), [1]);
        assert_eq!(book.promised(), cores(1.6));
        // Where more is promised than there is (servants of an earlier daemon), a promise may shrink.
        book.promise(cores(2.0));
        assert_eq!(book.change(cores(1.0), cores(0.9)), Ok(vec![]));
    }

    #[test]
    fn a_promise_does_not_grow_by_what_robots_wait_for() {
        let mut book = machine(4, 1.0);
        assert_eq!(ask(&mut book, 1, 1.5, Robot), Verdict::Waits);
        let wanted = cores(1.1);
        let free = Amount::new(1.0, 1000);
        let refused = book.change(cores(1.0), wanted);
        assert_eq!(refused, Err(Refused::NoMore { wanted, free }));
        // Of what nobody waits for it may have more.
        assert_eq!(book.change(cores(1.0), free), Ok(vec![]));
        let mut book = machine(4, 1.0);
        assert_eq!(ask(&mut book, 1, 1.5, Push), Verdict::Waits);
        assert_eq!(book.change(cores(1.0), wanted), Ok(vec![]));
    }
}
