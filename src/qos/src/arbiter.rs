//! Tracks each request: which sides were asked, which answered first, and which answers are late duplicates.

mod record;

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::channel::RequestChannel;
use crate::request::{CorrelationKey, RequestId, RequestLeg, Responder};

pub(crate) use record::{Kind, Record};

/// Bounds on the requests that are remembered, and for how long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RetentionLimits {
    /// Time for which a request is remembered after its T_max: until then late answers are recognised, and an input
    /// that nobody answered is still open.
    pub patience: Duration,
    /// Maximum number of remembered requests; beyond it the oldest that came on topics are dropped. Requests with a
    /// waiting caller do not count.
    pub requests: usize,
}

impl Default for RetentionLimits {
    fn default() -> Self {
        Self { patience: Duration::from_secs(30), requests: 4096 }
    }
}

/// Number of inputs kept beyond their T_max, for a local original that has time for them.
const STRAGGLERS: usize = 8;

/// Decision whether an answer is delivered to the application.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeliveryVerdict {
    /// Deliver it to the application.
    Deliver,
    /// Drop it: the request is unknown, has failed, or was answered already.
    Drop,
}

/// Smallest time after T_max: an answer that arrives exactly at T_max is still in time.
const PAST: Duration = Duration::from_nanos(1);

/// Requests whose timers have expired.
#[derive(Debug)]
pub(crate) struct Expired<P> {
    /// Requests that may be hedged now ([`Arbiter::schedule_hedge`]); their T_max is still to come.
    pub(crate) hedges: Vec<RequestId>,
    /// Requests whose T_max has passed since the last call, and those whose callers still wait.
    pub(crate) overdue: Vec<RequestId>,
    /// Requests that are forgotten now.
    pub(crate) forgotten: Vec<(RequestId, Record<P>)>,
}

/// The open and recent requests of one node. `P` is the request's payload, cheap to clone.
#[derive(Debug)]
pub(crate) struct Arbiter<P> {
    limits: RetentionLimits,
    next: u64,
    requests: BTreeMap<RequestId, Record<P>>,
    /// Requests whose answers carry a key, by channel name and key.
    keyed: HashMap<(Arc<str>, CorrelationKey), RequestId>,
    /// Number of requests without a waiting caller.
    inputs: usize,
    /// One timer per request ([`Record::timer`]): its hedge, its T_max, or the end of its patience.
    timers: BTreeSet<(Instant, RequestId)>,
    /// Inputs that were not answered by T_max, oldest first.
    stragglers: VecDeque<RequestId>,
}

impl<P: Clone> Arbiter<P> {
    /// Creates an arbiter without requests.
    pub(crate) fn new(limits: RetentionLimits) -> Self {
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

    /// Opens a request that no side has been asked yet. Its answers are matched by `key`, if it has one.
    pub(crate) fn open(
        &mut self,
        (now, t_max): (Instant, Duration),
        kind: Kind,
        channel: RequestChannel,
        key: Option<CorrelationKey>,
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
            cloud: RequestLeg::NotAsked,
            local: RequestLeg::NotAsked,
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

    /// Lets [`expire`](Self::expire) return the request at `at`, before its T_max.
    pub(crate) fn schedule_hedge(&mut self, id: RequestId, at: Instant) {
        if let Some(record) = self.requests.get_mut(&id) {
            self.timers.remove(&(record.timer, id));
            record.timer = at;
            self.timers.insert((at, id));
        }
    }

    /// Returns the request on the channel `name` whose answers carry `key`.
    pub(crate) fn find_by_key(&self, name: &Arc<str>, key: &CorrelationKey) -> Option<RequestId> {
        self.keyed.get(&(name.clone(), key.clone())).copied()
    }

    /// Marks `side` as asked and returns the payload to send, unless that side was asked already or the request is
    /// closed.
    pub(crate) fn ask(&mut self, now: Instant, id: RequestId, side: Responder) -> Option<P> {
        let record = self.requests.get_mut(&id)?;
        if !record.is_open() || !matches!(record.leg(side), RequestLeg::NotAsked) {
            return None;
        }
        let payload = record.payload.clone()?;
        *record.leg(side) = RequestLeg::Asked;
        if side == Responder::Local {
            record.local_asked = Some(now);
        }
        Some(payload)
    }

    /// Records output number `output` of `side`. The side that delivers an output first owns it: a node that answers
    /// one input with several messages on a topic is passed through unchanged. A call is remembered until it is closed.
    pub(crate) fn answer_with(
        &mut self,
        now: Instant,
        id: RequestId,
        side: Responder,
        output: usize,
    ) -> DeliveryVerdict {
        let Some(record) = self.requests.get_mut(&id) else {
            return DeliveryVerdict::Drop;
        };
        let took = now.saturating_duration_since(record.asked_at);
        if output == 0 {
            *record.leg(side) = RequestLeg::Answered;
            if side == Responder::Cloud {
                record.cloud_time.get_or_insert(took);
            }
        }
        // A side may send any number of feedback messages for a goal.
        let is_single = record.is_call() && output == 0;
        let failed = record.failed;
        // The pair may have gained outputs since the request was opened.
        let outputs = record.owners.len().max(output + 1);
        record.owners.resize(outputs, None);
        let owner = &mut record.owners[output];
        let verdict = match *owner {
            _ if failed => DeliveryVerdict::Drop,
            None => DeliveryVerdict::Deliver,
            Some(first) if first == side && !is_single => DeliveryVerdict::Deliver,
            Some(_) => DeliveryVerdict::Drop,
        };
        if verdict == DeliveryVerdict::Deliver {
            *owner = Some(side);
        }
        if record.answered_by().is_some() {
            record.payload = None;
            record.answer_time.get_or_insert(took);
        }
        verdict
    }

    /// Records that `side` cannot answer. The caller decides whether the request fails, since it knows what else may
    /// come.
    pub(crate) fn mark_failed(&mut self, id: RequestId, side: Responder, reason: &str) {
        if let Some(record) = self.requests.get_mut(&id) {
            if *record.leg(side) != RequestLeg::Answered {
                *record.leg(side) = RequestLeg::Failed(reason.to_owned());
            }
        }
        self.close_call(id);
    }

    /// Fails the request. Returns true the first time, and only if the request was not answered.
    pub(crate) fn fail(&mut self, id: RequestId) -> bool {
        let Some(record) = self.requests.get_mut(&id).filter(|record| record.is_open()) else {
            return false;
        };
        record.failed = true;
        record.payload = None;
        self.close_call(id);
        true
    }

    /// Drops the request: later answers are ignored.
    pub(crate) fn cancel(&mut self, id: RequestId) {
        self.remove(id);
    }

    fn remove(&mut self, id: RequestId) -> Option<Record<P>> {
        let record = self.requests.remove(&id)?;
        self.timers.remove(&(record.timer, id));
        self.inputs -= usize::from(!record.has_caller());
        // The key may belong to another request by now, such as a goal that was sent again after it ended.
        let key = record.key.as_ref();
        if let Some(key) = key.filter(|key| self.keyed.get(key) == Some(&id)) {
            self.keyed.remove(key);
        }
        Some(record)
    }

    /// Forgets a call once every side that was asked has answered or failed; inputs stay until their patience ends,
    /// because further outputs may come. A call that the cloud could not be asked counts at T_max and stays until then.
    pub(crate) fn close_call(&mut self, id: RequestId) {
        let counts = |record: &Record<P>| record.judged || record.cloud != RequestLeg::NotAsked;
        let over =
            |record: &Record<P>| record.is_call() && !record.is_open() && record.awaits_nobody() && counts(record);
        if self.requests.get(&id).is_some_and(over) {
            self.remove(id);
        }
    }

    /// Counts the cloud's time of the request. Returns true the first time only.
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

    /// Returns the ids of the requests that match `wanted`, in the order in which they were opened.
    pub(crate) fn select(&self, wanted: impl Fn(&Record<P>) -> bool) -> Vec<RequestId> {
        let wanted = self.requests.iter().filter(|(_, record)| wanted(record));
        wanted.map(|(id, _)| *id).collect()
    }

    /// Changes the legs of `side` that equal `from` to `to`, and returns their requests.
    pub(crate) fn replace_legs(&mut self, side: Responder, from: &RequestLeg, to: &RequestLeg) -> Vec<RequestId> {
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

    /// Returns the oldest input that was not answered by T_max and that the local original was not asked for.
    pub(crate) fn next_straggler(&mut self) -> Option<RequestId> {
        while let Some(id) = self.stragglers.front().copied() {
            let waits = |record: &Record<P>| {
                let is_free = record.local == RequestLeg::NotAsked && record.cloud != RequestLeg::LeftOut;
                record.is_open() && record.payload.is_some() && is_free
            };
            if self.requests.get(&id).is_some_and(waits) {
                return Some(id);
            }
            self.stragglers.pop_front();
        }
        None
    }

    /// Returns the time at which [`expire`](Self::expire) has work to do.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.timers.first().map(|(at, _)| *at)
    }

    /// Returns true if more inputs are remembered than the limit allows.
    pub(crate) fn is_crowded(&self) -> bool {
        self.inputs > self.limits.requests
    }

    /// Returns the requests whose timers have expired. `put_off` returns the time until which a request may still turn
    /// out to have been left out.
    pub(crate) fn expire(
        &mut self,
        now: Instant,
        put_off: impl Fn(RequestId, &Record<P>) -> Option<Instant>,
    ) -> Expired<P> {
        let (mut hedges, mut overdue, mut forgotten) = (Vec::new(), Vec::new(), Vec::new());
        while let Some((at, id)) = self.timers.first().copied().filter(|(at, _)| *at <= now) {
            self.timers.pop_first();
            let Some(record) = self.requests.get_mut(&id) else {
                continue;
            };
            let until = put_off(id, record).map(|until| until + PAST);
            if !record.overdue && now <= record.deadline {
                record.timer = record.deadline + PAST;
                hedges.push(id);
            } else if let Some(until) = until.filter(|until| !record.overdue && *until > now) {
                record.timer = until;
            } else if !record.overdue {
                record.overdue = true;
                if !record.is_call() && record.payload.is_some() {
                    self.stragglers.push_back(id);
                }
                record.timer = at + self.limits.patience;
                overdue.push(id);
            } else if record.is_call() && record.is_open() {
                // A caller waits for it without a time limit. Whether an answer can come at all is checked again later.
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
            let inputs = self.requests.iter().filter(|(_, record)| !record.has_caller());
            // Goals may take arbitrarily long, so they are dropped last.
            let (inputs, goals): (Vec<_>, Vec<_>) =
                inputs.partition(|(_, record)| matches!(record.kind, Kind::Input(_)));
            let oldest = inputs.iter().chain(&goals).map(|(id, _)| **id).take(crowd);
            let oldest: Vec<RequestId> = oldest.collect();
            for id in oldest {
                forgotten.extend(self.remove(id).map(|record| (id, record)));
            }
        }
        Expired { hedges, overdue, forgotten }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arbiter() -> (Arbiter<u8>, Instant) {
        (Arbiter::new(RetentionLimits::default()), Instant::now())
    }

    fn call(arbiter: &mut Arbiter<u8>, now: Instant) -> RequestId {
        let channel = RequestChannel::Call("/add".into());
        arbiter.open((now, MAX), Kind::Call, channel, None, 7)
    }

    fn input(arbiter: &mut Arbiter<u8>, now: Instant) -> RequestId {
        let channel = RequestChannel::Topic("/in".into());
        arbiter.open((now, MAX), Kind::Input(0), channel, None, 7)
    }

    fn answer(arbiter: &mut Arbiter<u8>, now: Instant, id: RequestId, side: Responder) -> DeliveryVerdict {
        let verdict = arbiter.answer_with(now, id, side, 0);
        arbiter.close_call(id);
        verdict
    }

    const MAX: Duration = Duration::from_millis(100);

    #[test]
    fn the_first_result_wins_and_the_second_is_dropped() {
        let (mut arbiter, now) = arbiter();
        let id = call(&mut arbiter, now);
        assert_eq!(arbiter.ask(now, id, Responder::Cloud), Some(7));
        assert_eq!(arbiter.ask(now, id, Responder::Cloud), None, "asked once");
        assert_eq!(arbiter.ask(now, id, Responder::Local), Some(7));
        assert_eq!(answer(&mut arbiter, now, id, Responder::Local), DeliveryVerdict::Deliver);
        assert_eq!(answer(&mut arbiter, now, id, Responder::Local), DeliveryVerdict::Drop);
        assert_eq!(answer(&mut arbiter, now, id, Responder::Cloud), DeliveryVerdict::Drop);
        assert!(arbiter.get(id).is_none(), "both have spoken: it is over");
        assert_eq!(answer(&mut arbiter, now, id, Responder::Cloud), DeliveryVerdict::Drop);
    }

    #[test]
    fn an_answer_after_the_failure_is_dropped() {
        let (mut arbiter, now) = arbiter();
        let id = call(&mut arbiter, now);
        arbiter.ask(now, id, Responder::Cloud);
        assert!(arbiter.fail(id));
        assert!(!arbiter.fail(id));
        assert_eq!(answer(&mut arbiter, now, id, Responder::Cloud), DeliveryVerdict::Drop);
        assert!(arbiter.requests.is_empty());
    }

    #[test]
    fn one_input_may_have_several_messages_of_one_side() {
        let (mut arbiter, now) = arbiter();
        let id = input(&mut arbiter, now);
        arbiter.ask(now, id, Responder::Cloud);
        arbiter.ask(now, id, Responder::Local);
        assert_eq!(arbiter.answer_with(now, id, Responder::Local, 1), DeliveryVerdict::Deliver);
        assert_eq!(arbiter.answer_with(now, id, Responder::Cloud, 1), DeliveryVerdict::Drop);
        assert_eq!(arbiter.answer_with(now, id, Responder::Cloud, 0), DeliveryVerdict::Deliver);
        assert_eq!(arbiter.answer_with(now, id, Responder::Cloud, 0), DeliveryVerdict::Deliver);
        assert_eq!(arbiter.answer_with(now, id, Responder::Local, 0), DeliveryVerdict::Drop);
    }

    #[test]
    fn memory_is_bounded_and_waiting_callers_are_not_forgotten() {
        let now = Instant::now();
        let limits = RetentionLimits { patience: Duration::from_secs(1), requests: 10 };
        let mut arbiter = Arbiter::new(limits);
        let call = call(&mut arbiter, now);
        for _ in 0..1000 {
            input(&mut arbiter, now);
            arbiter.expire(now, |_, _| None);
            assert!(arbiter.inputs <= 10, "{}", arbiter.inputs);
            assert_eq!(arbiter.requests.len(), arbiter.inputs + 1);
            assert_eq!(arbiter.timers.len(), arbiter.requests.len());
        }
        let expired = arbiter.expire(now + MAX, |_, _| None);
        assert!(expired.overdue.is_empty(), "at T_max it is still in time");
        let expired = arbiter.expire(now + MAX * 2, |_, _| None);
        assert!(expired.overdue.contains(&call));
        let expired = arbiter.expire(now + Duration::from_secs(60), |_, _| None);
        assert!(expired.forgotten.iter().all(|(id, _)| *id != call));
        assert_eq!(arbiter.requests.len(), 1);
    }
}
