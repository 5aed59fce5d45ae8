//! What an answer, or its absence, means for Q, and what is told of it.

use std::time::{Duration, Instant};

use super::{Effect, Governor};
use crate::arbiter::{Kind, Verdict};
use crate::outcome::Outcome;
use crate::phases::Phases;
use crate::request::{Key, Leg, RequestId, Side};
use crate::satisfaction::Step;
use crate::sla::Measure;

/// Clocks of two machines are known that well; phases that add up to something else are of another request.
const PHASES_APART: Duration = Duration::from_millis(20);

impl<P: Clone> Governor<P> {
    pub(super) fn completed(
        &mut self,
        now: Instant,
        side: Side,
        id: RequestId,
        output: usize,
    ) -> Verdict {
        let sides = self.sides();
        let record = self.arbiter.get_mut(id);
        if record.is_some_and(|record| !record.hears(side, output, sides)) {
            return Verdict::Drop;
        }
        let record = self.arbiter.get_mut(id).filter(|_| output == 0);
        let answers = record.is_some_and(|record| *record.leg(side) != Leg::Answered);
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
        if answers {
            self.has_passed(now, side, id);
        }
        if answers && verdict == Verdict::Deliver && self.sla.is_of_link() {
            // No time is promised that could pass: there is nothing more to learn about it.
            self.arbiter.judge(id, None);
        }
        if answers && (side == Side::Cloud || verdict == Verdict::Deliver) {
            self.announce(id);
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
    pub(super) fn judge(&mut self, id: RequestId, t: Option<Duration>) {
        if !self.arbiter.judge(id, t) {
            return;
        }
        if self.sla.measure == Measure::Rrt {
            self.count(id, t);
        }
        if t.is_none() {
            self.announce(id);
        }
    }

    /// T_max of a request has passed. True where nobody has answered it, nor a later one in its place.
    pub(super) fn passes_t_max(&mut self, id: RequestId) -> bool {
        let Some(record) = self.arbiter.get_mut(id) else {
            return false;
        };
        let mut is_left_out = record.cloud == Leg::LeftOut;
        let is_told = record.failed || record.taken || record.missed;
        let mut awaits = !is_told && !record.is_in_time();
        if let Kind::Input(pair) = record.kind {
            let stream = &self.pairs[pair];
            is_left_out |= stream.is_beyond_telling(record);
            awaits &= !stream.is_beyond_telling(record) && stream.passed <= Some(id);
        }
        record.missed |= awaits;
        if !is_left_out {
            self.judge(id, None);
        } else if self.arbiter.judge(id, None) {
            self.counts.left_out += 1;
        }
        self.counts.unanswered_in_time += u64::from(awaits);
        awaits
    }

    pub(super) fn count(&mut self, id: RequestId, t: Option<Duration>) {
        let Some(record) = self.arbiter.get(id) else {
            return;
        };
        let times = self.sla.times(record.channel.name());
        self.observe(t, times.t_desire, times.t_max);
    }

    /// Tells the outcome of a request that was judged.
    pub(super) fn announce(&mut self, id: RequestId) {
        let Some(record) = self.arbiter.get(id).filter(|record| record.judged) else {
            return;
        };
        let stamp = match record.key {
            Some((_, Key::Stamp(stamp))) => Some(stamp),
            _ => None,
        };
        let outcome = Outcome {
            request: id,
            channel: record.channel.clone(),
            stamp,
            cloud: record.cloud_time,
            answer: record.answered().zip(record.answer_time),
            phases: None,
            q: self.satisfaction.q(),
        };
        self.effects.push_back(Effect::Outcome(outcome));
    }

    pub(super) fn observe(&mut self, t: Option<Duration>, t_desire: Duration, t_max: Duration) {
        match self.satisfaction.observe(t, t_desire, t_max) {
            Step::Desired => self.counts.desired += 1,
            Step::Accepted => self.counts.accepted += 1,
            Step::Late => {
                self.counts.late += 1;
                self.decider.late();
            }
        }
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
}
