//! Who is admitted, who waits and who is refused: each servant is promised some cores and memory, and no more is promised
//! than the machine has.

use std::collections::VecDeque;
use std::time::Duration;

use super::Amount;

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
        /// What there is.
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
        /// So many.
        waiting: usize,
    },
    /// No capacity came free until the deadline.
    #[error("this machine is full; no room came free within {} s", waited.as_secs())]
    Deadline {
        /// So long was waited.
        waited: Duration,
    },
}

/// Names one who asks for admission.
pub type Ticket = u64;

/// Who asks, and how long it is willing to stand back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Class {
    /// A servant of a robot. None is overtaken by another robot, or big servants would wait for ever.
    Robot,
    /// Work that is nobody's robot, such as a push: whoever waits and fits goes before it, or a big one would keep robots
    /// waiting; and it takes no robot's place in the queue.
    Push,
}

/// What is decided of one who asks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// It is promised what it asked for.
    Admitted,
    /// It is in the queue.
    Waits,
    /// It is neither.
    Refused(Refused),
}

/// One in the queue that is promised what it asked for now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Admitted {
    /// Who.
    pub ticket: Ticket,
    /// What.
    pub amount: Amount,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Waiter {
    ticket: Ticket,
    wanted: Amount,
    class: Class,
}

/// What the machine has, what of it is promised, and who waits for it.
#[derive(Debug, Clone, PartialEq)]
pub struct Book {
    capacity: Amount,
    promised: Amount,
    /// In the order in which they came.
    waiting: VecDeque<Waiter>,
    /// Most robots that may wait.
    queue: usize,
}

impl Book {
    /// A machine with `capacity` for servants, before which at most `queue` robots may wait.
    pub fn new(capacity: Amount, queue: usize) -> Book {
        Book {
            capacity,
            promised: Amount::NONE,
            waiting: VecDeque::new(),
            queue,
        }
    }

    /// What there is.
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

    fn free(&self) -> Amount {
        self.capacity.minus(self.promised)
    }

    fn robots(&self) -> usize {
        let waiting = self.waiting.iter();
        waiting
            .filter(|waiter| waiter.class == Class::Robot)
            .count()
    }

    /// How much more would have to be free for all who wait.
    pub fn lacking(&self) -> Amount {
        self.wanted_by(|_| true).minus(self.free())
    }

    fn wanted_by(&self, who: impl Fn(&Waiter) -> bool) -> Amount {
        let waiting = self.waiting.iter().filter(|waiter| who(waiter));
        waiting.fold(Amount::NONE, |sum, waiter| sum.plus(waiter.wanted))
    }

    /// Refuses what would not fit on an empty machine.
    pub fn check(&self, wanted: Amount) -> Result<(), Refused> {
        let capacity = self.capacity;
        match wanted.fits(capacity) {
            true => Ok(()),
            false => Err(Refused::TooBig { wanted, capacity }),
        }
    }

    /// `ticket` asks for `wanted`.
    pub fn ask(&mut self, ticket: Ticket, wanted: Amount, class: Class) -> Verdict {
        if let Err(refused) = self.check(wanted) {
            return Verdict::Refused(refused);
        }
        let robots = self.robots();
        let first = match class {
            Class::Robot => robots == 0,
            Class::Push => self.waiting.is_empty(),
        };
        if first && wanted.fits(self.free()) {
            self.promise(wanted);
            return Verdict::Admitted;
        }
        if class == Class::Robot && robots >= self.queue {
            return Verdict::Refused(Refused::QueueFull { waiting: robots });
        }
        self.waiting.push_back(Waiter {
            ticket,
            wanted,
            class,
        });
        Verdict::Waits
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

    /// A servant is promised `wanted` instead of `promised`, if what is more is free and no robot waits for it; gives those
    /// who are admitted for what is less.
    pub fn change(&mut self, promised: Amount, wanted: Amount) -> Result<Vec<Admitted>, Refused> {
        let others = self.promised.minus(promised);
        let spoken_for = self.wanted_by(|waiter| waiter.class == Class::Robot);
        let free = self.capacity.minus(others).minus(spoken_for);
        let free = free.max(promised);
        if !wanted.fits(free) {
            return Err(Refused::NoMore { wanted, free });
        }
        self.promised = others.plus(wanted);
        Ok(self.admit())
    }

    /// Admits from the queue's head as far as there is capacity.
    fn admit(&mut self) -> Vec<Admitted> {
        let mut admitted = Vec::new();
        let mut blocked = false;
        for waiter in std::mem::take(&mut self.waiting) {
            if !blocked && waiter.wanted.fits(self.free()) {
                self.promise(waiter.wanted);
                admitted.push(Admitted {
                    ticket: waiter.ticket,
                    amount: waiter.wanted,
                });
                continue;
            }
            blocked |= waiter.class == Class::Robot;
            self.waiting.push_back(waiter);
        }
        admitted
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Class::{Push, Robot};

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

    #[test]
    fn who_asks_is_admitted_waits_or_is_refused() {
        let full = Verdict::Refused(Refused::QueueFull { waiting: 1 });
        for (promised, waits, wanted, class, expected) in [
            (0.0, None, 2.0, Robot, Verdict::Admitted),
            (1.5, None, 0.5, Robot, Verdict::Admitted),
            (1.5, None, 0.6, Robot, Verdict::Waits),
            // Nobody is overtaken by a robot but pushes, and robots that wait are bounded.
            (1.5, Some((1.0, Robot)), 0.5, Robot, full),
            (1.5, Some((1.0, Push)), 0.5, Robot, Verdict::Admitted),
            (1.5, Some((1.0, Push)), 1.0, Robot, Verdict::Waits),
            (1.5, Some((1.0, Push)), 0.5, Push, Verdict::Waits),
            (1.5, Some((1.0, Robot)), 0.5, Push, Verdict::Waits),
            (0.0, None, 0.5, Push, Verdict::Admitted),
        ] {
            let mut book = machine(1, promised);
            if let Some((wanted, class)) = waits {
                assert_eq!(book.ask(1, cores(wanted), class), Verdict::Waits);
            }
            let verdict = book.ask(2, cores(wanted), class);
            assert_eq!(verdict, expected, "{promised} {waits:?} {wanted} {class:?}");
        }
        let verdict = machine(1, 0.0).ask(1, Amount::new(0.0, 1001), Robot);
        assert!(matches!(verdict, Verdict::Refused(Refused::TooBig { .. })));
    }

    #[test]
    fn small_ones_do_not_overtake_a_big_one() {
        let mut book = machine(4, 1.0);
        assert_eq!(book.ask(1, cores(2.0), Robot), Verdict::Waits);
        assert_eq!(book.ask(2, cores(0.5), Robot), Verdict::Waits);
        assert!(book.release(cores(0.5)).is_empty());
        assert_eq!(tickets(book.release(cores(0.5))), [1]);
        assert_eq!(tickets(book.release(cores(2.0))), [2]);
    }

    #[test]
    fn who_gives_up_lets_the_next_in() {
        let mut book = machine(4, 1.0);
        assert_eq!(book.ask(1, cores(2.0), Robot), Verdict::Waits);
        assert_eq!(book.ask(2, cores(0.5), Robot), Verdict::Waits);
        assert_eq!(book.lacking(), cores(1.5));
        assert_eq!(tickets(book.leave(1)), [2]);
        assert_eq!((book.waiting(), book.lacking()), (0, Amount::NONE));
    }

    #[test]
    fn robots_that_fit_go_before_a_push_that_does_not() {
        let mut book = machine(1, 1.5);
        assert_eq!(book.ask(1, cores(2.0), Push), Verdict::Waits);
        assert_eq!(book.ask(2, cores(1.0), Robot), Verdict::Waits);
        assert_eq!(tickets(book.release(cores(0.5))), [2]);
        assert!(book.release(cores(1.0)).is_empty());
        assert_eq!(tickets(book.release(cores(1.0))), [1]);
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
        assert_eq!(book.ask(1, cores(1.0), Robot), Verdict::Waits);
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
        assert_eq!(book.ask(1, cores(1.5), Robot), Verdict::Waits);
        let wanted = cores(1.1);
        let free = Amount::new(1.0, 1000);
        let refused = book.change(cores(1.0), wanted);
        assert_eq!(refused, Err(Refused::NoMore { wanted, free }));
        // Of what nobody waits for it may have more.
        assert_eq!(book.change(cores(1.0), free), Ok(vec![]));
        let mut book = machine(4, 1.0);
        assert_eq!(book.ask(1, cores(1.5), Push), Verdict::Waits);
        assert_eq!(book.change(cores(1.0), wanted), Ok(vec![]));
    }
}
