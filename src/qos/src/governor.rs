//! All parts together, for one node of the package.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::arbiter::{Arbiter, Kind, Limits, Record, Verdict};
use crate::decider::{Decider, Event, LocalState};
use crate::measure::Meter;
use crate::outcome::Outcome;
use crate::pair::{Correlation, Pair};
use crate::phases::{PhaseBook, Phases};
use crate::report::{Counts, Report, TimedEvent};
use crate::request::{Failure, Key, Leg, RequestId, Side, Sides};
use crate::satisfaction::{Satisfaction, Step};
use crate::sla::{Local, Measure, Mode, Sla};

/// Events kept for the report.
const EVENTS: usize = 32;
/// So many stamped outputs of which none carries the stamp of an input show that the node does not copy it.
const UNMATCHED: u32 = 8;

/// Clocks of two machines are known that well; phases that add up to something else are of another request.
const PHASES_APART: Duration = Duration::from_millis(20);

/// Where a message goes to or came from.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Channel {
    /// A service or an action, by absolute name.
    Call(Arc<str>),
    /// A topic, by absolute name.
    Topic(Arc<str>),
}

/// What is to be done, in this order.
#[derive(Debug, Clone, PartialEq)]
pub enum Effect<P> {
    /// Hand this to one side.
    Give {
        /// Whom.
        side: Side,
        /// The request it belongs to; none for messages that await no answer.
        request: Option<RequestId>,
        /// Where it goes.
        channel: Channel,
        /// The message.
        payload: P,
    },
    /// Tell the application that there will be no answer.
    Fail {
        /// Which.
        request: RequestId,
        /// Where it was asked.
        channel: Channel,
        /// Why not.
        reason: String,
    },
    /// Publish the SLA's safe-stop message: nobody has answered in time.
    SafeStop,
    /// The cloud's time of a request has counted, or more is known of one whose has.
    Outcome(Outcome),
    /// A decision about the local original.
    Event(Event),
}

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
    counts: Counts,
    phases: PhaseBook,
    /// How long the local original took for its last answer.
    local_time: Option<Duration>,
    /// Outputs that somebody listens to.
    listened: BTreeSet<String>,
    events: VecDeque<(Instant, Event)>,
    effects: VecDeque<Effect<P>>,
}

#[derive(Debug)]
struct Metered {
    output: String,
    cloud: Meter,
    /// Of what the application got: when that stops, the robot must.
    delivered: Meter,
}

/// A pair, and what is under way of it.
#[derive(Debug)]
struct Stream {
    pair: Pair,
    input: Arc<str>,
    by: Correlation,
    keys: HashMap<Key, RequestId>,
    /// By arrival: what each side has to answer next.
    outstanding: [Option<RequestId>; 2],
    /// By arrival: what each side did not answer by T_max; if it does yet, it must not be taken for more.
    owed: [Option<RequestId>; 2],
    /// Stamped outputs in a row that no input had; none once one has matched.
    unmatched: Option<u32>,
}

impl<P: Clone> Governor<P> {
    /// The link is down and the local original not started. `pairs` are those that [`find`](crate::find) gave.
    pub fn new(sla: Sla, pairs: Vec<Pair>, limits: Limits) -> Self {
        let metered = |(output, meter): (&str, Meter)| Metered {
            output: output.to_owned(),
            delivered: meter.clone(),
            cloud: meter,
        };
        Self {
            satisfaction: Satisfaction::new(sla.initial, sla.threshold),
            decider: Decider::new(&sla),
            arbiter: Arbiter::new(limits),
            meter: Meter::new(&sla).map(metered),
            pairs: pairs.into_iter().map(Stream::new).collect(),
            link: false,
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
        let meters = meters.into_iter().flatten().flatten();
        self.arbiter.deadline().into_iter().chain(meters).min()
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
        self.decide(now);
    }

    /// More of the interface has become known: pairs of new inputs, further outputs of known ones.
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

    /// The application calls a service or sends a goal.
    pub fn call(&mut self, now: Instant, name: &Arc<str>, payload: P) -> RequestId {
        self.tick(now);
        let t_max = self.sla.times(name).t_max;
        let id = self.arbiter.call(now, t_max, name, payload);
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
        let Some(index) = self
            .pairs
            .iter()
            .position(|stream| *stream.input == **topic)
        else {
            for side in self.asked_sides() {
                self.give(side, None, Channel::Topic(topic.clone()), payload.clone());
            }
            return;
        };
        let stream = &mut self.pairs[index];
        let key = key.filter(|key| stream.by.takes(key));
        let free = |side: Side| stream.outstanding[side.index()].is_none();
        let busy = match &key {
            Some(key) => stream.keys.contains_key(key),
            // Its server makes up the id: nothing tells which result is its own.
            None if stream.by == Correlation::Goal => true,
            None => !(free(Side::Cloud) || self.decider.is_fed() && free(Side::Local)),
        };
        if busy {
            // Not a request of its own: the same stamp again, or, by arrival, one is outstanding already.
            for side in self.asked_sides() {
                self.give(side, None, Channel::Topic(topic.clone()), payload.clone());
            }
            return;
        }
        let kind = Kind::Input {
            pair: index,
            key: key.clone(),
            outputs: stream.pair.outputs.len(),
        };
        let t_max = self.sla.times(topic).t_max;
        let id = self.arbiter.open(now, t_max, kind, payload);
        if let Some(key) = key {
            self.pairs[index].keys.insert(key, id);
        }
        self.asked(now, id);
    }

    /// A side gave the result of a call.
    #[must_use]
    pub fn answered(&mut self, now: Instant, side: Side, id: RequestId) -> Verdict {
        self.tick(now);
        self.completed(now, side, id, 0)
    }

    /// A side cannot give the result of a call.
    pub fn failed(&mut self, now: Instant, side: Side, id: RequestId, failure: &Failure) {
        self.tick(now);
        let Some(record) = self.arbiter.get(id) else {
            return;
        };
        if side == Side::Cloud {
            let t = matches!(failure, Failure::Refused(_)).then(|| now - record.asked_at);
            self.judge(id, t);
            if t.is_some() {
                self.tell(id);
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
        let verdict = match self.request_of(side, topic, key) {
            Some((id, output)) => self.completed(now, side, id, output),
            // Nobody asked for it: only who speaks for the node at the moment is heard.
            None => {
                self.decide(now);
                let speaker = if self.decider.is_fed() {
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

    /// Somebody listens to an output, or nobody does: frames that nobody wants are not missed.
    pub fn wanted(&mut self, now: Instant, output: &str, wanted: bool) {
        self.tick(now);
        if wanted {
            self.listened.insert(output.to_owned());
        } else {
            self.listened.remove(output);
        }
        self.await_frames(now);
    }

    fn await_frames(&mut self, now: Instant) {
        if let Some(metered) = &mut self.meter {
            let wanted = self.listened.contains(&metered.output);
            for meter in [&mut metered.cloud, &mut metered.delivered] {
                if wanted {
                    meter.start(now)
                } else {
                    meter.stop()
                }
            }
        }
    }

    /// The link is up. `resumed`: what was sent before and not answered will be answered yet.
    pub fn link_up(&mut self, now: Instant, resumed: bool) {
        self.tick(now);
        if std::mem::replace(&mut self.link, true) {
            return;
        }
        let next = if resumed { Leg::Asked } else { Leg::NotAsked };
        // A stateful service that is new has forgotten what it was asked; asking again could do it twice.
        let anew = resumed || self.sla.mode == Mode::Stateless;
        if anew {
            self.arbiter.turn(Side::Cloud, &Leg::Lost, &next);
        } else {
            let reason = Leg::Failed("the servant was lost with the link".into());
            for id in self.arbiter.turn(Side::Cloud, &Leg::Lost, &reason) {
                self.fail_if_hopeless(id);
            }
        }
        self.decide(now);
        self.give_waiting(now, Side::Cloud);
    }

    /// The link is down: what is in flight counts as late, and goes to the local original if that runs.
    pub fn link_down(&mut self, now: Instant) {
        self.tick(now);
        if !std::mem::replace(&mut self.link, false) {
            return;
        }
        let lost = self.arbiter.turn(Side::Cloud, &Leg::Asked, &Leg::Lost);
        for id in &lost {
            self.judge(*id, None);
        }
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

    /// Where the time went of the request that the cloud has just answered, if it was that one: the sum must be what
    /// the request took.
    pub fn phases(&mut self, phases: &Phases) {
        let answered = |effect: &mut Effect<P>| match effect {
            Effect::Outcome(outcome) if outcome.cloud.is_some() => Some(outcome.clone()),
            _ => None,
        };
        let newest = self.effects.iter_mut().rev().find_map(answered);
        let Some((outcome, t)) = newest.and_then(|outcome| outcome.cloud.map(|t| (outcome, t)))
        else {
            return;
        };
        if t.abs_diff(phases.total()) > PHASES_APART.max(t / 5) {
            return;
        }
        self.phases.record(phases);
        for effect in &mut self.effects {
            if let Effect::Outcome(told) = effect {
                if told.request == outcome.request {
                    told.phases = Some(*phases);
                }
            }
        }
    }

    /// Time has passed.
    pub fn tick(&mut self, now: Instant) {
        if !self.arbiter.is_crowded() && self.deadline().is_none_or(|deadline| deadline > now) {
            return;
        }
        let mut stop = false;
        let (overdue, forgotten) = self.arbiter.expire(now);
        for id in overdue {
            self.judge(id, None);
            for stream in &mut self.pairs {
                for side in 0..2 {
                    if stream.outstanding[side] == Some(id) {
                        stream.owed[side] = stream.outstanding[side].take();
                    }
                }
            }
            if self.arbiter.get(id).is_some_and(Record::is_open) {
                self.counts.unanswered_in_time += 1;
                stop = true;
            }
            self.fail_if_hopeless(id);
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
    }

    /// A snapshot for diagnostics.
    pub fn report(&self, now: Instant) -> Report {
        let event = |(at, event): &(Instant, Event)| TimedEvent {
            ago: now.saturating_duration_since(*at).as_secs_f64(),
            event: event.clone(),
        };
        Report {
            t_desire: self.sla.t_desire.as_secs_f64(),
            t_max: self.sla.t_max.as_secs_f64(),
            q: self.satisfaction.q(),
            threshold: self.satisfaction.threshold(),
            mode: self.sla.mode,
            local: self.sla.local,
            local_state: self.decider.state(),
            fed: self.decider.is_fed(),
            link: self.link,
            pairs: self.pairs.iter().map(|stream| stream.shown()).collect(),
            counts: self.counts,
            phases: self.phases.quantiles(),
            events: self.events.iter().map(event).collect(),
            summary: self.summary(),
        }
    }

    fn summary(&self) -> String {
        let q = format!(
            "Q {:.1} of threshold {:.1}",
            self.satisfaction.q(),
            self.satisfaction.threshold()
        );
        let who = match (self.link, self.decider.is_fed(), self.decider.state()) {
            (true, false, _) if !self.satisfaction.wants_local() => "the cloud answers",
            (true, false, LocalState::Missing) => {
                "the cloud is slow, and there is no local original"
            }
            (true, false, _) if self.sla.local == Local::None => {
                "the cloud is slow, and no local original is to be used"
            }
            (true, false, _) if self.sla.mode == Mode::Stateful => {
                "the cloud is slow; stateful, so it answers alone"
            }
            (true, false, _) => "the cloud is slow, and the local original is starting",
            (true, true, _) => "the cloud is slow, so both are asked and the first answer is taken",
            (false, true, _) => "the link is down, the local original answers",
            (false, false, LocalState::Missing) => {
                "the link is down, and there is no local original: nobody answers"
            }
            (false, false, _) => "the link is down, and the local original does not answer yet",
        };
        match self.phases.dominant() {
            Some((phase, share)) => {
                format!(
                    "{who} ({q}); of the cloud's time {:.0}% is {phase}",
                    share * 100.0
                )
            }
            None => format!("{who} ({q})"),
        }
    }

    /// A request was opened: ask whom there is.
    fn asked(&mut self, now: Instant, id: RequestId) {
        self.counts.requests += 1;
        for side in self.asked_sides() {
            self.ask(now, id, side);
        }
        if !self.link {
            // The cloud cannot have it, so its time is beyond any T_max already now.
            self.judge(id, None);
        }
        self.decide(now);
    }

    fn asked_sides(&self) -> Vec<Side> {
        let sides = self.sides();
        let asked = [(sides.cloud, Side::Cloud), (sides.local, Side::Local)];
        asked
            .into_iter()
            .filter(|(asked, _)| *asked)
            .map(|(_, side)| side)
            .collect()
    }

    fn ask(&mut self, now: Instant, id: RequestId, side: Side) {
        let Some(payload) = self.arbiter.ask(now, id, side) else {
            return;
        };
        let Some(record) = self.arbiter.get(id) else {
            return;
        };
        if let Kind::Input {
            pair, key: None, ..
        } = record.kind
        {
            let slot = &mut self.pairs[pair].outstanding[side.index()];
            slot.get_or_insert(id);
        }
        let channel = self.channel(&self.arbiter.get(id).expect("it was just there").kind);
        self.give(side, Some(id), channel, payload);
    }

    fn give(&mut self, side: Side, request: Option<RequestId>, channel: Channel, payload: P) {
        self.effects.push_back(Effect::Give {
            side,
            request,
            channel,
            payload,
        });
    }

    fn channel(&self, kind: &Kind) -> Channel {
        match kind {
            Kind::Call(name) => Channel::Call(name.clone()),
            Kind::Input { pair, .. } => Channel::Topic(self.pairs[*pair].input.clone()),
        }
    }

    /// Who can answer now is asked for what still waits: calls always, inputs while they are fresh.
    fn give_waiting(&mut self, now: Instant, side: Side) {
        let wanted = |record: &Record<P>| record.is_open() && (record.is_call() || !record.overdue);
        for id in self.arbiter.select(wanted) {
            self.ask(now, id, side);
        }
    }

    /// An input that is late already is given to the local original when that has nothing else to do, and is quick
    /// enough that a fresh one that comes meanwhile is still in time.
    fn give_straggler(&mut self, now: Instant) {
        if !self.decider.is_fed() {
            return;
        }
        let Some(id) = self.arbiter.straggler() else {
            return;
        };
        let Some(Kind::Input {
            pair, key: Some(_), ..
        }) = self.arbiter.get(id).map(|record| &record.kind)
        else {
            return;
        };
        let t_max = self.sla.times(&self.pairs[*pair].input).t_max;
        let quick = self.local_time.is_none_or(|time| 2 * time <= t_max);
        let busy = |record: &Record<P>| {
            record.local == Leg::Asked
                && record.local_asked.is_some_and(|asked| now < asked + t_max)
        };
        if quick && self.arbiter.select(busy).is_empty() {
            self.ask(now, id, Side::Local);
        }
    }

    /// Which request an output answers, and as which of its outputs.
    fn request_of(
        &mut self,
        side: Side,
        topic: &str,
        key: Option<Key>,
    ) -> Option<(RequestId, usize)> {
        for stream in &mut self.pairs {
            let Some(output) = stream.pair.outputs.iter().position(|name| name == topic) else {
                continue;
            };
            if let Some(id) = key.as_ref().and_then(|key| stream.keys.get(key)) {
                stream.unmatched = None;
                return Some((*id, output));
            }
            if stream.by == Correlation::Goal {
                return None;
            }
            if stream.by == Correlation::Stamp {
                if stream.keys.is_empty() && stream.outstanding == [None; 2] {
                    return None;
                }
                if let Some(unmatched) = stream.unmatched.as_mut().filter(|_| output == 0) {
                    *unmatched += 1;
                }
            }
            if output > 0 {
                return None;
            }
            let slot = side.index();
            let id = stream.outstanding[slot]
                .take()
                .or_else(|| stream.owed[slot].take());
            return id.map(|id| (id, 0));
        }
        None
    }

    fn completed(&mut self, now: Instant, side: Side, id: RequestId, output: usize) -> Verdict {
        let answers = output == 0
            && self.arbiter.get(id).is_some_and(|record| match side {
                Side::Cloud => record.cloud != Leg::Answered,
                Side::Local => record.local != Leg::Answered,
            });
        if let Some(record) = self.arbiter.get(id).filter(|_| answers) {
            match (side, record.local_asked) {
                (Side::Cloud, _) => {
                    let t = now.saturating_duration_since(record.asked_at);
                    self.judge(id, Some(t));
                }
                (Side::Local, Some(asked)) => {
                    self.local_time = Some(now.saturating_duration_since(asked));
                }
                (Side::Local, None) => {}
            }
        }
        let verdict = self.arbiter.answer_with(now, id, side, output);
        if answers && (side == Side::Cloud || verdict == Verdict::Deliver) {
            self.tell(id);
        }
        self.arbiter.close_call(id);
        match (verdict, side) {
            (Verdict::Deliver, _) if output > 0 => {}
            (Verdict::Deliver, Side::Cloud) => self.counts.from_cloud += 1,
            (Verdict::Deliver, Side::Local) => self.counts.from_local += 1,
            (Verdict::Drop, _) => self.counts.duplicates += 1,
        }
        self.decide(now);
        verdict
    }

    /// Counts the cloud's time of a request, once. Without one the outcome is told at once; else when it is known
    /// whose answer is taken.
    fn judge(&mut self, id: RequestId, t: Option<Duration>) {
        if !self.arbiter.judge(id, t) {
            return;
        }
        if self.sla.measure == Measure::Rrt {
            self.count(id, t);
        }
        if t.is_none() {
            self.tell(id);
        }
    }

    fn count(&mut self, id: RequestId, t: Option<Duration>) {
        let Some(record) = self.arbiter.get(id) else {
            return;
        };
        let times = match &record.kind {
            Kind::Call(name) => self.sla.times(name),
            Kind::Input { pair, .. } => self.sla.times(&self.pairs[*pair].input),
        };
        self.observe(t, times.t_desire, times.t_max);
    }

    /// Tells the outcome of a request that was judged.
    fn tell(&mut self, id: RequestId) {
        let Some(record) = self.arbiter.get(id).filter(|record| record.judged) else {
            return;
        };
        let stamp = match record.kind {
            Kind::Input {
                key: Some(Key::Stamp(stamp)),
                ..
            } => Some(stamp),
            _ => None,
        };
        let outcome = Outcome {
            request: id,
            channel: self.channel(&record.kind),
            stamp,
            cloud: record.cloud_time,
            answer: record.answered().zip(record.answer_time),
            phases: None,
            q: self.satisfaction.q(),
        };
        self.effects.push_back(Effect::Outcome(outcome));
    }

    fn measure(&mut self, now: Instant, topic: &str, age: Duration) {
        let Some(meter) = self.meter.as_mut().filter(|meter| meter.output == topic) else {
            return;
        };
        if let Some(t) = meter.cloud.output(now, age) {
            self.observe(Some(t), self.sla.t_desire, self.sla.t_max);
            self.decide(now);
        }
    }

    fn observe(&mut self, t: Option<Duration>, t_desire: Duration, t_max: Duration) {
        match self.satisfaction.observe(t, t_desire, t_max) {
            Step::Desired => self.counts.desired += 1,
            Step::Accepted => self.counts.accepted += 1,
            Step::Late => {
                self.counts.late += 1;
                self.decider.late();
            }
        }
    }

    fn decide(&mut self, now: Instant) {
        for event in self.decider.decide(&self.satisfaction, self.link) {
            let (feed, stop) = (
                matches!(event, Event::Feed(_)),
                matches!(event, Event::Stop(_)),
            );
            self.say(now, event);
            if feed {
                self.give_waiting(now, Side::Local);
            }
            if stop {
                self.local_lost(now);
            }
        }
        self.give_straggler(now);
        for index in 0..self.pairs.len() {
            let stream = &mut self.pairs[index];
            if stream.by == Correlation::Stamp && stream.unmatched.is_some_and(|n| n >= UNMATCHED) {
                stream.by = Correlation::Arrival;
                let input = stream.pair.input.clone();
                self.say(now, Event::Uncorrelated(input));
            }
        }
    }

    fn say(&mut self, now: Instant, event: Event) {
        if self.events.len() == EVENTS {
            self.events.pop_front();
        }
        self.events.push_back((now, event.clone()));
        self.effects.push_back(Effect::Event(event));
    }

    /// The local original is gone with what it was asked; the cloud is asked where it was not.
    fn local_lost(&mut self, now: Instant) {
        let reason = Leg::Failed("the local original ended".into());
        let lost = self.arbiter.turn(Side::Local, &Leg::Asked, &reason);
        for stream in &mut self.pairs {
            stream.outstanding[Side::Local.index()] = None;
            stream.owed[Side::Local.index()] = None;
        }
        for id in lost {
            if self.link {
                self.ask(now, id, Side::Cloud);
            }
            self.fail_if_hopeless(id);
        }
    }

    /// Fails a call that nobody can answer any more. While the link is down the cloud may come back, and until its
    /// T_max a call waits for that.
    fn fail_if_hopeless(&mut self, id: RequestId) {
        let Some(record) = self.arbiter.get(id) else {
            return;
        };
        if !record.is_call() || !record.is_open() {
            return;
        }
        let local = match &record.local {
            Leg::Asked => return,
            Leg::NotAsked if self.decider.is_coming() => return,
            Leg::Failed(reason) => reason.clone(),
            _ => match (self.sla.local, self.decider.state()) {
                (Local::None, _) => "no local original is to be used".to_owned(),
                (_, LocalState::Missing) => "there is no local original".to_owned(),
                _ => "the local original does not run".to_owned(),
            },
        };
        let cloud = match &record.cloud {
            Leg::Failed(reason) => reason.clone(),
            Leg::NotAsked | Leg::Lost if !self.link && record.overdue => {
                format!(
                    "the link is down and was not up again within {:?}",
                    record.deadline - record.asked_at
                )
            }
            _ => return,
        };
        let channel = self.channel(&record.kind);
        self.give_up(id, channel, format!("cloud: {cloud}; local: {local}"));
    }

    fn give_up(&mut self, request: RequestId, channel: Channel, reason: String) {
        if self.arbiter.fail(request) {
            self.counts.failed += 1;
            self.effects.push_back(Effect::Fail {
                request,
                channel,
                reason,
            });
        }
    }

    fn forget(&mut self, request: RequestId, record: Record<P>) {
        let channel = self.channel(&record.kind);
        if let Kind::Input { pair, key, .. } = &record.kind {
            let stream = &mut self.pairs[*pair];
            if let Some(key) = key {
                stream.keys.remove(key);
            }
            for slot in stream.outstanding.iter_mut().chain(&mut stream.owed) {
                if *slot == Some(request) {
                    *slot = None;
                }
            }
        }
        if record.is_open() {
            self.counts.failed += 1;
            let reason = "nobody answered while it was remembered".to_owned();
            self.effects.push_back(Effect::Fail {
                request,
                channel,
                reason,
            });
        }
    }
}

impl Stream {
    fn new(pair: Pair) -> Self {
        Self {
            input: pair.input.as_str().into(),
            by: pair.by.unwrap_or(Correlation::Arrival),
            pair,
            keys: HashMap::new(),
            outstanding: [None; 2],
            owed: [None; 2],
            unmatched: Some(0),
        }
    }

    fn shown(&self) -> String {
        Pair {
            by: Some(self.by),
            ..self.pair.clone()
        }
        .to_string()
    }
}
