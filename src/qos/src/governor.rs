//! Quality of service of one node of the package: combines all parts of this crate.

mod arrivals;
mod asking;
mod effect;
mod frames;
mod giving_up;
mod hedging;
mod judging;
mod original;
mod output_age;
mod queue;
mod standing;
mod stream;

use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::arbiter::{Arbiter, DeliveryVerdict, Expired, Kind, Record, RetentionLimits};
use crate::channel::RequestChannel;
use crate::decider::{Decider, LocalState, QosEvent};
use crate::measure::Meter;
use crate::pair::{Correlation, TopicPair};
use crate::phases::PhaseHistory;
use crate::report::RequestCounts;
use crate::request::{CorrelationKey, Failure, RequestId, RequestLeg, Responder, Responders};
use crate::satisfaction::Satisfaction;
use crate::sla::{Mode, QosSla};

pub use effect::Effect;
use frames::OutputMeters;
pub use output_age::OutputAge;
use stream::PairState;

/// Number of events kept for the report.
const EVENTS: usize = 32;
/// Number of stamped outputs without a matching input after which the node is assumed not to copy stamps.
const UNMATCHED: u32 = 8;

/// Quality of service of one node. `P` is a message, cheap to clone.
///
/// The driver calls a method for each thing that happens, then takes [`effects`](Self::next_effect) until there are
/// none left, and calls [`tick`](Self::tick) at [`deadline`](Self::deadline).
#[derive(Debug)]
pub struct Governor<P> {
    sla: QosSla,
    satisfaction: Satisfaction,
    decider: Decider,
    arbiter: Arbiter<P>,
    /// Meters of the cloud's outputs, if the SLA measures something else than the response time.
    meter: Option<OutputMeters>,
    pairs: Vec<PairState>,
    link: bool,
    /// The link has been up at least once.
    reached: bool,
    /// The link has been down for so long that the local original takes over whatever Q is.
    away: bool,
    /// Time at which the link will have been down for that long.
    away_at: Option<Instant>,
    counts: RequestCounts,
    phases: PhaseHistory,
    /// Response time of the local original's last answer.
    local_time: Option<Duration>,
    /// Outputs that have a subscriber.
    listened: BTreeSet<String>,
    events: VecDeque<(Instant, QosEvent)>,
    effects: VecDeque<Effect<P>>,
}

impl<P: Clone> Governor<P> {
    /// Creates a governor; the link is down and the local original not started. `pairs` are the pairs whose topics
    /// exist already.
    pub fn new(sla: QosSla, pairs: Vec<TopicPair>, limits: RetentionLimits) -> Self {
        let metered = |(output, meter): (&str, Meter)| OutputMeters {
            output: output.to_owned(),
            delivered: meter.clone(),
            cloud: meter,
        };
        Self {
            satisfaction: Satisfaction::new(sla.initial, sla.threshold, sla.cap),
            decider: Decider::new(&sla),
            arbiter: Arbiter::new(limits),
            meter: Meter::new(&sla).map(metered),
            pairs: pairs.into_iter().map(PairState::new).collect(),
            link: false,
            reached: false,
            away: sla.mode == Mode::Stateful && !sla.is_link_based(),
            away_at: None,
            counts: RequestCounts::default(),
            phases: PhaseHistory::default(),
            local_time: None,
            listened: BTreeSet::new(),
            events: VecDeque::new(),
            effects: VecDeque::new(),
            sla,
        }
    }

    /// Returns the next action to carry out.
    pub fn next_effect(&mut self) -> Option<Effect<P>> {
        self.effects.pop_front()
    }

    /// Returns the time at which [`tick`](Self::tick) has work to do.
    pub fn deadline(&self) -> Option<Instant> {
        let meters = self.meter.as_ref();
        let meters = meters.map(|meter| [meter.cloud.deadline(), meter.delivered.deadline()]);
        let others = meters.into_iter().flatten().flatten().chain(self.away_at);
        self.arbiter.deadline().into_iter().chain(others).min()
    }

    /// Returns the sides that receive messages now.
    pub fn sides(&self) -> Responders {
        Responders { cloud: self.link, local: self.decider.is_fed() }
    }

    /// Returns the current satisfaction.
    pub fn satisfaction(&self) -> &Satisfaction {
        &self.satisfaction
    }

    /// Starts operation once the node is up; a warm local original is started now.
    pub fn begin(&mut self, now: Instant) {
        if !self.link {
            self.on_link_lost(now);
        }
        self.decide(now);
    }

    /// Adds pairs whose topics exist now, or further outputs of known pairs.
    pub fn add_pairs(&mut self, now: Instant, pairs: Vec<TopicPair>) {
        if let Some(meter) = &mut self.meter {
            if let Some(first) = pairs.first().filter(|_| meter.output.is_empty()) {
                meter.output = first.outputs[0].clone();
            }
        }
        self.update_meters(now);
        for pair in pairs {
            match self.pairs.iter_mut().find(|stream| stream.pair.input == pair.input) {
                Some(stream) => stream.pair.outputs = pair.outputs,
                None => self.pairs.push(PairState::new(pair)),
            }
        }
    }

    /// Opens a request for a service call of the application.
    pub fn call(&mut self, now: Instant, name: &Arc<str>, payload: P) -> RequestId {
        self.open(now, Kind::Call, RequestChannel::Call(name.clone()), None, payload)
    }

    /// Opens a request for a goal of an action that is made of calls (ROS 2), with the goal's id. The action's result
    /// answers it.
    pub fn goal(&mut self, now: Instant, action: &Arc<str>, id: CorrelationKey, payload: P) -> RequestId {
        let channel = RequestChannel::Call(action.clone());
        self.open(now, Kind::Goal, channel, Some(id), payload)
    }

    /// Records that a side has accepted a goal: it is being carried out, however long that takes.
    pub fn on_goal_accepted(&mut self, now: Instant, id: RequestId) {
        self.tick(now);
        if let Some(record) = self.arbiter.get_mut(id) {
            record.taken = true;
        }
    }

    fn open(
        &mut self,
        now: Instant,
        kind: Kind,
        channel: RequestChannel,
        key: Option<CorrelationKey>,
        payload: P,
    ) -> RequestId {
        self.tick(now);
        let times = self.sla.times(channel.name());
        let id = self.arbiter.open((now, times.t_max), kind, channel, key, payload);
        if let Some(delay) = self.hedge_delay(kind, times) {
            self.arbiter.schedule_hedge(id, now + delay);
        }
        self.dispatch(now, id);
        id
    }

    /// Cancels a request: the application no longer waits for the answer.
    pub fn cancel(&mut self, now: Instant, id: RequestId) {
        self.tick(now);
        self.arbiter.cancel(id);
    }

    /// Handles an input published by the application; its answer carries `key`, if the input has one.
    pub fn input(&mut self, now: Instant, topic: &Arc<str>, key: Option<CorrelationKey>, payload: P) {
        self.tick(now);
        let mut pairs = self.pairs.iter();
        let Some(index) = pairs.position(|stream| *stream.input == **topic) else {
            return self.forward(topic, &payload);
        };
        let by = self.pairs[index].by;
        let key = key.filter(|key| by.accepts_key(key));
        let kind = match by {
            Correlation::Goal => Kind::Goal,
            _ => Kind::Input(index),
        };
        let is_request = match &key {
            Some(key) => self.arbiter.find_by_key(topic, key).is_none(),
            // The action server assigns the id, so no result can be matched to the goal.
            None if kind == Kind::Goal => false,
            None => (self.forward_sides().iter()).any(|side| self.is_free(index, side)),
        };
        if by == Correlation::Arrival {
            self.pairs[index].arrivals.add(now);
        }
        if !is_request {
            if self.forward_sides().local {
                let t_max = self.sla.times(topic).t_max;
                self.pairs[index].arrivals.note_given_locally(now, now, t_max);
            }
            // The stamp was seen before, or, when matching by arrival, a request is outstanding already.
            return self.forward(topic, &payload);
        }
        if let Some(CorrelationKey::Stamp(stamp)) = &key {
            self.pairs[index].first.get_or_insert(*stamp);
        }
        let channel = RequestChannel::Topic(topic.clone());
        self.open(now, kind, channel, key, payload);
    }

    /// Handles an input that the cloud receives by another path: it is sent to the local original if that is fed.
    pub fn on_overheard_input(&mut self, now: Instant, topic: &Arc<str>, payload: P) {
        self.tick(now);
        if self.decider.is_fed() {
            self.give(Responder::Local, None, RequestChannel::Topic(topic.clone()), payload);
        }
    }

    /// Handles the result of a call or a goal from one side, and returns whether to deliver it.
    #[must_use]
    pub fn on_result(&mut self, now: Instant, side: Responder, id: RequestId) -> DeliveryVerdict {
        self.tick(now);
        self.on_answer(now, side, id, 0)
    }

    /// Records that one side cannot give the result of a call or a goal.
    pub fn on_failure(&mut self, now: Instant, side: Responder, id: RequestId, failure: &Failure) {
        self.tick(now);
        let Some(record) = self.arbiter.get(id) else {
            return;
        };
        if side == Responder::Cloud {
            let t = matches!(failure, Failure::Refused(_)).then(|| now - record.asked_at);
            self.judge(id, t);
            if t.is_some() {
                self.report_outcome(id);
            }
        }
        self.arbiter.mark_failed(id, side, failure.text());
        self.decide(now);
        self.fail_if_hopeless(id);
    }

    /// Handles an output of one side, and returns whether to deliver it. `key` identifies the input that it answers, as
    /// the application wrote it, if it has one.
    #[must_use]
    pub fn output(
        &mut self,
        now: Instant,
        side: Responder,
        topic: &str,
        key: Option<CorrelationKey>,
        age: impl Into<OutputAge>,
    ) -> DeliveryVerdict {
        let age = age.into();
        self.tick(now);
        if side == Responder::Cloud {
            self.measure(now, topic, age.since_stamp);
        }
        let arrived = self.find_arrived(now, side, topic, age);
        if let Some((pair, inputs)) = arrived {
            if self.pairs[pair].arrivals.is_repetition(side, inputs) {
                self.on_repeated_answer(now, side, topic, inputs.newest);
                return DeliveryVerdict::Drop;
            }
        }
        let verdict = match self.find_request(now, side, topic, key) {
            Some((id, output)) => self.on_answer(now, side, id, output),
            // It answers no request: only the side that speaks for the node at the moment is delivered.
            None => {
                self.decide(now);
                // It may publish before it is known to listen: without a link no other side speaks.
                let alone = !self.link && self.decider.is_coming();
                let speaker = if self.decider.is_fed() || alone { Responder::Local } else { Responder::Cloud };
                if side == speaker { DeliveryVerdict::Deliver } else { DeliveryVerdict::Drop }
            }
        };
        if verdict == DeliveryVerdict::Deliver {
            if let Some((pair, inputs)) = arrived {
                self.pairs[pair].arrivals.note_delivered(side, inputs);
            }
            if let Some(meter) = self.meter.as_mut().filter(|meter| meter.output == topic) {
                meter.delivered.output(now, age.since_stamp);
            }
        }
        verdict
    }

    /// Handles the link coming up. `resumed`: requests sent before will still be answered.
    pub fn link_up(&mut self, now: Instant, resumed: bool) {
        self.tick(now);
        if std::mem::replace(&mut self.link, true) {
            return;
        }
        self.reached = true;
        self.away = false;
        self.away_at = None;
        if self.sla.is_link_based() {
            self.decider.clear_sign();
        }
        let next = if resumed { RequestLeg::Asked } else { RequestLeg::NotAsked };
        if !resumed {
            for stream in &mut self.pairs {
                stream.queues[Responder::Cloud.index()].waiting.clear();
            }
        }
        // A new stateful service has lost its earlier requests, and asking again could execute them twice.
        let anew = resumed || self.sla.mode == Mode::Stateless;
        if anew {
            self.arbiter.replace_legs(Responder::Cloud, &RequestLeg::Lost, &next);
        } else {
            for id in self.arbiter.select(|record| record.cloud == RequestLeg::Lost) {
                self.judge(id, None);
            }
            let reason = RequestLeg::Failed("the servant was lost with the link".into());
            for id in self.arbiter.replace_legs(Responder::Cloud, &RequestLeg::Lost, &reason) {
                self.fail_if_hopeless(id);
            }
        }
        self.decide(now);
        self.ask_open_requests(now, Responder::Cloud);
    }

    /// Handles the loss of the link. Requests in flight may still be answered in time when the link is back, so they
    /// count as late only at T_max; they are sent to the local original if that is fed.
    pub fn link_down(&mut self, now: Instant) {
        self.tick(now);
        if !std::mem::replace(&mut self.link, false) {
            return;
        }
        self.on_link_lost(now);
        let lost = self.arbiter.replace_legs(Responder::Cloud, &RequestLeg::Asked, &RequestLeg::Lost);
        self.decide(now);
        for id in lost {
            self.fail_if_hopeless(id);
        }
    }

    /// Handles a new state of the local original's process.
    pub fn on_local_state(&mut self, now: Instant, state: LocalState) {
        self.tick(now);
        for event in self.decider.on_state_change(state) {
            self.push_event(now, event);
        }
        self.decide(now);
        if self.decider.state() != LocalState::Ready {
            self.on_local_lost(now);
            // Some requests were waiting for it to start.
            for id in self.arbiter.select(Record::is_open) {
                self.fail_if_hopeless(id);
            }
        }
    }

    /// Handles a crash of the local original; it will be restarted.
    pub fn on_local_crash(&mut self, now: Instant, reason: &str) {
        self.tick(now);
        self.push_event(now, QosEvent::Crashed(reason.to_owned()));
        self.on_local_state(now, LocalState::Starting);
    }

    /// Handles everything that is due at `now`.
    pub fn tick(&mut self, now: Instant) {
        if !self.arbiter.is_crowded() && self.deadline().is_none_or(|deadline| deadline > now) {
            return;
        }
        if self.away_at.is_some_and(|at| at <= now) {
            self.away_at = None;
            self.away = true;
        }
        let pairs = &self.pairs;
        let Expired { hedges, overdue, forgotten } = self.arbiter.expire(now, |id, record| match record.kind {
            Kind::Input(pair) => pairs[pair].left_out_deadline(id, record),
            _ => None,
        });
        for id in hedges {
            self.hedge(now, id);
        }
        let mut stop = false;
        for id in &overdue {
            stop |= self.on_t_max(*id);
        }
        for (id, record) in forgotten {
            self.forget(id, record);
        }
        if let Some(meter) = &mut self.meter {
            let missed = meter.cloud.take_missed(now);
            stop |= meter.delivered.take_missed(now) > 0;
            for _ in 0..missed {
                self.observe(None, self.sla.t_desire, self.sla.t_max);
            }
        }
        if stop && self.sla.safe_stop.is_some() {
            self.counts.safe_stops += 1;
            self.effects.push_back(Effect::SafeStop);
        }
        self.decide(now);
        // The overdue requests may have started the local original, which may still answer them.
        for id in overdue {
            self.fail_if_hopeless(id);
            self.arbiter.close_call(id);
        }
    }
}
