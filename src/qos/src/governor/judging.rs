//! Counts answers and missing answers towards Q, and reports the outcomes.

use std::time::{Duration, Instant};

use super::{Effect, Governor};
use crate::arbiter::{DeliveryVerdict, Kind};
use crate::outcome::RequestOutcome;
use crate::phases::Phases;
use crate::request::{CorrelationKey, RequestId, RequestLeg, Responder};
use crate::satisfaction::ResponseGrade;
use crate::sla::Measure;

/// Accuracy of the clock offset between two machines; phases whose sum differs by more belong to another request.
const PHASES_APART: Duration = Duration::from_millis(20);

impl<P: Clone> Governor<P> {
    pub(super) fn on_answer(&mut self, now: Instant, side: Responder, id: RequestId, output: usize) -> DeliveryVerdict {
        let sides = self.sides();
        let record = self.arbiter.get_mut(id);
        if record.is_some_and(|record| !record.accept_output(side, output, sides)) {
            return DeliveryVerdict::Drop;
        }
        let record = self.arbiter.get_mut(id).filter(|_| output == 0);
        let answers = record.is_some_and(|record| *record.leg(side) != RequestLeg::Answered);
        if let Some(record) = self.arbiter.get(id).filter(|_| answers) {
            match (side, record.local_asked) {
                (Responder::Cloud, _) => {
                    let t = now.saturating_duration_since(record.asked_at);
                    self.judge(id, Some(t));
                }
                (Responder::Local, Some(asked)) => {
                    self.local_time = Some(now.saturating_duration_since(asked));
                }
                (Responder::Local, None) => {}
            }
        }
        let verdict = self.arbiter.answer_with(now, id, side, output);
        if answers {
            self.on_input_answered(now, side, id);
        }
        if answers && verdict == DeliveryVerdict::Deliver && self.sla.is_link_based() {
            // The SLA has no response time to exceed, so nothing more can be learned about the request.
            self.arbiter.judge(id, None);
        }
        if answers && (side == Responder::Cloud || verdict == DeliveryVerdict::Deliver) {
            self.report_outcome(id);
        }
        self.arbiter.close_call(id);
        match (verdict, side) {
            (DeliveryVerdict::Deliver, _) if output > 0 => {}
            (DeliveryVerdict::Deliver, Responder::Cloud) => self.counts.from_cloud += 1,
            (DeliveryVerdict::Deliver, Responder::Local) => self.counts.from_local += 1,
            (DeliveryVerdict::Drop, _) => self.counts.duplicates += 1,
        }
        self.decide(now);
        verdict
    }

    /// Counts the cloud's time of a request, once. A request without a time is reported at once, the others when it is
    /// known whose answer is taken.
    pub(super) fn judge(&mut self, id: RequestId, t: Option<Duration>) {
        if !self.arbiter.judge(id, t) {
            return;
        }
        if self.sla.measure == Measure::Rrt {
            self.count(id, t);
        }
        if t.is_none() {
            self.report_outcome(id);
        }
    }

    /// Handles a request whose T_max has passed. Returns true if neither this request nor a later one of its pair was
    /// answered.
    pub(super) fn on_t_max(&mut self, id: RequestId) -> bool {
        let Some(record) = self.arbiter.get_mut(id) else {
            return false;
        };
        let mut is_left_out = record.cloud == RequestLeg::LeftOut;
        let is_told = record.failed || record.taken || record.missed;
        let mut awaits = !is_told && !record.is_in_time();
        if let Kind::Input(pair) = record.kind {
            let stream = &self.pairs[pair];
            is_left_out |= stream.is_uncorrelated(record);
            awaits &= !stream.is_uncorrelated(record) && stream.passed <= Some(id);
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

    /// Reports the outcome of a request that has been judged.
    pub(super) fn report_outcome(&mut self, id: RequestId) {
        let Some(record) = self.arbiter.get(id).filter(|record| record.judged) else {
            return;
        };
        let stamp = match record.key {
            Some((_, CorrelationKey::Stamp(stamp))) => Some(stamp),
            _ => None,
        };
        let outcome = RequestOutcome {
            request: id,
            channel: record.channel.clone(),
            stamp,
            cloud: record.cloud_time,
            answer: record.answered_by().zip(record.answer_time),
            phases: None,
            q: self.satisfaction.q(),
        };
        self.effects.push_back(Effect::Outcome(outcome));
    }

    pub(super) fn observe(&mut self, t: Option<Duration>, t_desire: Duration, t_max: Duration) {
        match self.satisfaction.observe(t, t_desire, t_max) {
            ResponseGrade::Desired => self.counts.desired += 1,
            ResponseGrade::Accepted => self.counts.accepted += 1,
            ResponseGrade::Late => {
                self.counts.late += 1;
                self.decider.note_late();
            }
        }
    }

    /// Records the phases of the request that the cloud has just answered. Phases whose sum does not match the
    /// request's response time belong to another request and are ignored.
    pub fn record_phases(&mut self, phases: &Phases) {
        let answered = |effect: &mut Effect<P>| match effect {
            Effect::Outcome(outcome) if outcome.cloud.is_some() => Some(outcome.clone()),
            _ => None,
        };
        let newest = self.effects.iter_mut().rev().find_map(answered);
        let Some((outcome, t)) = newest.and_then(|outcome| outcome.cloud.map(|t| (outcome, t))) else {
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
