//! The state of a pair, and the matching of outputs to inputs.

use std::sync::Arc;
use std::time::Instant;

use super::arrivals::{AnsweredInputs, InputSequence};
use super::queue::OutstandingInputs;
use super::{Governor, OutputAge};
use crate::arbiter::{DeliveryVerdict, Kind, Record};
use crate::pair::{Correlation, TopicPair};
use crate::request::{CorrelationKey, RequestId, Responder, Stamp};

/// A pair and its outstanding inputs.
#[derive(Debug)]
pub(super) struct PairState {
    pub(super) pair: TopicPair,
    pub(super) input: Arc<str>,
    pub(super) by: Correlation,
    /// Outstanding inputs of each side.
    pub(super) queues: [OutstandingInputs; 2],
    /// Inputs before this one are no longer expected to be answered: a side has answered a later one.
    pub(super) passed: Option<RequestId>,
    /// Stamp of the first input that was sent as a request.
    pub(super) first: Option<Stamp>,
    /// Number of stamped outputs in a row without a matching input; `None` once one has matched.
    pub(super) unmatched: Option<u32>,
    /// Inputs without a key.
    pub(super) arrivals: InputSequence,
}

impl PairState {
    pub(super) fn new(pair: TopicPair) -> Self {
        Self {
            input: pair.input.as_str().into(),
            by: pair.by.unwrap_or(Correlation::Arrival),
            pair,
            queues: Default::default(),
            passed: None,
            first: None,
            unmatched: Some(0),
            arrivals: InputSequence::default(),
        }
    }

    pub(super) fn describe(&self) -> String {
        TopicPair { by: Some(self.by), ..self.pair.clone() }.to_string()
    }

    /// Returns true if the input was sent with a stamp before the node was found not to copy stamps.
    pub(super) fn is_uncorrelated<P>(&self, record: &Record<P>) -> bool {
        record.key.is_some() && self.by == Correlation::Arrival
    }

    /// Returns the time until which an overdue input may turn out to have been skipped. An input sent to a busy node is
    /// waited for until T_max after the node's last answer, and at most T_max longer than its own deadline.
    pub(super) fn left_out_deadline<P>(&self, id: RequestId, record: &Record<P>) -> Option<Instant> {
        let t_max = record.deadline - record.asked_at;
        let passed_over = |queue: &OutstandingInputs| queue.passed_over_since(id, record.asked_at);
        let heard = self.queues.iter().filter_map(passed_over).max();
        heard.map(|heard| heard.min(record.deadline) + t_max)
    }
}

impl<P: Clone> Governor<P> {
    /// Returns true if the side has no outstanding input that is still in time.
    pub(super) fn is_free(&self, pair: usize, side: Responder) -> bool {
        let is_overdue = |id: &RequestId| self.arbiter.get(*id).is_none_or(|record| record.overdue);
        let queue = &self.pairs[pair].queues[side.index()];
        queue.waiting.iter().all(is_overdue)
    }

    /// Handles an answer to an input: the side has skipped the earlier ones.
    pub(super) fn on_input_answered(&mut self, now: Instant, side: Responder, id: RequestId) {
        let record = self.arbiter.get(id);
        let Some((Kind::Input(pair), deadline)) = record.map(|it| (it.kind, it.deadline)) else {
            return;
        };
        let stream = &mut self.pairs[pair];
        // A late answer does not excuse the earlier inputs.
        if now <= deadline {
            stream.passed = stream.passed.max(Some(id));
        }
        let queue = &mut stream.queues[side.index()];
        let mut left_out = false;
        for earlier in queue.on_answer(now, id) {
            let earlier = self.arbiter.get_mut(earlier);
            left_out |= earlier.is_some_and(|record| record.mark_left_out(side));
        }
        queue.note_left_out(left_out);
    }

    /// Returns the pair of an output that is matched by arrival, and the inputs that it may answer.
    pub(super) fn find_arrived(
        &mut self,
        now: Instant,
        side: Responder,
        topic: &str,
        age: OutputAge,
    ) -> Option<(usize, AnsweredInputs)> {
        let is_answer = |stream: &PairState| {
            let is_first = stream.pair.outputs.first().is_some_and(|output| output == topic);
            is_first && stream.by == Correlation::Arrival
        };
        let pair = self.pairs.iter().position(is_answer)?;
        Some((pair, self.pairs[pair].arrivals.answered_inputs(now, side, age)?))
    }

    /// Handles an answer to an input that the other side has answered, too, or a later one. It counts for the request
    /// that it may answer, and is not delivered.
    pub(super) fn on_repeated_answer(&mut self, now: Instant, side: Responder, topic: &str, newest: u64) {
        let found = self.find_request(now, side, topic, None);
        let may_answer = |(id, _): &(RequestId, usize)| {
            let record = self.arbiter.get(*id);
            let asked = record.and_then(|record| match record.kind {
                Kind::Input(pair) => Some(self.pairs[pair].arrivals.number_at(record.asked_at)),
                _ => None,
            });
            asked.is_some_and(|asked| asked <= newest)
        };
        let verdict = found.filter(may_answer).map(|(id, output)| self.on_answer(now, side, id, output));
        if verdict == Some(DeliveryVerdict::Deliver) {
            let counted = match side {
                Responder::Cloud => &mut self.counts.from_cloud,
                Responder::Local => &mut self.counts.from_local,
            };
            *counted -= 1;
        }
        self.counts.duplicates += u64::from(verdict != Some(DeliveryVerdict::Drop));
    }

    /// Returns the request that an output answers, and the index of the output within the pair.
    pub(super) fn find_request(
        &mut self,
        now: Instant,
        side: Responder,
        topic: &str,
        key: Option<CorrelationKey>,
    ) -> Option<(RequestId, usize)> {
        // Goals of ROS 2 are calls; their feedback is published on a topic.
        let of_action = topic.strip_suffix("/_action/feedback");
        if let (Some(action), Some(key @ CorrelationKey::Goal(_))) = (of_action, &key) {
            return self.arbiter.find_by_key(&action.into(), key).map(|id| (id, 1));
        }
        for stream in &mut self.pairs {
            let Some(output) = stream.pair.outputs.iter().position(|name| name == topic) else {
                continue;
            };
            let keyed = |key| self.arbiter.find_by_key(&stream.input, key);
            if let Some(id) = key.as_ref().and_then(keyed) {
                stream.unmatched = None;
                return Some((id, output));
            }
            if stream.by == Correlation::Goal {
                return None;
            }
            if stream.by == Correlation::Stamp {
                // Requests sent before the pair was known are answered, too.
                let is_of_earlier = |first| {
                    matches!(&key, Some(CorrelationKey::Stamp(stamp))
                    if !stamp.is_zero() && *stamp < first)
                };
                let counts = stream.first.is_some_and(|first| !is_of_earlier(first));
                if let Some(unmatched) = stream.unmatched.as_mut().filter(|_| output == 0 && counts) {
                    *unmatched += 1;
                    stream.queues[side.index()].heard = Some(now);
                }
            }
            if output > 0 {
                return None;
            }
            // The oldest that may be in time, else the oldest of all, so that a late answer is not matched to a later
            // input.
            let waiting = stream.queues[side.index()].waiting.iter();
            let known = waiting.filter_map(|id| Some((*id, self.arbiter.get(*id)?)));
            let mut unkeyed = known.filter(|(_, record)| record.key.is_none());
            let first = unkeyed.clone().next();
            let next = unkeyed.find(|(_, record)| !record.overdue).or(first);
            return next.map(|(id, _)| (id, 0));
        }
        None
    }
}
