//! For each request: who was asked, who answered first, what is a late duplicate.

mod record;

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::channel::Channel;
use crate::request::{Key, Leg, RequestId, Side};

pub(crate) use record::{Kind, Record};

/// What is kept, and for how long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// After its T_max a request is remembered for so long: late answers are recognised, and an input that nobody
    /// answered is given up.
    pub patience: Duration,
    /// Requests remembered; beyond it the oldest that came on topics are forgotten. Those that hold a caller are not counted.
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

/// At T_max an answer is still in time.
const PAST: Duration = Duration::from_nanos(1);

/// The requests of one node that are open or were until lately. `P` is what was asked, cheap to clone.
#[derive(Debug)]
pub(crate) struct Arbiter<P> {
    limits: Limits,
    next: u64,
    requests: BTreeMap<RequestId, Record<P>>,
    /// Those whose answers are recognised by a key, by the name of their channel.
    keyed: HashMap<(Arc<str>, Key), RequestId>,
    /// How many of them hold no caller.
    inputs: usize,
    /// One for each of them ([`Record::timer`]): its T_max, or the end of its patience.
    timers: BTreeSet<(Instant, RequestId)>,
    /// Inputs that nobody answered by T_max, the oldest first.
    stragglers: VecDeque<RequestId>,
}

impl<P: Clone> Arbiter<P> {
    /// Knows no request yet.
    pub(crate) fn new(limits: Limits) -> Self {
        Self {
            limits,
            next: 0,
            requests: BTreeMap::new(),
            keyed: HashMap::new(),
            inputs: 0,
            timers: BTreeSet::new(),
            stragglers: VecDeque::new(),
        }
    }

    /// Something is to be asked, and nobody is asked yet. Answers are recognised by `key`, where they have one.
    pub(crate) fn open(
        &mut self,
        (now, t_max): (Instant, Duration),
        kind: Kind,
        channel: Channel,
        key: Option<Key>,
        payload: P,
    ) -> RequestId {
        let id = RequestId(self.next);
        self.next += 1;
        let deadline = now + t_max;
        let key = key.map(|key| (channel.name().clone(), key));
        if let Some(key) = &key {
            self.keyed.insert(key.clone(), id);
        }
        let record = Record {
            kind,
            channel,
            key,
            payload: Some(payload),
            asked_at: now,
            deadline,
            timer: deadline + PAST,
            cloud: Leg::NotAsked,
            local: Leg::NotAsked,
            owners: vec![None],
            failed: false,
            overdue: false,
            missed: false,
            taken: false,
            judged: false,
            local_asked: None,
            cloud_time: None,
            answer_time: None,
        };
        self.inputs += usize::from(!record.has_caller());
        self.timers.insert((record.timer, id));
        self.requests.insert(id, record);
        id
    }

    /// The request on the channel of this name whose answers are recognised by `key`.
    pub(crate) fn keyed(&self, name: &Arc<str>, key: &Key) -> Option<RequestId> {
        self.keyed.get(&(name.clone(), key.clone())).copied()
    }

    /// Marks `side` as asked and gives what to ask, unless it was asked already or the request needs nobody.
    pub(crate) fn ask(&mut self, now: Instant, id: RequestId, side: Side) -> Option<P> {
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

    /// `side` gave output number `output`. The side that is first with it keeps it: a node that answers one input
    /// with several messages on a topic is passed as it is. A call is remembered until it is closed.
    pub(crate) fn answer_with(
        &mut self,
        now: Instant,
        id: RequestId,
        side: Side,
        output: usize,
    ) -> Verdict {
        let Some(record) = self.requests.get_mut(&id) else {
            return Verdict::Drop;
        };
        let took = now.saturating_duration_since(record.asked_at);
        if output == 0 {
            *record.leg(side) = Leg::Answered;
            if side == Side::Cloud {
                record.cloud_time.get_or_insert(took);
            }
        }
        // Feedback of a goal is as many messages as its side likes.
        let is_single = record.is_call() && output == 0;
        let failed = record.failed;
        // The pair may have got further outputs since the request was made.
        let outputs = record.owners.len().max(output + 1);
        record.owners.resize(outputs, None);
        let owner = &mut record.owners[output];
        let verdict = match *owner {
            _ if failed => Verdict::Drop,
            None => Verdict::Deliver,
            Some(first) if first == side && !is_single => Verdict::Deliver,
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
    pub(crate) fn failed(&mut self, id: RequestId, side: Side, reason: &str) {
        if let Some(record) = self.requests.get_mut(&id) {
            if *record.leg(side) != Leg::Answered {
                *record.leg(side) = Leg::Failed(reason.to_owned());
            }
        }
        self.close_call(id);
    }

    /// Gives the request up. True for the first time, and only where it was not answered.
    pub(crate) fn fail(&mut self, id: RequestId) -> bool {
        let Some(record) = self.requests.get_mut(&id).filter(|record| record.is_open()) else {
            return false;
        };
        record.failed = true;
        record.payload = None;
        self.close_call(id);
        true
    }

    /// Nobody wants the answer any more; what comes is dropped.
    pub(crate) fn cancel(&mut self, id: RequestId) {
        self.remove(id);
    }

    fn remove(&mut self, id: RequestId) -> Option<Record<P>> {
        let record = self.requests.remove(&id)?;
        self.timers.remove(&(record.timer, id));
        self.inputs -= usize::from(!record.has_caller());
        // The key may be another's by now: a goal that is sent again, once it has ended.
        let key = record.key.as_ref();
        if let Some(key) = key.filter(|key| self.keyed.get(key) == Some(&id)) {
            self.keyed.remove(key);
        }
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

    pub(crate) fn get_mut(&mut self, id: RequestId) -> Option<&mut Record<P>> {
        self.requests.get_mut(&id)
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
                let is_free = record.local == Leg::NotAsked && record.cloud != Leg::LeftOut;
                record.is_open() && record.payload.is_some() && is_free
            };
            if self.requests.get(&id).is_some_and(waits) {
                return Some(id);
            }
            self.stragglers.pop_front();
        }
        None
    }

    /// When [`expire`](Self::expire) has something to say.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.timers.first().map(|(at, _)| *at)
    }

    /// More inputs are remembered than may be.
    pub(crate) fn is_crowded(&self) -> bool {
        self.inputs > self.limits.requests
    }

    /// Requests whose T_max has passed since the last call, with those whose callers wait still, and those that are forgotten now.
    /// `put_off` gives until when one may turn out to have been left out.
    pub(crate) fn expire(
        &mut self,
        now: Instant,
        put_off: impl Fn(RequestId, &Record<P>) -> Option<Instant>,
    ) -> (Vec<RequestId>, Vec<(RequestId, Record<P>)>) {
        let (mut overdue, mut forgotten) = (Vec::new(), Vec::new());
        while let Some((at, id)) = self.timers.first().copied().filter(|(at, _)| *at <= now) {
            self.timers.pop_first();
            let Some(record) = self.requests.get_mut(&id) else {
                continue;
            };
            let until = put_off(id, record).map(|until| until + PAST);
            if let Some(until) = until.filter(|until| !record.overdue && *until > now) {
                record.timer = until;
            } else if !record.overdue {
                record.overdue = true;
                if !record.is_call() && record.payload.is_some() {
                    self.stragglers.push_back(id);
                }
                record.timer = at + self.limits.patience;
                overdue.push(id);
            } else if record.is_call() && record.is_open() {
                // Somebody waits for it, as long as it takes. Whether it can come at all is looked at again later.
                record.timer = now + self.limits.patience;
                overdue.push(id);
            } else {
                forgotten.extend(self.remove(id).map(|record| (id, record)));
                continue;
            }
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
            let inputs = self
                .requests
                .iter()
                .filter(|(_, record)| !record.has_caller());
            // Goals take as long as they take: they go last.
            let (inputs, goals): (Vec<_>, Vec<_>) =
                inputs.partition(|(_, record)| matches!(record.kind, Kind::Input(_)));
            let oldest = inputs.iter().chain(&goals).map(|(id, _)| **id).take(crowd);
            let oldest: Vec<RequestId> = oldest.collect();
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

    fn arbiter() -> (Arbiter<u8>, Instant) {
        (Arbiter::new(Limits::default()), Instant::now())
    }

    fn call(arbiter: &mut Arbiter<u8>, now: Instant) -> RequestId {
        let channel = Channel::Call("/add".into());
        arbiter.open((now, MAX), Kind::Call, channel, None, 7)
    }

    fn input(arbiter: &mut Arbiter<u8>, now: Instant) -> RequestId {
        let channel = Channel::Topic("/in".into());
        arbiter.open((now, MAX), Kind::Input(0), channel, None, 7)
    }

    fn answer(arbiter: &mut Arbiter<u8>, now: Instant, id: RequestId, side: Side) -> Verdict {
        let verdict = arbiter.answer_with(now, id, side, 0);
        arbiter.close_call(id);
        verdict
    }

    const MAX: Duration = Duration::from_millis(100);

    #[test]
    fn the_first_result_wins_and_the_second_is_dropped() {
        let (mut arbiter, now) = arbiter();
        let id = call(&mut arbiter, now);
        assert_eq!(arbiter.ask(now, id, Side::Cloud), Some(7));
        assert_eq!(arbiter.ask(now, id, Side::Cloud), None, "asked once");
        assert_eq!(arbiter.ask(now, id, Side::Local), Some(7));
        assert_eq!(answer(&mut arbiter, now, id, Side::Local), Verdict::Deliver);
        assert_eq!(answer(&mut arbiter, now, id, Side::Local), Verdict::Drop);
        assert_eq!(answer(&mut arbiter, now, id, Side::Cloud), Verdict::Drop);
        assert!(arbiter.get(id).is_none(), "both have spoken: it is over");
        assert_eq!(answer(&mut arbiter, now, id, Side::Cloud), Verdict::Drop);
    }

    #[test]
    fn an_answer_after_the_failure_is_dropped() {
        let (mut arbiter, now) = arbiter();
        let id = call(&mut arbiter, now);
        arbiter.ask(now, id, Side::Cloud);
        assert!(arbiter.fail(id));
        assert!(!arbiter.fail(id));
        assert_eq!(answer(&mut arbiter, now, id, Side::Cloud), Verdict::Drop);
        assert!(arbiter.requests.is_empty());
    }

    #[test]
    fn one_input_may_have_several_messages_of_one_side() {
        let (mut arbiter, now) = arbiter();
        let id = input(&mut arbiter, now);
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
        let now = Instant::now();
        let limits = Limits {
            patience: Duration::from_secs(1),
            requests: 10,
        };
        let mut arbiter = Arbiter::new(limits);
        let call = call(&mut arbiter, now);
        for _ in 0..1000 {
            input(&mut arbiter, now);
            arbiter.expire(now, |_, _| None);
            assert!(arbiter.inputs <= 10, "{}", arbiter.inputs);
            assert_eq!(arbiter.requests.len(), arbiter.inputs + 1);
            assert_eq!(arbiter.timers.len(), arbiter.requests.len());
        }
        let (overdue, _) = arbiter.expire(now + MAX, |_, _| None);
        assert!(overdue.is_empty(), "at T_max it is still in time");
        let (overdue, _) = arbiter.expire(now + MAX * 2, |_, _| None);
        assert!(overdue.contains(&call));
        let (_, forgotten) = arbiter.expire(now + Duration::from_secs(60), |_, _| None);
        assert!(forgotten.iter().all(|(id, _)| *id != call));
        assert_eq!(arbiter.requests.len(), 1);
    }
}
