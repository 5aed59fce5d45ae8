//! Carries out what is decided of admission: keeps the book under a lock, and has those who wait wait.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::oneshot;

use crate::decide::Amount;
use crate::decide::admission::{Admitted, Book, Class, Refused, Ticket, Verdict};

/// The machine's capacity for servants, shared by all who ask for some.
#[derive(Clone)]
pub struct Admission {
    desk: Arc<Mutex<Desk>>,
}

struct Desk {
    book: Book,
    /// Where those who wait are told.
    doors: HashMap<Ticket, oneshot::Sender<Permit>>,
    tickets: Ticket,
}

/// A promise kept until dropped.
pub struct Permit {
    promise: Promise,
}

/// How much is promised by a permit. Promises nothing once that is dropped.
#[derive(Clone)]
pub struct Promise {
    /// Locked only while the desk is.
    amount: Arc<Mutex<Option<Amount>>>,
    admission: Admission,
}

impl Permit {
    /// How much it promises, to be changed.
    pub fn promise(&self) -> Promise {
        self.promise.clone()
    }
}

impl Promise {
    /// Promises `wanted` instead, if what is more is free.
    pub fn change(&self, wanted: Amount) -> Result<(), Refused> {
        self.admission.decide(|book| {
            let mut amount = self.amount.lock();
            let Some(promised) = *amount else {
                return (Ok(()), Vec::new());
            };
            match book.change(promised, wanted) {
                Ok(admitted) => {
                    *amount = Some(wanted);
                    (Ok(()), admitted)
                }
                Err(refused) => (Err(refused), Vec::new()),
            }
        })
    }
}

impl std::fmt::Debug for Permit {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.debug_tuple("Permit").finish_non_exhaustive()
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let Promise { amount, admission } = &self.promise;
        admission.decide(|book| {
            let amount = amount.lock().take().unwrap_or_default();
            ((), book.release(amount))
        });
    }
}

impl Admission {
    /// A machine with `capacity` for servants, before which at most `queue` robots may wait.
    pub fn new(capacity: Amount, queue: usize) -> Admission {
        let desk = Desk {
            book: Book::new(capacity, queue),
            doors: HashMap::new(),
            tickets: 0,
        };
        Admission {
            desk: Arc::new(Mutex::new(desk)),
        }
    }

    /// Decides and records in one go; then gives those who were admitted for it their permits.
    fn decide<T>(&self, decision: impl FnOnce(&mut Book) -> (T, Vec<Admitted>)) -> T {
        let mut desk = self.desk.lock();
        let (outcome, admitted) = decision(&mut desk.book);
        let told: Vec<_> = admitted
            .into_iter()
            .map(|one| (desk.doors.remove(&one.ticket), self.permit(one.amount)))
            .collect();
        drop(desk);
        // Handing over may drop the permit at once (nobody waits any more), which locks the desk again.
        for (door, permit) in told {
            if let Some(door) = door {
                let _ = door.send(permit);
            }
        }
        outcome
    }

    fn permit(&self, amount: Amount) -> Permit {
        let promise = Promise {
            amount: Arc::new(Mutex::new(Some(amount))),
            admission: self.clone(),
        };
        Permit { promise }
    }

    /// What there is, what is promised of it, and how many wait.
    pub fn look(&self) -> (Amount, Amount, usize) {
        let desk = self.desk.lock();
        let book = &desk.book;
        (book.capacity(), book.promised(), book.waiting())
    }

    /// How much more would have to be free for all who wait.
    pub(crate) fn lacking(&self) -> Amount {
        self.desk.lock().book.lacking()
    }

    /// Refuses what would never fit.
    pub fn check(&self, wanted: Amount) -> Result<(), Refused> {
        self.desk.lock().book.check(wanted)
    }

    /// Takes `wanted` even where it is not free: for servants that run already.
    pub(crate) fn adopt(&self, wanted: Amount) -> Permit {
        self.desk.lock().book.promise(wanted);
        self.permit(wanted)
    }

    /// Takes `wanted`, waiting at most `deadline`. Calls `on_wait` when it is not to be had at once.
    pub(crate) async fn admit(
        &self,
        wanted: Amount,
        class: Class,
        deadline: Duration,
        on_wait: impl FnOnce(),
    ) -> Result<Permit, Refused> {
        let (_waiting, admitted) = {
            let mut desk = self.desk.lock();
            desk.tickets += 1;
            let ticket = desk.tickets;
            match desk.book.ask(ticket, wanted, class) {
                Verdict::Admitted => return Ok(self.permit(wanted)),
                Verdict::Refused(refused) => return Err(refused),
                Verdict::Waits => {}
            }
            let (door, admitted) = oneshot::channel();
            desk.doors.insert(ticket, door);
            let admission = self;
            (Waiting { admission, ticket }, admitted)
        };
        on_wait();
        match tokio::time::timeout(deadline, admitted).await {
            Ok(Ok(permit)) => Ok(permit),
            _ => Err(Refused::Deadline { waited: deadline }),
        }
    }
}

/// One that waits. When it stops waiting, those behind it may fit.
struct Waiting<'a> {
    admission: &'a Admission,
    ticket: Ticket,
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.admission.desk.lock().doors.remove(&self.ticket);
        self.admission.decide(|book| ((), book.leave(self.ticket)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn machine() -> Admission {
        Admission::new(Amount::new(2.0, 1000), 4)
    }

    /// A robot that asks for so many cores.
    async fn robot(
        room: &Admission,
        cpus: f64,
        patience: Duration,
        on_wait: impl FnOnce(),
    ) -> Result<Permit, Refused> {
        let wanted = Amount::new(cpus, 0);
        room.admit(wanted, Class::Robot, patience, on_wait).await
    }

    #[tokio::test(start_paused = true)]
    async fn who_waits_is_admitted_when_another_leaves() {
        let room = machine();
        let first = robot(&room, 2.0, SECOND, || panic!("it is free"));
        let first = std::cell::Cell::new(Some(first.await.expect("it is free")));
        let second = robot(&room, 1.0, SECOND, || drop(first.take()));
        let second = second.await.expect("it came free");
        assert_eq!(
            room.look(),
            (Amount::new(2.0, 1000), Amount::new(1.0, 0), 0)
        );
        drop(second);
        assert_eq!(room.look().1, Amount::NONE);
    }

    #[tokio::test(start_paused = true)]
    async fn waiting_ends_at_the_deadline_and_lets_the_next_in() {
        let room = machine();
        let _half = robot(&room, 1.0, SECOND, || {}).await.expect("it is free");
        let big = robot(&room, 2.0, SECOND, || {});
        let small = robot(&room, 0.5, SECOND * 5, || {});
        let (big, small) = tokio::join!(big, small);
        assert_eq!(
            big.expect_err("never free"),
            Refused::Deadline { waited: SECOND }
        );
        small.expect("fits once the big one has gone");
        assert_eq!(room.look().2, 0, "nobody waits any more");
    }

    #[tokio::test(start_paused = true)]
    async fn who_goes_away_while_it_waits_takes_nothing_along() {
        let room = machine();
        let all = robot(&room, 2.0, SECOND, || {}).await.expect("it is free");
        {
            let gone = robot(&room, 1.0, SECOND, || {});
            tokio::pin!(gone);
            tokio::select! {
                biased;
                _ = &mut gone => panic!("nothing is free"),
                () = tokio::task::yield_now() => {}
            }
            assert_eq!(room.look().2, 1);
            // Admitted, and gone before it hears of it.
            drop(all);
            assert_eq!(room.look().1, Amount::new(1.0, 0));
        }
        assert_eq!((room.look().1, room.look().2), (Amount::NONE, 0));
    }

    #[tokio::test]
    async fn a_promise_is_changed_where_there_is_room() {
        let room = machine();
        let one = robot(&room, 1.0, SECOND, || {}).await.expect("it is free");
        let two = robot(&room, 0.5, SECOND, || {}).await.expect("it is free");
        let promise = one.promise();
        promise.change(Amount::new(1.5, 90)).expect("just so");
        assert_eq!(room.look().1, Amount::new(2.0, 90));
        let refused = promise
            .change(Amount::new(1.6, 90))
            .expect_err("more than is left")
            .to_string();
        assert!(refused.contains("1.5 cores"), "{refused}");
        assert_eq!(room.look().1, Amount::new(2.0, 90));
        promise.change(Amount::new(0.1, 1)).expect("less");
        drop(one);
        promise.change(Amount::new(1.0, 1)).expect("nobody's");
        drop(two);
        assert_eq!(room.look().1, Amount::NONE);
    }
}
