//! Who is asked.

use std::sync::Arc;
use std::time::Instant;

use super::{Channel, Effect, Governor};
use crate::arbiter::{Kind, Record};
use crate::request::{Leg, RequestId, Side, Sides};

impl<P: Clone> Governor<P> {
    /// A request was opened: ask whom there is.
    pub(super) fn asked(&mut self, now: Instant, id: RequestId) {
        self.counts.requests += 1;
        let sides = self.sides();
        let by_arrival = self.arbiter.get(id).and_then(|record| match record.kind {
            Kind::Input(pair) if record.key.is_none() => Some(pair),
            _ => None,
        });
        for side in sides.iter() {
            if by_arrival.is_some_and(|pair| !self.is_free(pair, side)) {
                self.tell(id, side);
            } else {
                self.ask(now, id, side);
            }
        }
        let waits = |record: &Record<P>| !record.has_caller();
        if sides == Sides::default() && self.arbiter.get(id).is_some_and(waits) {
            // The way to the cloud keeps it in order with what awaits no answer. A call waits here: it may fail before the
            // link is back, and must not be done then.
            self.ask(now, id, Side::Cloud);
            self.arbiter.turn(Side::Cloud, &Leg::Asked, &Leg::Lost);
        }
        self.decide(now);
    }

    /// Who is given what awaits no answer. While the link is down and nobody stands in, the way to the cloud takes it.
    pub(super) fn told_sides(&self) -> Sides {
        let Sides { cloud, local } = self.sides();
        let cloud = cloud || !local;
        Sides { cloud, local }
    }

    /// What is no request of its own goes where requests go.
    pub(super) fn pass_on(&mut self, topic: &Arc<str>, payload: &P) {
        for side in self.told_sides().iter() {
            let channel = Channel::Topic(topic.clone());
            self.give(side, None, channel, payload.clone());
        }
    }

    pub(super) fn ask(&mut self, now: Instant, id: RequestId, side: Side) {
        let Some(payload) = self.arbiter.ask(now, id, side) else {
            return;
        };
        let Some(record) = self.arbiter.get(id) else {
            return;
        };
        if let Kind::Input(pair) = record.kind {
            let queue = &mut self.pairs[pair].queues[side.index()];
            queue.add(id);
        }
        let channel = record.channel.clone();
        self.give(side, Some(id), channel, payload);
    }

    /// Gives a request to a side that is at an earlier one: its next output will not be taken for the answer.
    fn tell(&mut self, id: RequestId, side: Side) {
        let Some(record) = self.arbiter.get_mut(id) else {
            return;
        };
        record.note_left_out(side);
        if let Some(payload) = record.payload.clone() {
            let channel = record.channel.clone();
            self.give(side, None, channel, payload);
        }
    }

    pub(super) fn give(
        &mut self,
        side: Side,
        request: Option<RequestId>,
        channel: Channel,
        payload: P,
    ) {
        self.effects.push_back(Effect::Give {
            side,
            request,
            channel,
            payload,
        });
    }

    /// Who can answer now is asked for what still waits: calls always, inputs while they are fresh.
    pub(super) fn give_waiting(&mut self, now: Instant, side: Side) {
        let is_fresh = |record: &Record<P>| !record.overdue && record.cloud != Leg::LeftOut;
        let wanted =
            |record: &Record<P>| record.is_open() && (record.is_call() || is_fresh(record));
        for id in self.arbiter.select(wanted) {
            self.ask(now, id, side);
        }
    }

    /// An input that is late already is given to the local original when that has nothing else to do, and is quick
    /// enough that a fresh one that comes meanwhile is still in time.
    pub(super) fn give_straggler(&mut self, now: Instant) {
        if !self.decider.is_fed() {
            return;
        }
        let Some(id) = self.arbiter.straggler() else {
            return;
        };
        let Some(record) = self.arbiter.get(id).filter(|record| record.key.is_some()) else {
            return;
        };
        let t_max = record.deadline - record.asked_at;
        let quick = self.local_time.is_none_or(|time| 2 * time <= t_max);
        let busy = |record: &Record<P>| {
            record.local == Leg::Asked
                && record.local_asked.is_some_and(|asked| now < asked + t_max)
        };
        if quick && self.arbiter.select(busy).is_empty() {
            self.ask(now, id, Side::Local);
        }
    }
}
