//! Admission control: decides who is admitted, who waits and who is refused. Each servant is promised some cores and
//! memory, and never more is promised than there is.
//!
//! Waiting robots are served in the order of their priorities, and within a priority in order of arrival. A robot that
//! was overtaken [`MAX_OVERTAKES`] times goes before all later ones, whatever their priority (bounded overtaking, as
//! required of fair locks), so none starves. The first in the queue blocks those behind it, or large servants would
//! starve. Pushes come after all robots.

use std::time::Duration;

use super::Amount;
use super::capacity::Shortage;

/// Maximum number of times that a waiting request may be overtaken.
pub const MAX_OVERTAKES: u32 = 8;

/// The error of a servant that is not admitted, or not promised more.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AdmissionError {
    /// The request exceeds the capacity of the machine.
    #[error(
        "a servant of {} cores and {} of memory does not fit on this machine, which has {} cores and {} for servants",
        wanted.cpus(), api::Size(wanted.memory), capacity.cpus(), api::Size(capacity.memory)
    )]
    TooBig {
        /// The requested amount.
        wanted: Amount,
        /// The capacity of the machine.
        capacity: Amount,
    },
    /// A running servant cannot be promised more.
    #[error(
        "no capacity for a servant of {} cores and {} of memory: {} cores and {} are available",
        wanted.cpus(), api::Size(wanted.memory), free.cpus(), api::Size(free.memory)
    )]
    NoMore {
        /// The requested amount.
        wanted: Amount,
        /// The amount that is available to it.
        free: Amount,
    },
    /// The queue is full.
    #[error("this machine is full, with {} already waiting", api::count(*waiting, "robot"))]
    QueueFull {
        /// Number of waiting robots.
        waiting: usize,
    },
    /// No capacity came free by the deadline.
    #[error("this machine is full; no capacity became free within {} s{}", waited.as_secs(), position_suffix(place))]
    Deadline {
        /// Time waited.
        waited: Duration,
        /// Last position in the queue; `None` if the request was not a robot's.
        place: Option<Position>,
    },
    /// The machine stalled until the deadline.
    #[error("{why}; this did not end within {} s{}", waited.as_secs(), position_suffix(place))]
    Stalled {
        /// Human-readable reason of the stall.
        why: String,
        /// Time waited.
        waited: Duration,
        /// Last position in the queue; `None` if the request was not a robot's.
        place: Option<Position>,
    },
    /// The machine stalls: running servants are promised no more.
    #[error("{why}: no servant gets more resources meanwhile")]
    NoMoreNow {
        /// Human-readable reason of the stall.
        why: String,
    },
}

/// Returns the suffix of an error message that gives the position in the queue.
fn position_suffix(place: &Option<Position>) -> String {
    place.map_or_else(String::new, |place| format!("; it was {place}"))
}

/// Position of a robot in the queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Position {
    /// Position, starting at 1.
    pub place: usize,
    /// Number of waiting robots.
    pub of: usize,
}

impl std::fmt::Display for Position {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(out, "number {} of {} waiting", self.place, self.of)
    }
}

/// Identifies a request for admission.
pub type Ticket = u64;

/// Origin of a request, which determines its rank.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A servant of a robot.
    Robot,
    /// Work without a robot, such as a push: any waiting request that fits goes before it, or a large push would keep
    /// robots waiting. It takes no robot's place in the queue, and gives its capacity back when a robot needs it.
    Push,
}

/// A request for admission.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AdmissionRequest {
    /// The requested amount.
    pub wanted: Amount,
    /// Origin of the request.
    pub origin: Origin,
    /// Priority: robots with a higher one go first (default: 0). Pushes have none.
    pub priority: i32,
}

impl AdmissionRequest {
    /// Creates a request for a robot of this priority.
    pub fn robot(wanted: Amount, priority: i32) -> AdmissionRequest {
        AdmissionRequest { wanted, origin: Origin::Robot, priority }
    }

    /// Creates a request for a push.
    pub fn push(wanted: Amount) -> AdmissionRequest {
        AdmissionRequest { wanted, origin: Origin::Push, priority: 0 }
    }
}

/// Decision about a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum AdmissionVerdict {
    /// The requested amount is promised.
    Admitted,
    /// The request is queued.
    Waits,
    /// The request is refused.
    Refused(AdmissionError),
}

/// A queued request that is admitted now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AdmittedRequest {
    /// Ticket of the request.
    pub ticket: Ticket,
    /// The promised amount.
    pub amount: Amount,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Waiter {
    ticket: Ticket,
    ask: AdmissionRequest,
    /// Number of later requests that were admitted before it.
    overtaken: u32,
}

impl Waiter {
    fn is_robot(&self) -> bool {
        self.ask.origin == Origin::Robot
    }

    /// Returns the sort key in the queue: smaller ranks go first; within a rank, those who came first.
    fn rank(&self) -> (bool, bool, std::cmp::Reverse<i32>) {
        let patient = self.overtaken < MAX_OVERTAKES;
        let priority = if patient { self.ask.priority } else { 0 };
        (!self.is_robot(), patient, std::cmp::Reverse(priority))
    }
}

/// The capacity of the machine, the promises, and the queue.
#[derive(Debug, Clone, PartialEq)]
pub struct AdmissionLedger {
    capacity: Amount,
    promised: Amount,
    /// Waiting requests, in order of arrival.
    waiting: Vec<Waiter>,
    /// Maximum number of waiting robots.
    queue: usize,
    /// Reason why admission is stalled, if it is.
    stalled: Option<String>,
}

impl AdmissionLedger {
    /// Creates the ledger of a machine with `capacity` for servants and a queue of at most `queue` robots.
    pub fn new(capacity: Amount, queue: usize) -> AdmissionLedger {
        AdmissionLedger { capacity, promised: Amount::NONE, waiting: Vec::new(), queue, stalled: None }
    }

    /// Returns the capacity.
    pub fn capacity(&self) -> Amount {
        self.capacity
    }

    /// Returns the promised part of the capacity.
    pub fn promised_total(&self) -> Amount {
        self.promised
    }

    /// Returns the number of waiting requests.
    pub fn waiting_count(&self) -> usize {
        self.waiting.len()
    }

    /// Returns the reason why admission is stalled, if it is.
    pub fn stall_reason(&self) -> Option<&str> {
        self.stalled.as_deref()
    }

    fn free(&self) -> Amount {
        self.capacity.minus(self.promised)
    }

    /// Returns the positions of the waiting robots.
    pub fn queue_positions(&self) -> impl Iterator<Item = (Ticket, Position)> + '_ {
        let robots = self.by_rank().into_iter().filter(|waiter| waiter.is_robot());
        let of = self.waiting.iter().filter(|waiter| waiter.is_robot()).count();
        robots.zip(1..).map(move |(waiter, place)| (waiter.ticket, Position { place, of }))
    }

    /// Returns the waiting requests in the order in which they are to be admitted.
    fn by_rank(&self) -> Vec<Waiter> {
        let mut turn = self.waiting.clone();
        turn.sort_by_key(Waiter::rank);
        turn
    }

    /// Returns how much more capacity would have to be free.
    pub fn shortage(&self) -> Shortage {
        let free = self.free();
        let first = self.by_rank().into_iter().find(Waiter::is_robot);
        Shortage {
            all: self.wanted_by(|_| true).minus(free),
            first_robot: first.map_or(Amount::NONE, |first| first.ask.wanted.minus(free)),
        }
    }

    /// Returns the number of waiting robots if no further one may wait, whatever its priority.
    pub fn full_queue_len(&self) -> Option<usize> {
        let robots = self.waiting.iter().filter(|one| one.is_robot()).count();
        (robots >= self.queue).then_some(robots)
    }

    /// Returns what the waiting robots requested that would be admitted before a new one of this priority.
    pub fn wanted_before(&self, priority: i32) -> Amount {
        let new = Waiter { ticket: 0, ask: AdmissionRequest::robot(Amount::NONE, priority), overtaken: 0 };
        self.wanted_by(|waiter| waiter.is_robot() && waiter.rank() <= new.rank())
    }

    /// Returns what all waiting robots requested.
    pub fn wanted_by_robots(&self) -> Amount {
        self.wanted_by(Waiter::is_robot)
    }

    fn wanted_by(&self, who: impl Fn(&Waiter) -> bool) -> Amount {
        let waiting = self.waiting.iter().filter(|waiter| who(waiter));
        waiting.fold(Amount::NONE, |sum, waiter| sum.plus(waiter.ask.wanted))
    }

    /// Refuses a request that exceeds the capacity of the machine.
    pub fn check(&self, wanted: Amount) -> Result<(), AdmissionError> {
        let capacity = self.capacity;
        if wanted.fits(capacity) { Ok(()) } else { Err(AdmissionError::TooBig { wanted, capacity }) }
    }

    /// Handles a request. Returns the decision, with the requests that are admitted because they were overtaken once
    /// more.
    pub fn request(&mut self, ticket: Ticket, ask: AdmissionRequest) -> (AdmissionVerdict, Vec<AdmittedRequest>) {
        self.enqueue(ticket, ask, None)
    }

    /// Handles a repeated request, which has waited before and was overtaken `overtaken` times: it keeps its position,
    /// even if the queue is full.
    pub fn request_again(
        &mut self,
        ticket: Ticket,
        ask: AdmissionRequest,
        overtaken: u32,
    ) -> (AdmissionVerdict, Vec<AdmittedRequest>) {
        self.enqueue(ticket, ask, Some(overtaken))
    }

    /// Returns how often a waiting request was overtaken.
    pub fn overtaken_count(&self, ticket: Ticket) -> Option<u32> {
        let mut waiting = self.waiting.iter();
        waiting.find(|one| one.ticket == ticket).map(|one| one.overtaken)
    }

    fn enqueue(
        &mut self,
        ticket: Ticket,
        ask: AdmissionRequest,
        again: Option<u32>,
    ) -> (AdmissionVerdict, Vec<AdmittedRequest>) {
        if let Err(refused) = self.check(ask.wanted) {
            return (AdmissionVerdict::Refused(refused), Vec::new());
        }
        let waiter = Waiter { ticket, ask, overtaken: again.unwrap_or(0) };
        let robots = self.waiting.iter().filter(|one| one.is_robot()).count();
        let at = self.waiting.partition_point(|one| one.ticket < ticket);
        self.waiting.insert(at, waiter);
        let mut admitted = self.admit();
        let own = admitted.iter().position(|one| one.ticket == ticket);
        let verdict = match own {
            Some(own) => {
                admitted.remove(own);
                AdmissionVerdict::Admitted
            }
            None if waiter.is_robot() && robots >= self.queue && again.is_none() => {
                self.waiting.retain(|one| one.ticket != ticket);
                AdmissionVerdict::Refused(AdmissionError::QueueFull { waiting: robots })
            }
            None => AdmissionVerdict::Waits,
        };
        (verdict, admitted)
    }

    /// Returns true if the queue is empty and the machine does not stall.
    pub fn is_uncontended(&self) -> bool {
        self.waiting.is_empty() && self.stalled.is_none()
    }

    /// Promises `amount` to background work, if it is free and the queue is empty; returns true if so.
    pub fn take_spare(&mut self, amount: Amount) -> bool {
        let spare = self.is_uncontended() && amount.fits(self.free());
        if spare {
            self.promise(amount);
        }
        spare
    }

    /// Promises `amount` even if it is not free: to a servant that runs already.
    pub fn promise(&mut self, amount: Amount) {
        self.promised = self.promised.plus(amount);
    }

    /// Removes a request from the queue; returns the requests behind it that are admitted for that.
    pub fn withdraw(&mut self, ticket: Ticket) -> Vec<AdmittedRequest> {
        self.waiting.retain(|waiter| waiter.ticket != ticket);
        self.admit()
    }

    /// Releases a promise; returns the requests that are admitted for that.
    pub fn release(&mut self, amount: Amount) -> Vec<AdmittedRequest> {
        self.promised = self.promised.minus(amount);
        self.admit()
    }

    /// Stalls admission for this reason, or resumes it; returns the requests that are admitted.
    pub fn set_stall(&mut self, why: Option<String>) -> Vec<AdmittedRequest> {
        self.stalled = why;
        self.admit()
    }

    /// Changes a servant's promise from `promised` to `wanted`, if the increase is free and no robot waits for it;
    /// returns the requests that are admitted for a decrease.
    pub fn change_promise(&mut self, promised: Amount, wanted: Amount) -> Result<Vec<AdmittedRequest>, AdmissionError> {
        let others = self.promised.minus(promised);
        let free = self.capacity.minus(others).minus(self.wanted_by_robots());
        let free = free.max(promised);
        if !wanted.fits(free) {
            return Err(AdmissionError::NoMore { wanted, free });
        }
        if let Some(why) = self.stalled.clone().filter(|_| !wanted.fits(promised)) {
            return Err(AdmissionError::NoMoreNow { why });
        }
        self.promised = others.plus(wanted);
        Ok(self.admit())
    }

    /// Admits waiting requests in their order as far as there is capacity.
    fn admit(&mut self) -> Vec<AdmittedRequest> {
        let mut admitted = Vec::new();
        while let Some(ticket) = self.next_ticket() {
            // Requests behind it came later.
            let Some(at) = self.waiting.iter().position(|one| one.ticket == ticket) else {
                break;
            };
            let waiter = self.waiting.remove(at);
            for earlier in &mut self.waiting[..at] {
                earlier.overtaken += 1;
            }
            self.promise(waiter.ask.wanted);
            admitted.push(AdmittedRequest { ticket, amount: waiter.ask.wanted });
        }
        admitted
    }

    /// Returns the request that is admitted next, if any.
    fn next_ticket(&self) -> Option<Ticket> {
        if self.stalled.is_some() || self.waiting.is_empty() {
            return None;
        }
        for waiter in self.by_rank() {
            if waiter.ask.wanted.fits(self.free()) {
                return Some(waiter.ticket);
            }
            if waiter.is_robot() || waiter.overtaken >= MAX_OVERTAKES {
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

    /// Returns a machine of two cores, of which `promised` are promised.
    fn machine(queue: usize, promised: f64) -> AdmissionLedger {
        let mut book = AdmissionLedger::new(Amount::new(2.0, 1000), queue);
        book.promise(cores(promised));
        book
    }

    fn tickets(admitted: Vec<AdmittedRequest>) -> Vec<Ticket> {
        admitted.into_iter().map(|one| one.ticket).collect()
    }

    fn ask(book: &mut AdmissionLedger, ticket: Ticket, cpus: f64, origin: Origin) -> AdmissionVerdict {
        ask_with_priority(book, ticket, cpus, origin, 0)
    }

    fn ask_with_priority(
        book: &mut AdmissionLedger,
        ticket: Ticket,
        cpus: f64,
        origin: Origin,
        priority: i32,
    ) -> AdmissionVerdict {
        let ask = AdmissionRequest { wanted: cores(cpus), origin, priority };
        let (verdict, others) = book.request(ticket, ask);
        assert!(others.is_empty(), "{others:?}");
        verdict
    }

    #[test]
    fn who_asks_is_admitted_waits_or_is_refused() {
        let full = AdmissionVerdict::Refused(AdmissionError::QueueFull { waiting: 1 });
        for (promised, waits, wanted, origin, expected) in [
            (0.0, None, 2.0, Robot, AdmissionVerdict::Admitted),
            (1.5, None, 0.5, Robot, AdmissionVerdict::Admitted),
            (1.5, None, 0.6, Robot, AdmissionVerdict::Waits),
            // Robots overtake only pushes, and the number of waiting robots is bounded.
            (1.5, Some((1.0, Robot)), 0.5, Robot, full),
            (1.5, Some((1.0, Push)), 0.5, Robot, AdmissionVerdict::Admitted),
            (1.5, Some((1.0, Push)), 1.0, Robot, AdmissionVerdict::Waits),
            (1.5, Some((1.0, Push)), 0.6, Push, AdmissionVerdict::Waits),
            (1.5, Some((1.0, Push)), 0.5, Push, AdmissionVerdict::Admitted),
            (1.5, Some((1.0, Robot)), 0.5, Push, AdmissionVerdict::Waits),
            (0.0, None, 0.5, Push, AdmissionVerdict::Admitted),
        ] {
            let mut book = machine(1, promised);
            if let Some((wanted, origin)) = waits {
                assert_eq!(ask(&mut book, 1, wanted, origin), AdmissionVerdict::Waits);
            }
            let verdict = ask(&mut book, 2, wanted, origin);
            assert_eq!(verdict, expected, "{promised} {waits:?} {wanted} {origin:?}");
        }
        let ask = AdmissionRequest::robot(Amount::new(0.0, 1001), 0);
        let (verdict, _) = machine(1, 0.0).request(1, ask);
        assert!(matches!(verdict, AdmissionVerdict::Refused(AdmissionError::TooBig { .. })));
    }

    #[test]
    fn small_ones_do_not_overtake_a_big_one() {
        let mut book = machine(4, 1.0);
        assert_eq!(ask(&mut book, 1, 2.0, Robot), AdmissionVerdict::Waits);
        assert_eq!(ask(&mut book, 2, 0.5, Robot), AdmissionVerdict::Waits);
        assert!(book.release(cores(0.5)).is_empty());
        assert_eq!(tickets(book.release(cores(0.5))), [1]);
        assert_eq!(tickets(book.release(cores(2.0))), [2]);
    }

    #[test]
    fn who_gives_up_lets_the_next_in() {
        let mut book = machine(4, 1.0);
        assert_eq!(ask(&mut book, 1, 2.0, Robot), AdmissionVerdict::Waits);
        assert_eq!(ask(&mut book, 2, 0.5, Robot), AdmissionVerdict::Waits);
        assert_eq!(book.shortage().all, cores(1.5));
        assert_eq!(book.shortage().first_robot, cores(1.0));
        assert_eq!(tickets(book.withdraw(1)), [2]);
        assert_eq!((book.waiting_count(), book.shortage()), (0, Shortage::default()));
    }

    #[test]
    fn robots_that_fit_go_before_a_push_that_does_not() {
        let mut book = machine(1, 1.5);
        assert_eq!(ask(&mut book, 1, 2.0, Push), AdmissionVerdict::Waits);
        assert_eq!(ask(&mut book, 2, 1.0, Robot), AdmissionVerdict::Waits);
        assert_eq!(book.shortage().first_robot, cores(0.5));
        assert_eq!(tickets(book.release(cores(0.5))), [2]);
        assert!(book.release(cores(1.0)).is_empty());
        assert_eq!(tickets(book.release(cores(1.0))), [1]);
    }

    #[test]
    fn robots_of_a_higher_priority_go_first() {
        let mut book = machine(8, 2.0);
        for (ticket, cpus, priority) in [(1, 1.0, 0), (2, 1.0, 5), (3, 1.0, 5), (4, 0.5, -1)] {
            let verdict = ask_with_priority(&mut book, ticket, cpus, Robot, priority);
            assert_eq!(verdict, AdmissionVerdict::Waits);
        }
        let places: Vec<_> = book.queue_positions().map(|(ticket, place)| (place.place, ticket)).collect();
        assert_eq!(places, [(1, 2), (2, 3), (3, 1), (4, 4)]);
        assert_eq!(
            book.queue_positions().next().map(|one| one.1.to_string()).as_deref(),
            Some("number 1 of 4 waiting")
        );
        assert_eq!(tickets(book.release(cores(1.0))), [2]);
        // A request that is first and fits goes before all waiting ones.
        assert!(book.release(cores(0.5)).is_empty());
        assert_eq!(ask_with_priority(&mut book, 5, 0.5, Robot, 9), AdmissionVerdict::Admitted);
        assert_eq!(tickets(book.release(cores(2.0))), [3, 1]);
    }

    #[test]
    fn nobody_is_overtaken_for_ever() {
        let mut book = machine(64, 2.0);
        assert_eq!(ask(&mut book, 0, 1.0, Robot), AdmissionVerdict::Waits);
        for ticket in 1..=u64::from(MAX_OVERTAKES) + 3 {
            assert_eq!(ask_with_priority(&mut book, ticket, 1.0, Robot, 9), AdmissionVerdict::Waits);
        }
        let mut before = Vec::new();
        loop {
            let admitted = tickets(book.release(cores(1.0)));
            if admitted.contains(&0) {
                break;
            }
            before.extend(admitted);
        }
        assert_eq!(before, (1..=u64::from(MAX_OVERTAKES)).collect::<Vec<_>>());
        // The last request that overtakes it lets it in.
        let mut book = machine(64, 2.0);
        assert_eq!(ask_with_priority(&mut book, 0, 0.1, Robot, 0), AdmissionVerdict::Waits);
        assert_eq!(ask_with_priority(&mut book, 1, 1.0, Robot, 5), AdmissionVerdict::Waits);
        assert!(book.release(cores(0.4)).is_empty(), "the first one blocks");
        let last = u64::from(MAX_OVERTAKES) + 1;
        for ticket in 2..last {
            assert_eq!(ask_with_priority(&mut book, ticket, 0.01, Robot, 9), AdmissionVerdict::Admitted);
        }
        let (verdict, others) = book.request(last, AdmissionRequest::robot(cores(0.01), 9));
        assert_eq!((verdict, tickets(others)), (AdmissionVerdict::Admitted, vec![0]));
    }

    #[test]
    fn who_comes_back_stands_where_it_stood() {
        let mut book = machine(2, 2.0);
        for ticket in [1, 2] {
            assert_eq!(ask(&mut book, ticket, 1.0, Robot), AdmissionVerdict::Waits);
        }
        assert_eq!(book.overtaken_count(1), Some(0));
        assert!(book.withdraw(1).is_empty());
        assert_eq!(ask(&mut book, 3, 1.0, Robot), AdmissionVerdict::Waits);
        // Two wait, which is the maximum: a new one is refused, and one that had a position is not.
        let full = AdmissionVerdict::Refused(AdmissionError::QueueFull { waiting: 2 });
        assert_eq!(ask(&mut book, 4, 1.0, Robot), full);
        let (verdict, others) = book.request_again(1, AdmissionRequest::robot(cores(1.0), 0), MAX_OVERTAKES);
        assert_eq!((verdict, others), (AdmissionVerdict::Waits, vec![]));
        assert_eq!(book.overtaken_count(1), Some(MAX_OVERTAKES));
        let order: Vec<Ticket> = book.queue_positions().map(|(ticket, _)| ticket).collect();
        assert_eq!(order, [1, 2, 3]);
        assert_eq!(tickets(book.release(cores(2.0))), [1, 2]);
        // A request that is served at once needs no position.
        let (verdict, _) = machine(2, 0.0).request_again(1, AdmissionRequest::robot(cores(1.0), 0), 3);
        assert_eq!(verdict, AdmissionVerdict::Admitted);
        assert_eq!(book.overtaken_count(9), None);
    }

    #[test]
    fn a_machine_that_stalls_admits_nobody() {
        let mut book = machine(4, 0.0);
        assert!(book.set_stall(Some("it swaps".into())).is_empty());
        assert_eq!(ask(&mut book, 1, 1.0, Robot), AdmissionVerdict::Waits);
        assert_eq!(ask(&mut book, 2, 0.1, Push), AdmissionVerdict::Waits);
        assert!(book.release(Amount::NONE).is_empty() && book.withdraw(9).is_empty());
        assert_eq!(book.stall_reason(), Some("it swaps"));
        book.promise(cores(0.5));
        let why = "it swaps".to_owned();
        assert_eq!(book.change_promise(cores(0.5), cores(0.6)), Err(AdmissionError::NoMoreNow { why }));
        assert_eq!(book.change_promise(cores(0.5), cores(0.4)), Ok(vec![]));
        assert_eq!(tickets(book.set_stall(None)), [1, 2]);
    }

    #[test]
    fn a_promise_grows_by_what_is_free() {
        let mut book = machine(4, 1.0);
        book.promise(cores(0.5));
        assert_eq!(book.change_promise(cores(1.0), cores(1.5)), Ok(vec![]));
        let free = Amount::new(1.5, 1000);
        let wanted = cores(1.6);
        let refused = book.change_promise(cores(1.5), wanted);
        assert_eq!(refused, Err(AdmissionError::NoMore { wanted, free }));
        assert_eq!(ask(&mut book, 1, 1.0, Robot), AdmissionVerdict::Waits);
        let admitted = book.change_promise(cores(1.5), cores(0.1)).expect("less");
        assert_eq!(tickets(admitted), [1]);
        assert_eq!(book.promised_total(), cores(1.6));
        // If more is promised than there is (servants of an earlier daemon), a promise may shrink.
        book.promise(cores(2.0));
        assert_eq!(book.change_promise(cores(1.0), cores(0.9)), Ok(vec![]));
    }

    #[test]
    fn a_promise_does_not_grow_by_what_robots_wait_for() {
        let mut book = machine(4, 1.0);
        assert_eq!(ask(&mut book, 1, 1.5, Robot), AdmissionVerdict::Waits);
        let wanted = cores(1.1);
        let free = Amount::new(1.0, 1000);
        let refused = book.change_promise(cores(1.0), wanted);
        assert_eq!(refused, Err(AdmissionError::NoMore { wanted, free }));
        // It may have more of what nobody waits for.
        assert_eq!(book.change_promise(cores(1.0), free), Ok(vec![]));
        let mut book = machine(4, 1.0);
        assert_eq!(ask(&mut book, 1, 1.5, Push), AdmissionVerdict::Waits);
        assert_eq!(book.change_promise(cores(1.0), wanted), Ok(vec![]));
    }
}
