//! For each request: who was asked, who answered first, what is a late duplicate.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::request::{Key, Leg, RequestId, Side};

/// What is kept, and for how long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// After its T_max a request is remembered for so long: late answers are recognised, and an input that nobody
    /// answered is given up.
    pub patience: Duration,
    /// Requests remembered; beyond it the oldest inputs are forgotten. Calls and goals are not counted: each holds a
    /// caller.
    pub requests: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            patience: Duration::from_secs(30),
            requests: 4096,
        }
    }
}

/// Inputs kept beyond their T_max, for a local original that has time for them.
const STRAGGLERS: usize = 8;

/// What to do with an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Hand it to the application.
    Deliver,
    /// The request was answered already, failed, or nobody knows it: drop it.
    Drop,
}

/// What kind of request it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A service call: exactly one result.
    Call(Arc<str>),
    /// A goal of an action: exactly one result. It may take long, and whoever has taken it carries it out while the way there
    /// is lost.
    Goal(Arc<str>),
    /// An input of the pair with this index.
    Input {
        pair: usize,
        key: Option<Key>,
        /// Outputs that answer it; the first one is the answer.
        outputs: usize,
    },
}

/// The requests of one node that are open or were until lately. `P` is what was asked, cheap to clone.
#[derive(Debug)]
pub struct Arbiter<P> {
    limits: Limits,
    next: u64,
    requests: BTreeMap<RequestId, Record<P>>,
    /// How many of them are inputs.
    inputs: usize,
    /// One for each of them ([`Record::timer`]): its T_max, or the end of its patience.
    timers: BTreeSet<(Instant, RequestId)>,
    /// Inputs that nobody answered by T_max, the oldest first.
    stragglers: VecDeque<RequestId>,
}

#[derive(Debug)]
pub(crate) struct Record<P> {
    pub(crate) kind: Kind,
    /// Until it is answered, failed, or, for inputs, too old to be asked anew.
    pub(crate) payload: Option<P>,
    pub(crate) asked_at: Instant,
    pub(crate) deadline: Instant,
    /// When it is looked at again.
    timer: Instant,
    pub(crate) cloud: Leg,
    pub(crate) local: Leg,
    /// Whose answer was taken, per output.
    owners: Vec<Option<Side>>,
    /// The application was told that there will be no answer.
    pub(crate) failed: bool,
    /// T_max has passed.
    pub(crate) overdue: bool,
    /// The cloud's time has counted, or that it had none.
    pub(crate) judged: bool,
    /// When the local original was asked.
    pub(crate) local_asked: Option<Instant>,
    /// The cloud's time, once it has answered.
    pub(crate) cloud_time: Option<Duration>,
    /// The time of the first answer.
    pub(crate) answer_time: Option<Duration>,
}

impl<P> Record<P> {
    pub(crate) fn leg(&mut self, side: Side) -> &mut Leg {
        match side {
            Side::Cloud => &mut self.cloud,
            Side::Local => &mut self.local,
        }
    }

    pub(crate) fn answered(&self) -> Option<Side> {
        self.owners[0]
    }

    /// Neither answered nor failed.
    pub(crate) fn is_open(&self) -> bool {
        self.answered().is_none() && !self.failed
    }

    pub(crate) fn is_call(&self) -> bool {
        matches!(self.kind, Kind::Call(_) | Kind::Goal(_))
    }

    fn awaits_nobody(&self) -> bool {
        [&self.cloud, &self.local]
            .iter()
            .all(|leg| matches!(leg, Leg::NotAsked | Leg::Answered | Leg::Failed(_)))
    }
}

impl<P: Clone> Arbiter<P> {
    /// Knows no request yet.
    pub fn new(limits: Limits) -> Self {
        Self {
            limits,
            next: 0,
            requests: BTreeMap::new(),
            inputs: 0,
            timers: BTreeSet::new(),
            stragglers: VecDeque::new(),
        }
    }

    /// A service was called, or a goal was sent. Nobody is asked yet.
    pub fn call(
        &mut self,
        now: Instant,
        t_max: Duration,
        name: &Arc<str>,
        payload: P,
    ) -> RequestId {
        self.open(now, t_max, Kind::Call(name.clone()), payload)
    }

    pub(crate) fn open(
        &mut self,
        now: Instant,
        t_max: Duration,
        kind: Kind,
        payload: P,
    ) -> RequestId {
        let id = RequestId(self.next);
        self.next += 1;
        let outputs = match &kind {
            Kind::Call(_) | Kind::Goal(_) => 1,
            Kind::Input { outputs, .. } => *outputs,
        };
        let deadline = now + t_max;
        let record = Record {
            kind,
            payload: Some(payload),
            asked_at: now,
            deadline,
            // At T_max it is still in time.
            timer: deadline + Duration::from_nanos(1),
            cloud: Leg::NotAsked,
            local: Leg::NotAsked,
            owners: vec![None; outputs],
            failed: false,
            overdue: false,
            judged: false,
            local_asked: None,
            cloud_time: None,
            answer_time: None,
        };
        self.inputs += usize::from(!record.is_call());
        self.timers.insert((record.timer, id));
        self.requests.insert(id, record);
        id
    }

    /// Marks `side` as asked and gives what to ask, unless it was asked already or the request needs nobody.
    pub fn ask(&mut self, now: Instant, id: RequestId, side: Side) -> Option<P> {
        let record = self.requests.get_mut(&id)?;
        if !record.is_open() || !matches!(record.leg(side), Leg::NotAsked) {
            return None;
        }
        let payload = record.payload.clone()?;
        *record.leg(side) = Leg::Asked;
        if side == Side::Local {
            record.local_asked = Some(now);
        }
        Some(payload)
    }

    /// `side` gave the result of a call, or the answering output of an input.
    pub fn answer(&mut self, now: Instant, id: RequestId, side: Side) -> Verdict {
        let verdict = self.answer_with(now, id, side, 0);
        self.close_call(id);
        verdict
    }

    /// `side` gave output number `output`. The side that is first with it keeps it: a node that answers one input
    /// with several messages on a topic is passed as it is. A call is remembered until it is closed.
    pub(crate) fn answer_with(
        &mut self,
        now: Instant,
        id: RequestId,
        side: Side,
        output: usize,
    ) -> Verdict {
        // The pair may have got further outputs since the request was made.
        let known = |record: &&mut Record<P>| output < record.owners.len();
        let Some(record) = self.requests.get_mut(&id).filter(known) else {
            return Verdict::Drop;
        };
        let took = now.saturating_duration_since(record.asked_at);
        if output == 0 {
            *record.leg(side) = Leg::Answered;
            if side == Side::Cloud {
                record.cloud_time.get_or_insert(took);
            }
        }
        let call = record.is_call();
        let failed = record.failed;
        let owner = &mut record.owners[output];
        let verdict = match *owner {
            _ if failed => Verdict::Drop,
            None => Verdict::Deliver,
            Some(first) if first == side && !call => Verdict::Deliver,
            Some(_) => Verdict::Drop,
        };
        if verdict == Verdict::Deliver {
            *owner = Some(side);
        }
        if record.answered().is_some() {
            record.payload = None;
            record.answer_time.get_or_insert(took);
        }
        verdict
    }

    /// `side` cannot answer. Whether that fails the request is for the caller to say, who knows what else may come.
    pub fn failed(&mut self, id: RequestId, side: Side, reason: &str) {
        if let Some(record) = self.requests.get_mut(&id) {
            if *record.leg(side) != Leg::Answered {
                *record.leg(side) = Leg::Failed(reason.to_owned());
            }
        }
        self.close_call(id);
    }

    /// Gives the request up. True for the first time, and only where it was not answered.
    pub fn fail(&mut self, id: RequestId) -> bool {
        let Some(record) = self.requests.get_mut(&id).filter(|record| record.is_open()) else {
            return false;
        };
        record.failed = true;
        record.payload = None;
        self.close_call(id);
        true
    }

    /// Nobody wants the answer any more; what comes is dropped.
    pub fn cancel(&mut self, id: RequestId) {
        self.remove(id);
    }

    fn remove(&mut self, id: RequestId) -> Option<Record<P>> {
        let record = self.requests.remove(&id)?;
        self.timers.remove(&(record.timer, id));
        self.inputs -= usize::from(!record.is_call());
        Some(record)
    }

    /// A call is over when everybody who was asked has spoken; inputs stay until their patience ends, because
    /// further outputs may come. One that the cloud could not be asked counts at T_max and stays until then.
    pub(crate) fn close_call(&mut self, id: RequestId) {
        let counts = |record: &Record<P>| record.judged || record.cloud != Leg::NotAsked;
        let over = |record: &Record<P>| {
            record.is_call() && !record.is_open() && record.awaits_nobody() && counts(record)
        };
        if self.requests.get(&id).is_some_and(over) {
            self.remove(id);
        }
    }

    /// Notes that the cloud's time counts now. True for the first time only.
    pub(crate) fn judge(&mut self, id: RequestId, time: Option<Duration>) -> bool {
        self.requests.get_mut(&id).is_some_and(|record| {
            record.cloud_time = record.cloud_time.or(time);
            !std::mem::replace(&mut record.judged, true)
        })
    }

    pub(crate) fn get(&self, id: RequestId) -> Option<&Record<P>> {
        self.requests.get(&id)
    }

    /// Requests in the order asked.
    pub(crate) fn select(&self, wanted: impl Fn(&Record<P>) -> bool) -> Vec<RequestId> {
        let wanted = self.requests.iter().filter(|(_, record)| wanted(record));
        wanted.map(|(id, _)| *id).collect()
    }

    /// Changes the legs of `side` that are `from`, and names their requests.
    pub(crate) fn turn(&mut self, side: Side, from: &Leg, to: &Leg) -> Vec<RequestId> {
        let mut turned = Vec::new();
        for (id, record) in &mut self.requests {
            if record.leg(side) == from {
                *record.leg(side) = to.clone();
                turned.push(*id);
            }
        }
        for id in &turned {
            self.close_call(*id);
        }
        turned
    }

    /// The oldest input that nobody answered by T_max and that the local original was not asked for.
    pub(crate) fn straggler(&mut self) -> Option<RequestId> {
        while let Some(id) = self.stragglers.front().copied() {
            let waits = |record: &Record<P>| {
                record.is_open() && record.payload.is_some() && record.local == Leg::NotAsked
            };
            if self.requests.get(&id).is_some_and(waits) {
                return Some(id);
            }
            self.stragglers.pop_front();
        }
        None
    }

    /// When [`expire`](Self::expire) has something to say.
    pub fn deadline(&self) -> Option<Instant> {
        self.timers.first().map(|(at, _)| *at)
    }

    /// More inputs are remembered than may be.
    pub(crate) fn is_crowded(&self) -> bool {
        self.inputs > self.limits.requests
    }

    /// Requests whose T_max has passed since the last call, and those that are forgotten now.
    pub(crate) fn expire(&mut self, now: Instant) -> (Vec<RequestId>, Vec<(RequestId, Record<P>)>) {
        let (mut overdue, mut forgotten) = (Vec::new(), Vec::new());
        while let Some((at, id)) = self.timers.first().copied().filter(|(at, _)| *at <= now) {
            let Some(record) = self.requests.get_mut(&id) else {
                self.timers.pop_first();
                continue;
            };
            if !record.overdue {
                record.overdue = true;
                if !record.is_call() && record.payload.is_some() {
                    self.stragglers.push_back(id);
                }
                record.timer = at + self.limits.patience;
            } else if record.is_call() && record.is_open() {
                // Somebody waits for it, as long as it takes. Whether it can come at all is looked at again later.
                record.timer = now + self.limits.patience;
            } else {
                forgotten.extend(self.remove(id).map(|record| (id, record)));
                continue;
            }
            overdue.push(id);
            self.timers.pop_first();
            self.timers.insert((record.timer, id));
        }
        while self.stragglers.len() > STRAGGLERS {
            let oldest = self.stragglers.pop_front();
            if let Some(record) = oldest.and_then(|id| self.requests.get_mut(&id)) {
                record.payload = None;
            }
        }
        if self.is_crowded() {
            let crowd = self.inputs - self.limits.requests;
            let inputs = self.requests.iter().filter(|(_, record)| !record.is_call());
            let oldest: Vec<RequestId> = inputs.map(|(id, _)| *id).take(crowd).collect();
            for id in oldest {
                forgotten.extend(self.remove(id).map(|record| (id, record)));
            }
        }
        (overdue, forgotten)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arbiter() -> (Arbiter<u8>, Arc<str>, Instant) {
        (
            Arbiter::new(Limits::default()),
            "/add".into(),
            Instant::now(),
        )
    }

    const MAX: Duration = Duration::from_millis(100);

    #[test]
    fn the_first_result_wins_and_the_second_is_dropped() {
        let (mut arbiter, name, now) = arbiter();
        let id = arbiter.call(now, MAX, &name, 7);
        assert_eq!(arbiter.ask(now, id, Side::Cloud), Some(7));
        assert_eq!(arbiter.ask(now, id, Side::Cloud), None, "asked once");
        assert_eq!(arbiter.ask(now, id, Side::Local), Some(7));
        assert_eq!(arbiter.answer(now, id, Side::Local), Verdict::Deliver);
        assert_eq!(arbiter.answer(now, id, Side::Local), Verdict::Drop);
        assert_eq!(arbiter.answer(now, id, Side::Cloud), Verdict::Drop);
        assert!(arbiter.get(id).is_none(), "both have spoken: it is over");
        assert_eq!(arbiter.answer(now, id, Side::Cloud), Verdict::Drop);
    }

    #[test]
    fn an_answer_after_the_failure_is_dropped() {
        let (mut arbiter, name, now) = arbiter();
        let id = arbiter.call(now, MAX, &name, 7);
        arbiter.ask(now, id, Side::Cloud);
        assert!(arbiter.fail(id));
        assert!(!arbiter.fail(id));
        assert_eq!(arbiter.answer(now, id, Side::Cloud), Verdict::Drop);
        assert!(arbiter.requests.is_empty());
    }

    #[test]
    fn one_input_may_have_several_messages_of_one_side() {
        let (mut arbiter, _, now) = arbiter();
        let kind = Kind::Input {
            pair: 0,
            key: None,
            outputs: 2,
        };
        let id = arbiter.open(now, MAX, kind, 7);
        arbiter.ask(now, id, Side::Cloud);
        arbiter.ask(now, id, Side::Local);
        assert_eq!(
            arbiter.answer_with(now, id, Side::Local, 1),
            Verdict::Deliver
        );
        assert_eq!(arbiter.answer_with(now, id, Side::Cloud, 1), Verdict::Drop);
        assert_eq!(
            arbiter.answer_with(now, id, Side::Cloud, 0),
            Verdict::Deliver
        );
        assert_eq!(
            arbiter.answer_with(now, id, Side::Cloud, 0),
            Verdict::Deliver
        );
        assert_eq!(arbiter.answer_with(now, id, Side::Local, 0), Verdict::Drop);
    }

    #[test]
    fn memory_is_bounded_and_waiting_callers_are_not_forgotten() {
        let (_, name, now) = arbiter();
        let limits = Limits {
            patience: Duration::from_secs(1),
            requests: 10,
        };
        let mut arbiter = Arbiter::new(limits);
        let call = arbiter.call(now, MAX, &name, 7);
        for _ in 0..1000 {
            let kind = Kind::Input {
                pair: 0,
                key: None,
                outputs: 1,
            };
            arbiter.open(now, MAX, kind, 7);
            arbiter.expire(now);
            assert!(arbiter.inputs <= 10, "{}", arbiter.inputs);
            assert_eq!(arbiter.requests.len(), arbiter.inputs + 1);
            assert_eq!(arbiter.timers.len(), arbiter.requests.len());
        }
        let (overdue, _) = arbiter.expire(now + MAX);
        assert!(overdue.is_empty(), "at T_max it is still in time");
        let (overdue, _) = arbiter.expire(now + MAX * 2);
        assert!(overdue.contains(&call));
        let (_, forgotten) = arbiter.expire(now + Duration::from_secs(60));
        assert!(forgotten.iter().all(|(id, _)| *id != call));
        assert_eq!(arbiter.requests.len(), 1);
    }
}
