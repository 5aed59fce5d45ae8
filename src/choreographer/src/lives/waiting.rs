//! Carries out admission decisions: keeps the ledger under a lock, lets requests wait, and reports their positions.

use std::collections::HashMap;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::{oneshot, watch};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use crate::decide::Amount;
use crate::decide::admission::{
    AdmissionError, AdmissionLedger, AdmissionRequest, AdmissionVerdict, AdmittedRequest, Origin, Position, Ticket,
};
use crate::decide::capacity::{PushPromise, Shortage};

/// Time within which a robot that waited in vain, or lost its connection meanwhile, keeps its position when it asks
/// again.
const POSITION_EXPIRY: Duration = Duration::from_secs(30);
/// Maximum number of kept positions.
const MAX_POSITIONS: usize = 1000;

/// The machine's capacity for servants, shared by all requesters.
#[derive(Clone)]
pub struct Admission {
    desk: Arc<Mutex<AdmissionState>>,
}

struct AdmissionState {
    book: AdmissionLedger,
    /// Waiting requests by ticket.
    doors: HashMap<Ticket, WaitingRequest>,
    /// Admitted pushes.
    pushes: HashMap<Ticket, PushWork>,
    /// Positions of robots that waited in vain, or went away while waiting.
    kept: HashMap<String, KeptPosition>,
    tickets: Ticket,
}

/// The position of a robot that does not wait at the moment.
struct KeptPosition {
    ticket: Ticket,
    overtaken: u32,
    since: Instant,
}

struct WaitingRequest {
    opens: oneshot::Sender<Permit>,
    origin: Origin,
    stands: watch::Sender<Option<QueueStanding>>,
}

struct PushWork {
    /// The push's promise, which may have been changed.
    has: Arc<Mutex<Option<Amount>>>,
    gives_way: CancellationToken,
}

/// Position of a waiting robot, and the reason of a stall, if any.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct QueueStanding {
    /// Position in the queue.
    pub place: Position,
    /// Reason of a stall, in words.
    pub stalled: Option<String>,
}

impl fmt::Display for QueueStanding {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.stalled {
            Some(why) => write!(out, "{why}, so no robot is admitted; this robot is {}", self.place),
            None => write!(out, "this machine is full; this robot is {}", self.place),
        }
    }
}

/// A promise of capacity, released on drop.
pub struct Permit {
    promise: Promise,
    /// Set for a push.
    work: Option<(Ticket, CancellationToken)>,
}

/// The amount promised by a permit. Nothing is promised any more once the permit is dropped.
#[derive(Clone)]
pub struct Promise {
    /// Locked only while the state is locked.
    amount: Arc<Mutex<Option<Amount>>>,
    admission: Admission,
}

impl Permit {
    /// Returns its promise, which can be changed.
    pub fn promise(&self) -> Promise {
        self.promise.clone()
    }

    /// Waits until a robot needs the capacity of a push: it should be given back soon, and requested again.
    pub async fn wait_needed(&self) {
        match &self.work {
            Some((_, gives_way)) => gives_way.cancelled().await,
            None => std::future::pending().await,
        }
    }
}

impl Promise {
    /// Changes the promise to `wanted`, if the increase is free.
    pub fn change(&self, wanted: Amount) -> Result<(), AdmissionError> {
        self.admission.update(|book| {
            let mut amount = self.amount.lock();
            let Some(promised) = *amount else {
                return (Ok(()), Vec::new());
            };
            match book.change_promise(promised, wanted) {
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
        admission.update(|book| {
            let amount = amount.lock().take().unwrap_or_default();
            ((), book.release(amount))
        });
    }
}

impl Admission {
    /// Creates the admission control of a machine with `capacity` for servants and a queue of at most `queue` robots.
    pub fn new(capacity: Amount, queue: usize) -> Admission {
        let desk = AdmissionState {
            book: AdmissionLedger::new(capacity, queue),
            doors: HashMap::new(),
            pushes: HashMap::new(),
            kept: HashMap::new(),
            tickets: 0,
        };
        Admission { desk: Arc::new(Mutex::new(desk)) }
    }

    /// Decides and records atomically; then issues permits to the admitted requests, and reports the positions of the
    /// others.
    fn update<T>(&self, decision: impl FnOnce(&mut AdmissionLedger) -> (T, Vec<AdmittedRequest>)) -> T {
        let mut desk = self.desk.lock();
        let (outcome, admitted) = decision(&mut desk.book);
        let told = self.issue_permits(&mut desk, admitted);
        desk.update_standings();
        drop(desk);
        deliver_permits(told);
        outcome
    }

    /// Creates permits for the admitted requests, with their recipients.
    fn issue_permits(
        &self,
        desk: &mut AdmissionState,
        admitted: Vec<AdmittedRequest>,
    ) -> Vec<(Option<WaitingRequest>, Permit)> {
        let mut told = Vec::new();
        for AdmittedRequest { ticket, amount } in admitted {
            // A request that has just stopped waiting has none any more.
            let door = desk.doors.remove(&ticket);
            let origin = door.as_ref().map_or(Origin::Robot, |door| door.origin);
            told.push((door, self.new_permit(desk, ticket, origin, amount)));
        }
        told
    }

    fn new_permit(&self, desk: &mut AdmissionState, ticket: Ticket, origin: Origin, has: Amount) -> Permit {
        let promise = self.new_promise(has);
        let work = (origin == Origin::Push).then(|| {
            let gives_way = CancellationToken::new();
            let working = PushWork { has: Arc::clone(&promise.amount), gives_way: gives_way.clone() };
            desk.pushes.insert(ticket, working);
            (ticket, gives_way)
        });
        Permit { promise, work }
    }

    fn new_promise(&self, amount: Amount) -> Promise {
        Promise { amount: Arc::new(Mutex::new(Some(amount))), admission: self.clone() }
    }

    /// Returns the capacity, the promised part, and the number of waiting requests.
    pub fn snapshot(&self) -> (Amount, Amount, usize) {
        let desk = self.desk.lock();
        let book = &desk.book;
        (book.capacity(), book.promised_total(), book.waiting_count())
    }

    /// Returns the reason why admission is stalled, if so.
    pub fn stall_reason(&self) -> Option<String> {
        self.desk.lock().book.stall_reason().map(str::to_owned)
    }

    /// Stalls admission for this reason, or resumes it; returns true if that is new.
    pub(crate) fn set_stall(&self, why: Option<String>) -> bool {
        self.update(|book| {
            let new = book.stall_reason().is_some() != why.is_some();
            (new, book.set_stall(why))
        })
    }

    /// Returns a copy of the ledger.
    pub(crate) fn ledger(&self) -> AdmissionLedger {
        self.desk.lock().book.clone()
    }

    /// Returns how much more capacity would have to be free, and the admitted pushes.
    pub(crate) fn shortage(&self) -> (Shortage, Vec<PushPromise>) {
        let desk = self.desk.lock();
        let pushes = desk.pushes.iter().map(|(ticket, working)| PushPromise {
            ticket: *ticket,
            has: working.has.lock().unwrap_or_default(),
            gives_way: working.gives_way.is_cancelled(),
        });
        (desk.book.shortage(), pushes.collect())
    }

    /// Asks these pushes to give their capacity back.
    pub(crate) fn give_way(&self, pushes: &[Ticket]) {
        let desk = self.desk.lock();
        for push in pushes.iter().filter_map(|ticket| desk.pushes.get(ticket)) {
            push.gives_way.cancel();
        }
    }

    /// Refuses a request that exceeds the capacity of the machine.
    pub fn check(&self, wanted: Amount) -> Result<(), AdmissionError> {
        self.desk.lock().book.check(wanted)
    }

    /// Takes `wanted` even if it is not free: for servants that run already.
    pub(crate) fn adopt(&self, wanted: Amount) -> Permit {
        self.desk.lock().book.promise(wanted);
        Permit { promise: self.new_promise(wanted), work: None }
    }

    /// Returns true if no request waits and the machine does not stall.
    pub(crate) fn is_uncontended(&self) -> bool {
        self.desk.lock().book.is_uncontended()
    }

    /// Takes `wanted` for background work, if it is free and no request waits.
    pub(crate) fn try_admit(&self, wanted: Amount) -> Option<Permit> {
        let spare = self.desk.lock().book.take_spare(wanted);
        spare.then(|| Permit { promise: self.new_promise(wanted), work: None })
    }

    /// Takes the requested amount, waiting at most `deadline`, and reports its position by `stands` meanwhile. Calls
    /// `on_wait` if it is not available at once.
    pub(crate) async fn admit(
        &self,
        ask: AdmissionRequest,
        deadline: Duration,
        stands: watch::Sender<Option<QueueStanding>>,
        on_wait: impl FnOnce(),
    ) -> Result<Permit, AdmissionError> {
        self.admit_as(None, ask, deadline, stands, on_wait).await
    }

    /// Like [`admit`](Self::admit), for the requester `who`: if it has waited in vain lately, or went away while
    /// waiting, it keeps its position.
    pub(crate) async fn admit_as(
        &self,
        who: Option<&str>,
        ask: AdmissionRequest,
        deadline: Duration,
        stands: watch::Sender<Option<QueueStanding>>,
        on_wait: impl FnOnce(),
    ) -> Result<Permit, AdmissionError> {
        let standing = stands.subscribe();
        let (mut waiting, admitted) = {
            let mut desk = self.desk.lock();
            let kept = who.and_then(|who| desk.kept.remove(who));
            let kept = kept.filter(|kept| kept.since.elapsed() < POSITION_EXPIRY);
            let (ticket, (verdict, others)) = match kept {
                Some(kept) => (kept.ticket, desk.book.request_again(kept.ticket, ask, kept.overtaken)),
                None => {
                    desk.tickets += 1;
                    let ticket = desk.tickets;
                    (ticket, desk.book.request(ticket, ask))
                }
            };
            let told = self.issue_permits(&mut desk, others);
            let outcome = match verdict {
                AdmissionVerdict::Admitted => Err(Ok(self.new_permit(&mut desk, ticket, ask.origin, ask.wanted))),
                AdmissionVerdict::Refused(refused) => Err(Err(refused)),
                AdmissionVerdict::Waits => {
                    let (opens, admitted) = oneshot::channel();
                    let door = WaitingRequest { opens, origin: ask.origin, stands };
                    desk.doors.insert(ticket, door);
                    desk.update_standings();
                    Ok((ticket, admitted))
                }
            };
            drop(desk);
            deliver_permits(told);
            match outcome {
                Ok((ticket, admitted)) => {
                    let waiting = QueuedTicket { admission: self, ticket, who };
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
                Err(timeout_error(deadline, standing, self.stall_reason()))
            }
        }
    }
}

/// Delivers permits. Not under the lock: a permit may be dropped at once, if its recipient has stopped waiting.
fn deliver_permits(told: Vec<(Option<WaitingRequest>, Permit)>) {
    for (door, permit) in told {
        if let Some(door) = door {
            door.stands.send_replace(None);
            let _ = door.opens.send(permit);
        }
    }
}

/// Returns the error of a request that waited in vain.
fn timeout_error(waited: Duration, standing: Option<QueueStanding>, stalled: Option<String>) -> AdmissionError {
    let place = standing.map(|standing| standing.place);
    match stalled {
        Some(why) => AdmissionError::Stalled { why, waited, place },
        None => AdmissionError::Deadline { waited, place },
    }
}

impl AdmissionState {
    /// Keeps the position of a request that waits, or was admitted without being notified, for its next attempt.
    fn keep_position(&mut self, who: &str, ticket: Ticket) {
        let overtaken = self.book.overtaken_count(ticket).unwrap_or(0);
        self.kept.retain(|_, kept| kept.since.elapsed() < POSITION_EXPIRY);
        if self.kept.len() < MAX_POSITIONS {
            let kept = KeptPosition { ticket, overtaken, since: Instant::now() };
            self.kept.insert(who.to_owned(), kept);
        }
    }

    /// Reports the positions of waiting robots, if they have changed.
    fn update_standings(&self) {
        for (ticket, place) in self.book.queue_positions() {
            let Some(door) = self.doors.get(&ticket) else {
                continue;
            };
            let stands = Some(QueueStanding { place, stalled: self.book.stall_reason().map(str::to_owned) });
            door.stands.send_if_modified(|before| {
                let changed = *before != stands;
                *before = stands;
                changed
            });
        }
    }
}

/// A waiting request. When it stops waiting, those behind it may fit.
struct QueuedTicket<'a> {
    admission: &'a Admission,
    ticket: Ticket,
    /// The requester whose position is kept when it stops waiting.
    who: Option<&'a str>,
}

impl Drop for QueuedTicket<'_> {
    fn drop(&mut self) {
        let door = {
            let mut desk = self.admission.desk.lock();
            if let Some(who) = self.who {
                desk.keep_position(who, self.ticket);
            }
            desk.doors.remove(&self.ticket)
        };
        self.admission.update(|book| ((), book.withdraw(self.ticket)));
        // A permit that was not received is dropped with it, which locks the state.
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

    /// Requests these cores for a robot.
    async fn robot(
        room: &Admission,
        cpus: f64,
        patience: Duration,
        on_wait: impl FnOnce(),
    ) -> Result<Permit, AdmissionError> {
        let ask = AdmissionRequest::robot(Amount::new(cpus, 0), 0);
        room.admit(ask, patience, watch::Sender::new(None), on_wait).await
    }

    #[tokio::test(start_paused = true)]
    async fn who_waits_is_admitted_when_another_leaves() {
        let room = machine();
        let first = robot(&room, 2.0, SECOND, || panic!("it is free"));
        let first = std::cell::Cell::new(Some(first.await.expect("it is free")));
        let second = robot(&room, 1.0, SECOND, || drop(first.take()));
        let second = second.await.expect("it came free");
        assert_eq!(room.snapshot(), (Amount::new(2.0, 1000), Amount::new(1.0, 0), 0));
        drop(second);
        assert_eq!(room.snapshot().1, Amount::NONE);
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
            "this machine is full; no capacity became free within 1 s; it was number 1 of 2 waiting"
        );
        small.expect("fits once the big one has gone");
        assert_eq!(room.snapshot().2, 0, "nobody waits any more");
    }

    #[tokio::test(start_paused = true)]
    async fn who_waited_in_vain_and_asks_again_soon_stands_where_it_stood() {
        let room = machine();
        let all = robot(&room, 2.0, SECOND, || {}).await.expect("it is free");
        let asks = |who, patience| {
            let (stands, ask) = (watch::Sender::new(None), AdmissionRequest::robot(Amount::new(1.0, 0), 0));
            let (watched, room) = (stands.subscribe(), room.clone());
            let waiting = async move { room.admit_as(Some(who), ask, patience, stands, || {}).await };
            (watched, waiting)
        };
        let place = |stands: &watch::Receiver<Option<QueueStanding>>| {
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
        // Too late, and under another name.
        tokio::time::sleep(POSITION_EXPIRY).await;
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
            let (stands, ask) = (watch::Sender::new(None), AdmissionRequest::robot(Amount::new(2.0, 0), 0));
            let (watched, room) = (stands.subscribe(), room.clone());
            let waiting = async move {
                let admitted = room.admit_as(Some(who), ask, SECOND * 100, stands, || {});
                admitted.await
            };
            (watched, tokio::spawn(waiting))
        };
        let place = |stands: &watch::Receiver<Option<QueueStanding>>| {
            let stands = stands.borrow();
            stands.as_ref().map(|stands| stands.place.place)
        };
        // The second time it is admitted before it is notified.
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
                // The other one got what came free, and it is the next.
                assert_eq!(place(&stands), Some(1));
                drop(behind.await.expect("no panic"));
                again.await.expect("no panic").expect("it comes free");
            } else {
                assert_eq!((place(&stands), place(&other)), (Some(1), Some(2)));
                for waits in [again, behind] {
                    waits.abort();
                    let _ = waits.await;
                }
                tokio::time::sleep(POSITION_EXPIRY).await;
            }
        }
        assert_eq!(room.snapshot().2, 0);
    }

    #[tokio::test(start_paused = true)]
    async fn kept_places_are_few() {
        let room = Admission::new(Amount::new(0.0, 0), 2 * MAX_POSITIONS);
        let waits = (0..MAX_POSITIONS + 10).map(|number| {
            let (room, ask) = (room.clone(), AdmissionRequest::robot(Amount::NONE, 0));
            room.set_stall(Some("it swaps".into()));
            async move {
                let who = format!("robot {number}");
                let stands = watch::Sender::new(None);
                let refused = room.admit_as(Some(&who), ask, SECOND, stands, || {}).await;
                refused.expect_err("nobody is admitted");
            }
        });
        futures_util::future::join_all(waits).await;
        assert_eq!(room.desk.lock().kept.len(), MAX_POSITIONS);
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
            assert_eq!(room.snapshot().2, 1);
            // Admitted, and gone before it is notified.
            drop(all);
            assert_eq!(room.snapshot().1, Amount::new(1.0, 0));
        }
        assert_eq!((room.snapshot().1, room.snapshot().2), (Amount::NONE, 0));
    }

    #[tokio::test(start_paused = true)]
    async fn who_waits_is_told_where_it_stands() {
        let room = machine();
        let all = robot(&room, 2.0, SECOND, || {}).await.expect("it is free");
        let wait = |priority| {
            let (room, stands) = (room.clone(), watch::Sender::new(None));
            let watched = stands.subscribe();
            let ask = AdmissionRequest::robot(Amount::new(1.0, 0), priority);
            let waiting = tokio::spawn(async move { room.admit(ask, SECOND * 60, stands, || {}).await });
            (watched, waiting)
        };
        let told = |stands: &mut watch::Receiver<Option<QueueStanding>>| {
            stands.borrow_and_update().as_ref().map(QueueStanding::to_string)
        };
        let (mut first, first_waits) = wait(0);
        first.changed().await.expect("it is told");
        let words = told(&mut first).unwrap_or_default();
        assert_eq!(words, "this machine is full; this robot is number 1 of 1 waiting");
        let (mut second, second_waits) = wait(1);
        second.changed().await.expect("it is told");
        assert!(told(&mut second).is_some_and(|words| words.contains("number 1 of 2")));
        first.changed().await.expect("it was overtaken");
        assert!(told(&mut first).is_some_and(|words| words.contains("number 2 of 2")));
        assert!(room.set_stall(Some("this machine swaps".into())));
        assert!(!room.set_stall(Some("this machine swaps more".into())), "that is not new");
        drop(all);
        first.changed().await.expect("the machine stalls");
        let words = told(&mut first).unwrap_or_default();
        assert!(words.starts_with("this machine swaps more, so no robot is admitted"), "{words}");
        assert!(room.set_stall(None));
        first_waits.await.expect("no panic").expect("it fits");
        second_waits.await.expect("no panic").expect("it fits");
        assert_eq!(told(&mut first), None);
    }

    #[tokio::test(start_paused = true)]
    async fn who_waits_in_vain_for_a_machine_that_stalls_is_told_that() {
        let room = machine();
        room.set_stall(Some("this machine swaps".into()));
        let refused = robot(&room, 1.0, SECOND, || {}).await.expect_err("nobody is admitted");
        assert_eq!(
            refused.to_string(),
            "this machine swaps; this did not end within 1 s; it was number 1 of 1 waiting"
        );
    }

    #[tokio::test(start_paused = true)]
    async fn a_push_is_told_when_a_robot_needs_what_it_has() {
        let room = machine();
        let push = AdmissionRequest::push(Amount::new(0.0, 600));
        let push = room.admit(push, SECOND, watch::Sender::new(None), || {});
        let push = push.await.expect("it is free");
        let robot = AdmissionRequest::robot(Amount::new(0.0, 500), 0);
        let waits = room.admit(robot, SECOND * 60, watch::Sender::new(None), || {
            let (lacking, pushes) = room.shortage();
            assert_eq!(lacking.first_robot, Amount::new(0.0, 100));
            assert_eq!(pushes.len(), 1);
            room.give_way(&[pushes[0].ticket]);
            assert!(room.shortage().1[0].gives_way);
        });
        let gives = async {
            push.wait_needed().await;
            drop(push);
        };
        let (robot, ()) = tokio::join!(waits, gives);
        let _robot = robot.expect("the push gave way");
        assert!(room.shortage().1.is_empty());
    }

    #[tokio::test(start_paused = true)]
    async fn what_a_push_has_is_what_it_is_promised_now() {
        let room = machine();
        let push = AdmissionRequest::push(Amount::new(0.1, 100));
        let push = room.admit(push, SECOND, watch::Sender::new(None), || {});
        let push = push.await.expect("it is free");
        let has = || room.shortage().1[0].has;
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
        assert_eq!(room.snapshot().1, Amount::new(2.0, 90));
        let refused = promise.change(Amount::new(1.6, 90)).expect_err("more than is left").to_string();
        assert!(refused.contains("1.5 cores"), "{refused}");
        assert_eq!(room.snapshot().1, Amount::new(2.0, 90));
        promise.change(Amount::new(0.1, 1)).expect("less");
        drop(one);
        promise.change(Amount::new(1.0, 1)).expect("nobody's");
        drop(two);
        assert_eq!(room.snapshot().1, Amount::NONE);
    }
}
