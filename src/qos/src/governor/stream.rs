//! A pair, what is under way of it, and which input an output answers.

use std::sync::Arc;
use std::time::Instant;

use super::Governor;
use super::queue::Queue;
use crate::arbiter::{Kind, Record};
use crate::pair::{Correlation, Pair};
use crate::request::{Key, RequestId, Side, Stamp};

/// A pair, and what is under way of it.
#[derive(Debug)]
pub(super) struct Stream {
    pub(super) pair: Pair,
    pub(super) input: Arc<str>,
    pub(super) by: Correlation,
    /// What each side has not answered.
    pub(super) queues: [Queue; 2],
    /// Inputs before this one wait for nobody: a side has answered a later one.
    pub(super) passed: Option<RequestId>,
    /// The stamp of the first input that was asked.
    pub(super) first: Option<Stamp>,
    /// Stamped outputs in a row that no input had; none once one has matched.
    pub(super) unmatched: Option<u32>,
}

impl Stream {
    pub(super) fn new(pair: Pair) -> Self {
        Self {
            input: pair.input.as_str().into(),
            by: pair.by.unwrap_or(Correlation::Arrival),
            pair,
            queues: Default::default(),
            passed: None,
            first: None,
            unmatched: Some(0),
        }
    }

    pub(super) fn shown(&self) -> String {
        Pair {
            by: Some(self.by),
            ..self.pair.clone()
        }
        .to_string()
    }

    /// Whether an input was asked by its stamp before it was known that the node copies none.
    pub(super) fn is_beyond_telling<P>(&self, record: &Record<P>) -> bool {
        record.key.is_some() && self.by == Correlation::Arrival
    }

    /// Until when an input whose T_max has passed may turn out to have been left out. What was given to a busy node is waited for
    /// until T_max after that was heard last, and T_max more than its own at most.
    pub(super) fn may_be_left_out<P>(&self, id: RequestId, record: &Record<P>) -> Option<Instant> {
        let t_max = record.deadline - record.asked_at;
        let passed_over = |queue: &Queue| queue.passed_over(id, record.asked_at);
        let heard = self.queues.iter().filter_map(passed_over).max();
        heard.map(|heard| heard.min(record.deadline) + t_max)
    }
}

impl<P: Clone> Governor<P> {
    /// Whether a side has nothing to answer that is still in time.
    pub(super) fn is_free(&self, pair: usize, side: Side) -> bool {
        let is_overdue = |id: &RequestId| self.arbiter.get(*id).is_none_or(|record| record.overdue);
        let queue = &self.pairs[pair].queues[side.index()];
        queue.waiting.iter().all(is_overdue)
    }

    /// A side has answered an input: it has left out those that it was given before.
    pub(super) fn has_passed(&mut self, now: Instant, side: Side, id: RequestId) {
        let record = self.arbiter.get(id);
        let Some((Kind::Input(pair), deadline)) = record.map(|it| (it.kind, it.deadline)) else {
            return;
        };
        let stream = &mut self.pairs[pair];
        // An answer that is late itself excuses nothing.
        if now <= deadline {
            stream.passed = stream.passed.max(Some(id));
        }
        let queue = &mut stream.queues[side.index()];
        let mut left_out = false;
        for earlier in queue.answered(now, id) {
            let earlier = self.arbiter.get_mut(earlier);
            left_out |= earlier.is_some_and(|record| record.note_left_out(side));
        }
        queue.note(left_out);
    }

    /// Which request an output answers, and as which of its outputs.
    pub(super) fn request_of(
        &mut self,
        now: Instant,
        side: Side,
        topic: &str,
        key: Option<Key>,
    ) -> Option<(RequestId, usize)> {
        // Goals of ROS 2 are calls; their feedback is a topic.
        let of_action = topic.strip_suffix("/_action/feedback");
        if let (Some(action), Some(key @ Key::Goal(_))) = (of_action, &key) {
            return self.arbiter.keyed(&action.into(), key).map(|id| (id, 1));
        }
        for stream in &mut self.pairs {
            let Some(output) = stream.pair.outputs.iter().position(|name| name == topic) else {
                continue;
            };
            let keyed = |key| self.arbiter.keyed(&stream.input, key);
            if let Some(id) = key.as_ref().and_then(keyed) {
                stream.unmatched = None;
                return Some((id, output));
            }
            if stream.by == Correlation::Goal {
                return None;
            }
            if stream.by == Correlation::Stamp {
                // What was asked before the pair was known is answered, too.
                let is_of_earlier = |first| matches!(&key, Some(Key::Stamp(stamp)) if !stamp.is_zero() && *stamp < first);
                let counts = stream.first.is_some_and(|first| !is_of_earlier(first));
                if let Some(unmatched) = stream.unmatched.as_mut().filter(|_| output == 0 && counts)
                {
                    *unmatched += 1;
                    stream.queues[side.index()].heard = Some(now);
                }
            }
            if output > 0 {
                return None;
            }
            // The oldest that may be in time, else the oldest of all: what comes late must not be taken for more.
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
