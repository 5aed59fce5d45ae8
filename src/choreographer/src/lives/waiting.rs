//! Carries out what is decided of admission: keeps the book under a lock, has those who wait wait, and tells them where they
//! stand.

use std::collections::HashMap;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::{oneshot, watch};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use crate::decide::Amount;
use crate::decide::admission::{Admitted, Ask, Book, Origin, Position, Refused, Ticket, Verdict};
use crate::decide::capacity::{Lacking, Push};

/// A robot that waited in vain, or whose connection broke meanwhile, and asks again within this time stands where it stood.
const KEPT: Duration = Duration::from_secs(30);
/// Places that are kept at most.
const MOST_KEPT: usize = 1000;

/// The machine's capacity for servants, shared by all who ask for some.
#[derive(Clone)]
pub struct Admission {
    desk: Arc<Mutex<Desk>>,
}

struct Desk {
    book: Book,
    /// Where those who wait are told.
    doors: HashMap<Ticket, Door>,
    /// Pushes that were admitted.
    pushes: HashMap<Ticket, Working>,
    /// Of robots that waited in vain, or went away while they waited.
    kept: HashMap<String, Kept>,
    tickets: Ticket,
}

/// The place of one that does not wait just now.
struct Kept {
    ticket: Ticket,
    overtaken: u32,
    since: Instant,
}

struct Door {
    opens: oneshot::Sender<Permit>,
    origin: Origin,
    stands: watch::Sender<Option<Standing>>,
}

struct Working {
    /// Its promise, which may have been changed.
    has: Arc<Mutex<Option<Amount>>>,
    gives_way: CancellationToken,
}

/// Where a robot stands that waits, and why nobody is admitted, if so.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Standing {
    /// Its place.
    pub place: Position,
    /// What the machine itself waits for, in words.
    pub stalled: Option<String>,
}

impl fmt::Display for Standing {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.stalled {
            Some(why) => write!(
                out,
                "{why}, and admits nobody meanwhile; this robot is {}",
                self.place
            ),
            None => write!(out, "this machine is full; this robot is {}", self.place),
        }
    }
}

/// A promise kept until dropped.
pub struct Permit {
    promise: Promise,
    /// A push's.
    work: Option<(Ticket, CancellationToken)>,
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

    /// Comes back when a robot needs what a push was promised: it is to be given back soon, and asked for again.
    pub async fn is_needed(&self) {
        match &self.work {
            Some((_, gives_way)) => gives_way.cancelled().await,
            None => std::future::pending().await,
        }
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

impl fmt::Debug for Permit {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_tuple("Permit").finish_non_exhaustive()
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let Promise { amount, admission } = &self.promise;
        if let Some((ticket, _)) = self.work {
            admission.desk.lock().pushes.remove(&ticket);
        }
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
            pushes: HashMap::new(),
            kept: HashMap::new(),
            tickets: 0,
        };
        Admission {
            desk: Arc::new(Mutex::new(desk)),
        }
    }

    /// Decides and records in one go; then gives those who were admitted for it their permits, and tells the others where
    /// they stand.
    fn decide<T>(&self, decision: impl FnOnce(&mut Book) -> (T, Vec<Admitted>)) -> T {
        let mut desk = self.desk.lock();
        let (outcome, admitted) = decision(&mut desk.book);
        let told = self.admitted(&mut desk, admitted);
        desk.tell();
        drop(desk);
        hand_over(told);
        outcome
    }

    /// Permits for those who were admitted, and where to hand them over.
    fn admitted(&self, desk: &mut Desk, admitted: Vec<Admitted>) -> Vec<(Option<Door>, Permit)> {
        let mut told = Vec::new();
        for Admitted { ticket, amount } in admitted {
            // One that stops waiting just now has none any more.
            let door = desk.doors.remove(&ticket);
            let origin = door.as_ref().map_or(Origin::Robot, |door| door.origin);
            told.push((door, self.permit(desk, ticket, origin, amount)));
        }
        told
    }

    fn permit(&self, desk: &mut Desk, ticket: Ticket, origin: Origin, has: Amount) -> Permit {
        let promise = self.promise(has);
        let work = (origin == Origin::Push).then(|| {
            let gives_way = CancellationToken::new();
            let working = Working {
                has: Arc::clone(&promise.amount),
                gives_way: gives_way.clone(),
            };
            desk.pushes.insert(ticket, working);
            (ticket, gives_way)
        });
        Permit { promise, work }
    }

    fn promise(&self, amount: Amount) -> Promise {
        Promise {
            amount: Arc::new(Mutex::new(Some(amount))),
            admission: self.clone(),
        }
    }

    /// What there is, what is promised of it, and how many wait.
    pub fn look(&self) -> (Amount, Amount, usize) {
        let desk = self.desk.lock();
        let book = &desk.book;
        (book.capacity(), book.promised(), book.waiting())
    }

    /// Why nobody is admitted now, if so.
    pub fn stalled(&self) -> Option<String> {
        self.desk.lock().book.stalled().map(str::to_owned)
    }

    /// From now on nobody is admitted, for this reason, or those who fit are again; whether that is new.
    pub(crate) fn stall(&self, why: Option<String>) -> bool {
        self.decide(|book| {
            let new = book.stalled().is_some() != why.is_some();
            (new, book.stall(why))
        })
    }

    /// The book as it is now.
    pub(crate) fn book(&self) -> Book {
        self.desk.lock().book.clone()
    }

    /// How much more would have to be free for those who wait, and what pushes have.
    pub(crate) fn lacking(&self) -> (Lacking, Vec<Push>) {
        let desk = self.desk.lock();
        let pushes = desk.pushes.iter().map(|(ticket, working)| Push {
            ticket: *ticket,
            has: working.has.lock().unwrap_or_default(),
            gives_way: working.gives_way.is_cancelled(),
        });
        (desk.book.lacking(), pushes.collect())
    }

    /// Asks these pushes for what they have.
    pub(crate) fn give_way(&self, pushes: &[Ticket]) {
        let desk = self.desk.lock();
        for push in pushes.iter().filter_map(|ticket| desk.pushes.get(ticket)) {
            push.gives_way.cancel();
        }
    }

    /// Refuses what would never fit.
    pub fn check(&self, wanted: Amount) -> Result<(), Refused> {
        self.desk.lock().book.check(wanted)
    }

    /// Takes `wanted` even where it is not free: for servants that run already.
    pub(crate) fn adopt(&self, wanted: Amount) -> Permit {
        self.desk.lock().book.promise(wanted);
        Permit {
            promise: self.promise(wanted),
            work: None,
        }
    }

    /// Whether nobody waits, and the machine does not stall.
    pub(crate) fn is_calm(&self) -> bool {
        self.desk.lock().book.is_calm()
    }

    /// Takes `wanted` for something that nobody waits for, where it is free and nobody waits at all.
    pub(crate) fn admit_now(&self, wanted: Amount) -> Option<Permit> {
        let spare = self.desk.lock().book.take_spare(wanted);
        spare.then(|| Permit {
            promise: self.promise(wanted),
            work: None,
        })
    }

    /// Takes what is asked for, waiting at most `deadline`, and tells by `stands` where it stands meanwhile. Calls `on_wait`
    /// when it is not to be had at once.
    pub(crate) async fn admit(
        &self,
        ask: Ask,
        deadline: Duration,
        stands: watch::Sender<Option<Standing>>,
        on_wait: impl FnOnce(),
    ) -> Result<Permit, Refused> {
        self.admit_as(None, ask, deadline, stands, on_wait).await
    }

    /// The same for `who`: where it has waited in vain lately, or has gone away while it waited, it stands where it stood.
    pub(crate) async fn admit_as(
        &self,
        who: Option<&str>,
        ask: Ask,
        deadline: Duration,
        stands: watch::Sender<Option<Standing>>,
        on_wait: impl FnOnce(),
    ) -> Result<Permit, Refused> {
        let standing = stands.subscribe();
        let (mut waiting, admitted) = {
            let mut desk = self.desk.lock();
            let kept = who.and_then(|who| desk.kept.remove(who));
            let kept = kept.filter(|kept| kept.since.elapsed() < KEPT);
            let (ticket, (verdict, others)) = match kept {
                Some(kept) => (
                    kept.ticket,
                    desk.book.ask_again(kept.ticket, ask, kept.overtaken),
                ),
                None => {
                    desk.tickets += 1;
                    let ticket = desk.tickets;
                    (ticket, desk.book.ask(ticket, ask))
                }
            };
            let told = self.admitted(&mut desk, others);
            let outcome = match verdict {
                Verdict::Admitted => {
                    Err(Ok(self.permit(&mut desk, ticket, ask.origin, ask.wanted)))
                }
                Verdict::Refused(refused) => Err(Err(refused)),
                Verdict::Waits => {
                    let (opens, admitted) = oneshot::channel();
                    let door = Door {
                        opens,
                        origin: ask.origin,
                        stands,
                    };
                    desk.doors.insert(ticket, door);
                    desk.tell();
                    Ok((ticket, admitted))
                }
            };
            drop(desk);
            hand_over(told);
            match outcome {
                Ok((ticket, admitted)) => {
                    let waiting = Waiting {
                        admission: self,
                        ticket,
                        who,
                    };
                    (waiting, admitted)
                }
                Err(at_once) => return at_once,
            }
        };
        on_wait();
        match tokio::time::timeout(deadline, admitted).await {
            Ok(Ok(permit)) => {
                waiting.who = None;
                Ok(permit)
            }
            _ => {
                let standing = standing.borrow().clone();
                Err(late(deadline, standing, self.stalled()))
            }
        }
    }
}

/// Not under the lock: a permit may be dropped at once, since nobody waits any more.
fn hand_over(told: Vec<(Option<Door>, Permit)>) {
    for (door, permit) in told {
        if let Some(door) = door {
            door.stands.send_replace(None);
            let _ = door.opens.send(permit);
        }
    }
}

/// What is told to one who waited in vain.
fn late(waited: Duration, standing: Option<Standing>, stalled: Option<String>) -> Refused {
    let place = standing.map(|standing| standing.place);
    match stalled {
        Some(why) => Refused::Stalled { why, waited, place },
        None => Refused::Deadline { waited, place },
    }
}

impl Desk {
    /// Keeps the place of one that waits, or was admitted and has not heard of it, for when it asks again.
    fn keep(&mut self, who: &str, ticket: Ticket) {
        let overtaken = self.book.overtaken(ticket).unwrap_or(0);
        self.kept.retain(|_, kept| kept.since.elapsed() < KEPT);
        if self.kept.len() < MOST_KEPT {
            let kept = Kept {
                ticket,
                overtaken,
                since: Instant::now(),
            };
            self.kept.insert(who.to_owned(), kept);
        }
    }

    /// Tells robots that wait where they stand now, where that has changed.
    fn tell(&self) {
        for (ticket, place) in self.book.places() {
            let Some(door) = self.doors.get(&ticket) else {
                continue;
            };
            let stands = Some(Standing {
                place,
                stalled: self.book.stalled().map(str::to_owned),
            });
            door.stands.send_if_modified(|before| {
                let changed = *before != stands;
                *before = stands;
                changed
            });
        }
    }
}

/// One that waits. When it stops waiting, those behind it may fit.
struct Waiting<'a> {
    admission: &'a Admission,
    ticket: Ticket,
    /// Whose place is kept when it stops.
    who: Option<&'a str>,
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        let door = {
            let mut desk = self.admission.desk.lock();
            if let Some(who) = self.who {
                desk.keep(who, self.ticket);
            }
            desk.doors.remove(&self.ticket)
        };
        self.admission.decide(|book| ((), book.leave(self.ticket)));
        // A permit that was handed over to nobody is dropped with it, which locks the desk.
        drop(door);
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
        let ask = Ask::robot(Amount::new(cpus, 0), 0);
        room.admit(ask, patience, watch::Sender::new(None), on_wait)
            .await
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
            big.expect_err("never free").to_string(),
            "this machine is full; no room came free within 1 s; it was number 1 of 2 that wait"
        );
        small.expect("fits once the big one has gone");
        assert_eq!(room.look().2, 0, "nobody waits any more");
    }

    #[tokio::test(start_paused = true)]
    async fn who_waited_in_vain_and_asks_again_soon_stands_where_it_stood() {
        let room = machine();
        let all = robot(&room, 2.0, SECOND, || {}).await.expect("it is free");
        let asks = |who, patience| {
            let (stands, ask) = (watch::Sender::new(None), Ask::robot(Amount::new(1.0, 0), 0));
            let (watched, room) = (stands.subscribe(), room.clone());
            let waiting =
                async move { room.admit_as(Some(who), ask, patience, stands, || {}).await };
            (watched, waiting)
        };
        let place = |stands: &watch::Receiver<Option<Standing>>| {
            let stands = stands.borrow();
            stands.as_ref().map(|stands| stands.place.place)
        };
        let (_, late) = asks("a", SECOND);
        let (other, behind) = asks("b", SECOND * 100);
        let behind = tokio::spawn(behind);
        late.await.expect_err("nothing is free");
        assert_eq!(place(&other), Some(1));
        let (stands, again) = asks("a", SECOND);
        let (again, ()) = tokio::join!(again, async {
            tokio::task::yield_now().await;
            assert_eq!((place(&stands), place(&other)), (Some(1), Some(2)));
        });
        again.expect_err("nothing is free");
        // Too late, and as somebody else.
        tokio::time::sleep(KEPT).await;
        for who in ["a", "c"] {
            let (stands, again) = asks(who, SECOND);
            let (again, ()) = tokio::join!(again, async {
                tokio::task::yield_now().await;
                assert_eq!((place(&stands), place(&other)), (Some(2), Some(1)), "{who}");
            });
            again.expect_err("nothing is free");
        }
        drop(all);
        behind.await.expect("no panic").expect("it is the first");
    }

    #[tokio::test(start_paused = true)]
    async fn who_goes_away_while_it_waits_and_comes_back_soon_stands_where_it_stood() {
        let room = machine();
        let mut all = Some(robot(&room, 2.0, SECOND, || {}).await.expect("it is free"));
        let asks = |who: &'static str| {
            let (stands, ask) = (watch::Sender::new(None), Ask::robot(Amount::new(2.0, 0), 0));
            let (watched, room) = (stands.subscribe(), room.clone());
            let waiting = async move {
                let admitted = room.admit_as(Some(who), ask, SECOND * 100, stands, || {});
                admitted.await
            };
            (watched, tokio::spawn(waiting))
        };
        let place = |stands: &watch::Receiver<Option<Standing>>| {
            let stands = stands.borrow();
            stands.as_ref().map(|stands| stands.place.place)
        };
        // The second time it is admitted before it hears of it.
        for is_admitted in [false, true] {
            let (_, first) = asks("a");
            tokio::task::yield_now().await;
            let (other, behind) = asks("b");
            tokio::task::yield_now().await;
            assert_eq!(place(&other), Some(2));
            if is_admitted {
                drop(all.take());
                assert!(!first.is_finished());
            }
            first.abort();
            let _ = first.await;
            let (stands, again) = asks("a");
            tokio::task::yield_now().await;
            if is_admitted {
                // The other has what came free, and it is the next.
                assert_eq!(place(&stands), Some(1));
                drop(behind.await.expect("no panic"));
                again.await.expect("no panic").expect("it comes free");
            } else {
                assert_eq!((place(&stands), place(&other)), (Some(1), Some(2)));
                for waits in [again, behind] {
                    waits.abort();
                    let _ = waits.await;
                }
                tokio::time::sleep(KEPT).await;
            }
        }
        assert_eq!(room.look().2, 0);
    }

    #[tokio::test(start_paused = true)]
    async fn kept_places_are_few() {
        let room = Admission::new(Amount::new(0.0, 0), 2 * MOST_KEPT);
        let waits = (0..MOST_KEPT + 10).map(|number| {
            let (room, ask) = (room.clone(), Ask::robot(Amount::NONE, 0));
            room.stall(Some("it swaps".into()));
            async move {
                let who = format!("robot {number}");
                let stands = watch::Sender::new(None);
                let refused = room.admit_as(Some(&who), ask, SECOND, stands, || {}).await;
                refused.expect_err("nobody is admitted");
            }
        });
        futures_util::future::join_all(waits).await;
        assert_eq!(room.desk.lock().kept.len(), MOST_KEPT);
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

    #[tokio::test(start_paused = true)]
    async fn who_waits_is_told_where_it_stands() {
        let room = machine();
        let all = robot(&room, 2.0, SECOND, || {}).await.expect("it is free");
        let wait = |priority| {
            let (room, stands) = (room.clone(), watch::Sender::new(None));
            let watched = stands.subscribe();
            let ask = Ask::robot(Amount::new(1.0, 0), priority);
            let waiting =
                tokio::spawn(async move { room.admit(ask, SECOND * 60, stands, || {}).await });
            (watched, waiting)
        };
        let told = |stands: &mut watch::Receiver<Option<Standing>>| {
            stands.borrow_and_update().as_ref().map(Standing::to_string)
        };
        let (mut first, first_waits) = wait(0);
        first.changed().await.expect("it is told");
        let words = told(&mut first).unwrap_or_default();
        assert_eq!(
            words,
            "this machine is full; this robot is number 1 of 1 that wait"
        );
        let (mut second, second_waits) = wait(1);
        second.changed().await.expect("it is told");
        assert!(told(&mut second).is_some_and(|words| words.contains("number 1 of 2")));
        first.changed().await.expect("it was overtaken");
        assert!(told(&mut first).is_some_and(|words| words.contains("number 2 of 2")));
        assert!(room.stall(Some("this machine swaps".into())));
        assert!(
            !room.stall(Some("this machine swaps more".into())),
            "that is not new"
        );
        drop(all);
        first.changed().await.expect("the machine stalls");
        let words = told(&mut first).unwrap_or_default();
        assert!(
            words.starts_with("this machine swaps more, and admits nobody meanwhile"),
            "{words}"
        );
        assert!(room.stall(None));
        first_waits.await.expect("no panic").expect("it fits");
        second_waits.await.expect("no panic").expect("it fits");
        assert_eq!(told(&mut first), None);
    }

    #[tokio::test(start_paused = true)]
    async fn who_waits_in_vain_for_a_machine_that_stalls_is_told_that() {
        let room = machine();
        room.stall(Some("this machine swaps".into()));
        let refused = robot(&room, 1.0, SECOND, || {})
            .await
            .expect_err("nobody is admitted");
        assert_eq!(
            refused.to_string(),
            "this machine swaps; this did not end within 1 s; it was number 1 of 1 that wait"
        );
    }

    #[tokio::test(start_paused = true)]
    async fn a_push_is_told_when_a_robot_needs_what_it_has() {
        let room = machine();
        let push = Ask::push(Amount::new(0.0, 600));
        let push = room.admit(push, SECOND, watch::Sender::new(None), || {});
        let push = push.await.expect("it is free");
        let robot = Ask::robot(Amount::new(0.0, 500), 0);
        let waits = room.admit(robot, SECOND * 60, watch::Sender::new(None), || {
            let (lacking, pushes) = room.lacking();
            assert_eq!(lacking.first_robot, Amount::new(0.0, 100));
            assert_eq!(pushes.len(), 1);
            room.give_way(&[pushes[0].ticket]);
            assert!(room.lacking().1[0].gives_way);
        });
        let gives = async {
            push.is_needed().await;
            drop(push);
        };
        let (robot, ()) = tokio::join!(waits, gives);
        let _robot = robot.expect("the push gave way");
        assert!(room.lacking().1.is_empty());
    }

    #[tokio::test(start_paused = true)]
    async fn what_a_push_has_is_what_it_is_promised_now() {
        let room = machine();
        let push = Ask::push(Amount::new(0.1, 100));
        let push = room.admit(push, SECOND, watch::Sender::new(None), || {});
        let push = push.await.expect("it is free");
        let has = || room.lacking().1[0].has;
        for now in [Amount::new(1.9, 100), Amount::new(0.5, 200)] {
            push.promise().change(now).expect("it is free");
            assert_eq!(has(), now);
        }
        let more = push.promise().change(Amount::new(2.5, 200));
        more.expect_err("there is not so much");
        assert_eq!(has(), Amount::new(0.5, 200));
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
