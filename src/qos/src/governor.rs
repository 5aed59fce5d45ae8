//! All parts together, for one node of the package.

mod asking;
mod effect;
mod frames;
mod giving_up;
mod judging;
mod original;
mod queue;
mod standing;
mod stream;

use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::arbiter::{Arbiter, Kind, Limits, Record, Verdict};
use crate::channel::Channel;
use crate::decider::{Decider, Event, LocalState};
use crate::measure::Meter;
use crate::pair::{Correlation, Pair};
use crate::phases::PhaseBook;
use crate::report::Counts;
use crate::request::{Failure, Key, Leg, RequestId, Side, Sides};
use crate::satisfaction::Satisfaction;
use crate::sla::{Mode, Sla};

pub use effect::Effect;
use frames::Metered;
use stream::Stream;

/// Events kept for the report.
const EVENTS: usize = 32;
/// So many stamped outputs of which none carries the stamp of an input show that the node does not copy it.
const UNMATCHED: u32 = 8;

/// Quality of service of one node. `P` is a message, cheap to clone.
///
/// Whoever drives it calls a method for whatever happens, then takes [`effects`](Self::next_effect) until there are
/// none, and calls [`tick`](Self::tick) at [`deadline`](Self::deadline).
#[derive(Debug)]
pub struct Governor<P> {
    sla: Sla,
    satisfaction: Satisfaction,
    decider: Decider,
    arbiter: Arbiter<P>,
    /// What the cloud's outputs are measured by, where that is not the response time.
    meter: Option<Metered>,
    pairs: Vec<Stream>,
    link: bool,
    /// Whether the link was ever up.
    reached: bool,
    /// The link has been down for so long that the local original is to stand in whatever Q is.
    away: bool,
    /// When the cloud will have been away for so long that the local original stands in.
    away_at: Option<Instant>,
    counts: Counts,
    phases: PhaseBook,
    /// How long the local original took for its last answer.
    local_time: Option<Duration>,
    /// Outputs that somebody listens to.
    listened: BTreeSet<String>,
    events: VecDeque<(Instant, Event)>,
    effects: VecDeque<Effect<P>>,
}

impl<P: Clone> Governor<P> {
    /// The link is down and the local original not started. `pairs` are those whose topics exist already.
    pub fn new(sla: Sla, pairs: Vec<Pair>, limits: Limits) -> Self {
        let metered = |(output, meter): (&str, Meter)| Metered {
            output: output.to_owned(),
            delivered: meter.clone(),
            cloud: meter,
        };
        Self {
            satisfaction: Satisfaction::new(sla.initial, sla.threshold, sla.cap),
            decider: Decider::new(&sla),
            arbiter: Arbiter::new(limits),
            meter: Meter::new(&sla).map(metered),
            pairs: pairs.into_iter().map(Stream::new).collect(),
            link: false,
            reached: false,
            away: sla.mode == Mode::Stateful && !sla.is_of_link(),
            away_at: None,
            counts: Counts::default(),
            phases: PhaseBook::default(),
            local_time: None,
            listened: BTreeSet::new(),
            events: VecDeque::new(),
            effects: VecDeque::new(),
            sla,
        }
    }

    /// The next thing to do.
    pub fn next_effect(&mut self) -> Option<Effect<P>> {
        self.effects.pop_front()
    }

    /// When [`tick`](Self::tick) has something to do.
    pub fn deadline(&self) -> Option<Instant> {
        let meters = self.meter.as_ref();
        let meters = meters.map(|meter| [meter.cloud.deadline(), meter.delivered.deadline()]);
        let others = meters.into_iter().flatten().flatten().chain(self.away_at);
        self.arbiter.deadline().into_iter().chain(others).min()
    }

    /// Who is given messages at the moment.
    pub fn sides(&self) -> Sides {
        Sides {
            cloud: self.link,
            local: self.decider.is_fed(),
        }
    }

    /// Q now.
    pub fn satisfaction(&self) -> &Satisfaction {
        &self.satisfaction
    }

    /// The node is up; a warm local original is started now.
    pub fn begin(&mut self, now: Instant) {
        if !self.link {
            self.left_alone(now);
        }
        self.decide(now);
    }

    /// The topics of more decided pairs exist now, or further outputs of those that are known: nothing else is paired.
    pub fn learn(&mut self, now: Instant, pairs: Vec<Pair>) {
        if let Some(meter) = &mut self.meter {
            if let Some(first) = pairs.first().filter(|_| meter.output.is_empty()) {
                meter.output = first.outputs[0].clone();
            }
        }
        self.await_frames(now);
        for pair in pairs {
            match self
                .pairs
                .iter_mut()
                .find(|stream| stream.pair.input == pair.input)
            {
                Some(stream) => stream.pair.outputs = pair.outputs,
                None => self.pairs.push(Stream::new(pair)),
            }
        }
    }

    /// The application calls a service.
    pub fn call(&mut self, now: Instant, name: &Arc<str>, payload: P) -> RequestId {
        self.open(now, Kind::Call, Channel::Call(name.clone()), None, payload)
    }

    /// The application sends a goal of an action that is made of calls (ROS 2), with its id. Its result answers it.
    pub fn goal(&mut self, now: Instant, action: &Arc<str>, id: Key, payload: P) -> RequestId {
        let channel = Channel::Call(action.clone());
        self.open(now, Kind::Goal, channel, Some(id), payload)
    }

    /// A side has accepted a goal: it is being carried out, however long that takes.
    pub fn accepted(&mut self, now: Instant, id: RequestId) {
        self.tick(now);
        if let Some(record) = self.arbiter.get_mut(id) {
            record.taken = true;
        }
    }

    fn open(
        &mut self,
        now: Instant,
        kind: Kind,
        channel: Channel,
        key: Option<Key>,
        payload: P,
    ) -> RequestId {
        self.tick(now);
        let times = self.sla.times(channel.name());
        let id = self
            .arbiter
            .open((now, times.t_max), kind, channel, key, payload);
        self.asked(now, id);
        id
    }

    /// The application does not want the answer any more.
    pub fn cancel(&mut self, now: Instant, id: RequestId) {
        self.tick(now);
        self.arbiter.cancel(id);
    }

    /// The application publishes an input; its answer is recognised by `key`, where it has one.
    pub fn input(&mut self, now: Instant, topic: &Arc<str>, key: Option<Key>, payload: P) {
        self.tick(now);
        let mut pairs = self.pairs.iter();
        let Some(index) = pairs.position(|stream| *stream.input == **topic) else {
            return self.pass_on(topic, &payload);
        };
        let by = self.pairs[index].by;
        let key = key.filter(|key| by.takes(key));
        let kind = match by {
            Correlation::Goal => Kind::Goal,
            _ => Kind::Input(index),
        };
        let is_request = match &key {
            Some(key) => self.arbiter.keyed(topic, key).is_none(),
            // Its server makes up the id: nothing tells which result is its own.
            None if kind == Kind::Goal => false,
            None => (self.told_sides().iter()).any(|side| self.is_free(index, side)),
        };
        if !is_request {
            // The same stamp again, or, by arrival, one is outstanding already.
            return self.pass_on(topic, &payload);
        }
        if let Some(Key::Stamp(stamp)) = &key {
            self.pairs[index].first.get_or_insert(*stamp);
        }
        let channel = Channel::Topic(topic.clone());
        self.open(now, kind, channel, key, payload);
    }

    /// An input that the cloud has by another way: it is for the local original, if that is fed.
    pub fn overheard(&mut self, now: Instant, topic: &Arc<str>, payload: P) {
        self.tick(now);
        if self.decider.is_fed() {
            self.give(Side::Local, None, Channel::Topic(topic.clone()), payload);
        }
    }

    /// A side gave the result of a call or a goal.
    #[must_use]
    pub fn answered(&mut self, now: Instant, side: Side, id: RequestId) -> Verdict {
        self.tick(now);
        self.completed(now, side, id, 0)
    }

    /// A side cannot give the result of a call or a goal.
    pub fn failed(&mut self, now: Instant, side: Side, id: RequestId, failure: &Failure) {
        self.tick(now);
        let Some(record) = self.arbiter.get(id) else {
            return;
        };
        if side == Side::Cloud {
            let t = matches!(failure, Failure::Refused(_)).then(|| now - record.asked_at);
            self.judge(id, t);
            if t.is_some() {
                self.announce(id);
            }
        }
        self.arbiter.failed(id, side, failure.text());
        self.decide(now);
        self.fail_if_hopeless(id);
    }

    /// A side publishes an output; `key` tells which input it answers, where it has one, as the application wrote it;
    /// `age` is the time since that stamp, zero where it is not known.
    #[must_use]
    pub fn output(
        &mut self,
        now: Instant,
        side: Side,
        topic: &str,
        key: Option<Key>,
        age: Duration,
    ) -> Verdict {
        self.tick(now);
        if side == Side::Cloud {
            self.measure(now, topic, age);
        }
        let verdict = match self.request_of(now, side, topic, key) {
            Some((id, output)) => self.completed(now, side, id, output),
            // Nobody asked for it: only who speaks for the node at the moment is heard.
            None => {
                self.decide(now);
                // It may say something before it is known to listen: without a link nobody else speaks.
                let alone = !self.link && self.decider.is_coming();
                let speaker = if self.decider.is_fed() || alone {
                    Side::Local
                } else {
                    Side::Cloud
                };
                if side == speaker {
                    Verdict::Deliver
                } else {
                    Verdict::Drop
                }
            }
        };
        if verdict == Verdict::Deliver {
            if let Some(meter) = self.meter.as_mut().filter(|meter| meter.output == topic) {
                meter.delivered.output(now, age);
            }
        }
        verdict
    }

    /// The link is up. `resumed`: what was sent before and not answered will be answered yet.
    pub fn link_up(&mut self, now: Instant, resumed: bool) {
        self.tick(now);
        if std::mem::replace(&mut self.link, true) {
            return;
        }
        self.reached = true;
        self.away = false;
        self.away_at = None;
        if self.sla.is_of_link() {
            self.decider.calm();
        }
        let next = if resumed { Leg::Asked } else { Leg::NotAsked };
        if !resumed {
            for stream in &mut self.pairs {
                stream.queues[Side::Cloud.index()].waiting.clear();
            }
        }
        // A stateful service that is new has forgotten what it was asked; asking again could do it twice.
        let anew = resumed || self.sla.mode == Mode::Stateless;
        if anew {
            self.arbiter.turn(Side::Cloud, &Leg::Lost, &next);
        } else {
            for id in self.arbiter.select(|record| record.cloud == Leg::Lost) {
                self.judge(id, None);
            }
            let reason = Leg::Failed("the servant was lost with the link".into());
            for id in self.arbiter.turn(Side::Cloud, &Leg::Lost, &reason) {
                self.fail_if_hopeless(id);
            }
        }
        self.decide(now);
        self.give_waiting(now, Side::Cloud);
    }

    /// The link is down. What is in flight may be answered in time yet when the link is back, so it counts as late at
    /// T_max only; it goes to the local original if that is fed.
    pub fn link_down(&mut self, now: Instant) {
        self.tick(now);
        if !std::mem::replace(&mut self.link, false) {
            return;
        }
        self.left_alone(now);
        let lost = self.arbiter.turn(Side::Cloud, &Leg::Asked, &Leg::Lost);
        self.decide(now);
        for id in lost {
            self.fail_if_hopeless(id);
        }
    }

    /// The local original's process changed.
    pub fn local(&mut self, now: Instant, state: LocalState) {
        self.tick(now);
        for event in self.decider.reported(state) {
            self.say(now, event);
        }
        self.decide(now);
        if self.decider.state() != LocalState::Ready {
            self.local_lost(now);
            // Some waited for it to come.
            for id in self.arbiter.select(Record::is_open) {
                self.fail_if_hopeless(id);
            }
        }
    }

    /// The local original ended by itself and will be started again.
    pub fn local_crashed(&mut self, now: Instant, reason: &str) {
        self.tick(now);
        self.say(now, Event::Crashed(reason.to_owned()));
        self.local(now, LocalState::Starting);
    }

    /// Time has passed.
    pub fn tick(&mut self, now: Instant) {
        if !self.arbiter.is_crowded() && self.deadline().is_none_or(|deadline| deadline > now) {
            return;
        }
        if self.away_at.is_some_and(|at| at <= now) {
            self.away_at = None;
            self.away = true;
        }
        let pairs = &self.pairs;
        let (overdue, forgotten) = self.arbiter.expire(now, |id, record| match record.kind {
            Kind::Input(pair) => pairs[pair].may_be_left_out(id, record),
            _ => None,
        });
        let mut stop = false;
        for id in &overdue {
            stop |= self.passes_t_max(*id);
        }
        for (id, record) in forgotten {
            self.forget(id, record);
        }
        if let Some(meter) = &mut self.meter {
            let missed = meter.cloud.missed(now);
            stop |= meter.delivered.missed(now) > 0;
            for _ in 0..missed {
                self.observe(None, self.sla.t_desire, self.sla.t_max);
            }
        }
        if stop && self.sla.safe_stop.is_some() {
            self.counts.safe_stops += 1;
            self.effects.push_back(Effect::SafeStop);
        }
        self.decide(now);
        // The local original may be wanted because of them, and answer yet.
        for id in overdue {
            self.fail_if_hopeless(id);
            self.arbiter.close_call(id);
        }
    }
}
