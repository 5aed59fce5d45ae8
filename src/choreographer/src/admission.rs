//! Room for servants: each is promised some cores and memory, and no more is promised than the machine has.
//! Who finds no room waits in a queue, first come first served, until there is some or a deadline passes.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::oneshot;

/// Cores (in thousandths, so that sums are exact) and memory.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Amount {
    /// Thousandths of a core.
    pub millicpus: u64,
    /// Bytes.
    pub memory: u64,
}

impl Amount {
    /// From cores and bytes.
    pub fn new(cpus: f64, memory: u64) -> Amount {
        Amount {
            millicpus: (cpus * 1000.0).round() as u64,
            memory,
        }
    }

    /// Cores.
    pub fn cpus(self) -> f64 {
        self.millicpus as f64 / 1000.0
    }

    fn plus(self, other: Amount) -> Amount {
        Amount {
            millicpus: self.millicpus.saturating_add(other.millicpus),
            memory: self.memory.saturating_add(other.memory),
        }
    }

    /// What is left of it, down to nothing.
    pub fn minus(self, other: Amount) -> Amount {
        Amount {
            millicpus: self.millicpus.saturating_sub(other.millicpus),
            memory: self.memory.saturating_sub(other.memory),
        }
    }

    fn fits(self, room: Amount) -> bool {
        self.millicpus <= room.millicpus && self.memory <= room.memory
    }
}

/// Why there is no room.
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
    /// No room until the deadline.
    #[error("this machine is full; no room came free within {} s", waited.as_secs())]
    Deadline {
        /// So long was waited.
        waited: Duration,
    },
}

struct Waiter {
    wanted: Amount,
    /// Those behind it that fit go before it.
    yields: bool,
    admit: oneshot::Sender<Permit>,
}

struct Book {
    capacity: Amount,
    taken: Amount,
    waiting: VecDeque<Waiter>,
    queue: usize,
}

/// The machine's room.
#[derive(Clone)]
pub struct Admission {
    book: Arc<Mutex<Book>>,
}

/// A promise kept until dropped.
pub struct Permit {
    promise: Promise,
}

/// How much is promised by a permit. Promises nothing once that is dropped.
#[derive(Clone)]
pub struct Promise {
    /// Locked only while the book is.
    amount: Arc<Mutex<Option<Amount>>>,
    book: Arc<Mutex<Book>>,
}

impl Permit {
    fn new(amount: Amount, book: &Arc<Mutex<Book>>) -> Permit {
        let promise = Promise {
            amount: Arc::new(Mutex::new(Some(amount))),
            book: Arc::clone(book),
        };
        Permit { promise }
    }

    /// How much it promises, to be changed.
    pub fn promise(&self) -> Promise {
        self.promise.clone()
    }
}

impl Promise {
    /// Promises `wanted` instead, if there is room for what is more. Who waits for room goes before.
    pub fn change(&self, wanted: Amount) -> Result<(), Refused> {
        let admitted = {
            let mut book = self.book.lock();
            let mut amount = self.amount.lock();
            let Some(promised) = *amount else {
                return Ok(());
            };
            let others = book.taken.minus(promised);
            let free = book.capacity.minus(others);
            let grows = !wanted.fits(promised);
            if grows && !wanted.fits(free) {
                return Err(Refused::NoMore { wanted, free });
            }
            *amount = Some(wanted);
            drop(amount);
            book.taken = others.plus(wanted);
            book.admit_waiting(&self.book)
        };
        for (waiter, permit) in admitted {
            let _ = waiter.send(permit);
        }
        Ok(())
    }
}

impl std::fmt::Debug for Permit {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.debug_tuple("Permit").finish_non_exhaustive()
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let mut book = self.promise.book.lock();
        let amount = self.promise.amount.lock().take().unwrap_or_default();
        book.taken = book.taken.minus(amount);
        let admitted = book.admit_waiting(&self.promise.book);
        drop(book);
        // Handing over may drop the permit at once (nobody waits any more), which locks the book again.
        for (waiter, permit) in admitted {
            let _ = waiter.send(permit);
        }
    }
}

impl Book {
    fn take(&mut self, wanted: Amount, book: &Arc<Mutex<Book>>) -> Option<Permit> {
        let fits = wanted.fits(self.capacity.minus(self.taken));
        fits.then(|| {
            self.taken = self.taken.plus(wanted);
            Permit::new(wanted, book)
        })
    }

    /// Admits from the queue's head as far as there is room. A robot is never overtaken, or big servants would wait
    /// for ever; a push is, or a big one would keep robots waiting.
    fn admit_waiting(&mut self, book: &Arc<Mutex<Book>>) -> Vec<(oneshot::Sender<Permit>, Permit)> {
        let mut admitted = Vec::new();
        let mut blocked = false;
        for waiter in std::mem::take(&mut self.waiting) {
            if waiter.admit.is_closed() {
                continue;
            }
            if !blocked && let Some(permit) = self.take(waiter.wanted, book) {
                admitted.push((waiter.admit, permit));
                continue;
            }
            blocked |= !waiter.yields;
            self.waiting.push_back(waiter);
        }
        admitted
    }
}

impl Admission {
    /// A machine with `capacity` for servants, before which at most `queue` robots may wait.
    pub fn new(capacity: Amount, queue: usize) -> Admission {
        let book = Book {
            capacity,
            taken: Amount::default(),
            waiting: VecDeque::new(),
            queue,
        };
        Admission {
            book: Arc::new(Mutex::new(book)),
        }
    }

    /// What there is, what is taken, and how many wait.
    pub fn look(&self) -> (Amount, Amount, usize) {
        let book = self.book.lock();
        let waiting = book
            .waiting
            .iter()
            .filter(|waiter| !waiter.admit.is_closed())
            .count();
        (book.capacity, book.taken, waiting)
    }

    /// How much more would have to be free for all who wait.
    pub fn lacking(&self) -> Amount {
        let book = self.book.lock();
        let waiting = book.waiting.iter();
        let wanted = waiting
            .filter(|waiter| !waiter.admit.is_closed())
            .fold(Amount::default(), |sum, waiter| sum.plus(waiter.wanted));
        wanted.minus(book.capacity.minus(book.taken))
    }

    /// Refuses what would never fit.
    pub fn check(&self, wanted: Amount) -> Result<(), Refused> {
        let capacity = self.book.lock().capacity;
        if wanted.fits(capacity) {
            Ok(())
        } else {
            Err(Refused::TooBig { wanted, capacity })
        }
    }

    /// Takes `wanted` even where there is no room: for servants that run already.
    pub fn adopt(&self, wanted: Amount) -> Permit {
        let mut book = self.book.lock();
        book.taken = book.taken.plus(wanted);
        Permit::new(wanted, &self.book)
    }

    /// Takes `wanted`, waiting at most `deadline`. Calls `on_wait` when there is no room at once.
    pub async fn admit(
        &self,
        wanted: Amount,
        deadline: Duration,
        on_wait: impl FnOnce(),
    ) -> Result<Permit, Refused> {
        self.wait(wanted, false, deadline, on_wait).await
    }

    /// The same for what is nobody's robot: whoever waits and fits goes before it, and it takes no robot's place in the
    /// queue.
    pub async fn admit_yielding(
        &self,
        wanted: Amount,
        deadline: Duration,
        on_wait: impl FnOnce(),
    ) -> Result<Permit, Refused> {
        self.wait(wanted, true, deadline, on_wait).await
    }

    async fn wait(
        &self,
        wanted: Amount,
        yields: bool,
        deadline: Duration,
        on_wait: impl FnOnce(),
    ) -> Result<Permit, Refused> {
        self.check(wanted)?;
        let admitted = {
            let mut book = self.book.lock();
            book.waiting.retain(|waiter| !waiter.admit.is_closed());
            let robots = book.waiting.iter().filter(|waiter| !waiter.yields).count();
            let first = if yields {
                book.waiting.is_empty()
            } else {
                robots == 0
            };
            if first && let Some(permit) = book.take(wanted, &self.book) {
                return Ok(permit);
            }
            if !yields && robots >= book.queue {
                return Err(Refused::QueueFull { waiting: robots });
            }
            let (admit, admitted) = oneshot::channel();
            book.waiting.push_back(Waiter {
                wanted,
                yields,
                admit,
            });
            admitted
        };
        let given_up = GivenUp { book: &self.book };
        on_wait();
        let outcome = match tokio::time::timeout(deadline, admitted).await {
            Ok(Ok(permit)) => Ok(permit),
            _ => Err(Refused::Deadline { waited: deadline }),
        };
        drop(given_up);
        outcome
    }
}

/// When someone stops waiting, those behind may fit.
struct GivenUp<'a> {
    book: &'a Arc<Mutex<Book>>,
}

impl Drop for GivenUp<'_> {
    fn drop(&mut self) {
        let admitted = self.book.lock().admit_waiting(self.book);
        for (waiter, permit) in admitted {
            let _ = waiter.send(permit);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn machine(queue: usize) -> Admission {
        Admission::new(Amount::new(2.0, 1000), queue)
    }

    #[tokio::test(start_paused = true)]
    async fn room_is_given_and_comes_back() {
        let room = machine(4);
        let first = room
            .admit(Amount::new(1.5, 500), SECOND, || panic!("there is room"))
            .await
            .expect("room");
        assert_eq!(room.look().1, Amount::new(1.5, 500));
        drop(first);
        assert_eq!(room.look().1, Amount::default());
    }

    #[tokio::test(start_paused = true)]
    async fn who_waits_is_admitted_when_another_leaves() {
        let room = machine(4);
        let first = room
            .admit(Amount::new(2.0, 0), SECOND, || {})
            .await
            .expect("room");
        let leave = std::cell::Cell::new(Some(first));
        let second = room
            .admit(Amount::new(1.0, 0), SECOND, || drop(leave.take()))
            .await
            .expect("room came free");
        assert_eq!(
            room.look(),
            (Amount::new(2.0, 1000), Amount::new(1.0, 0), 0)
        );
        drop(second);
    }

    #[tokio::test(start_paused = true)]
    async fn waiting_ends_at_the_deadline() {
        let room = machine(4);
        let _all = room
            .admit(Amount::new(0.0, 1000), SECOND, || {})
            .await
            .expect("room");
        let refused = room
            .admit(Amount::new(0.0, 1), SECOND, || {})
            .await
            .expect_err("full");
        assert_eq!(refused, Refused::Deadline { waited: SECOND });
        assert_eq!(room.look().2, 0, "nobody waits any more");
    }

    #[tokio::test(start_paused = true)]
    async fn the_queue_is_bounded_and_the_impossible_refused() {
        let room = machine(0);
        let _all = room
            .admit(Amount::new(2.0, 0), SECOND, || {})
            .await
            .expect("room");
        let refused = room
            .admit(Amount::new(1.0, 0), SECOND, || {})
            .await
            .expect_err("full");
        assert_eq!(refused, Refused::QueueFull { waiting: 0 });
        let refused = room
            .admit(Amount::new(0.0, 1001), SECOND, || {})
            .await
            .expect_err("too big");
        assert!(matches!(refused, Refused::TooBig { .. }), "{refused}");
    }

    #[tokio::test(start_paused = true)]
    async fn robots_that_fit_go_before_a_push_that_does_not() {
        let room = machine(1);
        let half = room
            .admit(Amount::new(1.0, 0), SECOND, || {})
            .await
            .expect("room");
        let push = room.admit_yielding(Amount::new(2.0, 0), SECOND * 9, || {});
        tokio::pin!(push);
        tokio::select! {
            biased;
            _ = &mut push => panic!("no room for the push"),
            () = tokio::task::yield_now() => {}
        }
        let small = room
            .admit(Amount::new(0.5, 0), SECOND, || panic!("it fits"))
            .await
            .expect("room beside the push that waits");
        // It takes no robot's place in the queue of one, and a robot behind it is admitted when there is room.
        let other = room.admit(Amount::new(1.0, 0), SECOND, || drop(half));
        let other = other.await.expect("room came free");
        drop((small, other));
        push.await.expect("all robots have left");
    }

    #[tokio::test(start_paused = true)]
    async fn small_ones_do_not_overtake_a_big_one() {
        let room = machine(4);
        let half = room
            .admit(Amount::new(1.0, 0), SECOND, || {})
            .await
            .expect("room");
        let big = room.admit(Amount::new(2.0, 0), SECOND, || {});
        let small = room.admit(Amount::new(0.5, 0), SECOND * 2, || {});
        tokio::pin!(big, small);
        tokio::select! {
            biased;
            _ = &mut big => panic!("no room for the big one"),
            _ = &mut small => panic!("the small one overtook"),
            () = tokio::time::sleep(SECOND / 2) => {}
        }
        drop(half);
        let permit = big.await.expect("the big one is first");
        drop(permit);
        small.await.expect("then the small one");
    }

    #[tokio::test(start_paused = true)]
    async fn who_gives_up_lets_the_next_in() {
        let room = machine(4);
        let _half = room
            .admit(Amount::new(1.0, 0), SECOND, || {})
            .await
            .expect("room");
        let big = room.admit(Amount::new(2.0, 0), SECOND, || {});
        let small = room.admit(Amount::new(0.5, 0), SECOND * 5, || {});
        let (big, small) = tokio::join!(big, small);
        assert_eq!(
            big.expect_err("never fits"),
            Refused::Deadline { waited: SECOND }
        );
        small.expect("fits once the big one has gone");
    }

    #[tokio::test]
    async fn a_promise_is_changed_where_there_is_room() {
        let admission = Admission::new(Amount::new(2.0, 100), 4);
        let no_wait = Duration::ZERO;
        let one = admission
            .admit(Amount::new(1.0, 10), no_wait, || {})
            .await
            .expect("room");
        let two = admission
            .admit(Amount::new(0.5, 10), no_wait, || {})
            .await
            .expect("room");
        let promise = one.promise();
        promise.change(Amount::new(1.5, 90)).expect("just so");
        assert_eq!(admission.look().1, Amount::new(2.0, 100));
        let refused = promise
            .change(Amount::new(1.6, 90))
            .expect_err("more than is left")
            .to_string();
        assert!(refused.contains("1.5 cores"), "{refused}");
        assert_eq!(admission.look().1, Amount::new(2.0, 100));
        promise.change(Amount::new(0.1, 1)).expect("less");
        drop(one);
        promise.change(Amount::new(1.0, 1)).expect("nobody's");
        drop(two);
        assert_eq!(admission.look().1, Amount::default());
    }
}
