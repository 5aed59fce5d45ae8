//! Sends requests to the sides.

use std::sync::Arc;
use std::time::Instant;

use super::{Effect, Governor, RequestChannel};
use crate::arbiter::{Kind, Record};
use crate::request::{RequestId, RequestLeg, Responder, Responders};

impl<P: Clone> Governor<P> {
    /// Sends a newly opened request to the active sides.
    pub(super) fn dispatch(&mut self, now: Instant, id: RequestId) {
        self.counts.requests += 1;
        let sides = self.sides();
        let by_arrival = self.arbiter.get(id).and_then(|record| match record.kind {
            Kind::Input(pair) if record.key.is_none() => Some(pair),
            _ => None,
        });
        for side in sides.iter() {
            if by_arrival.is_some_and(|pair| !self.is_free(pair, side)) {
                self.send_unawaited(now, id, side);
            } else {
                self.ask(now, id, side);
            }
        }
        let waits = |record: &Record<P>| !record.has_caller();
        if sides == Responders::default() && self.arbiter.get(id).is_some_and(waits) {
            // The path to the cloud keeps it in order with messages that await no answer. A call waits here: it may
            // fail before the link is back, and must not be executed after that.
            self.ask(now, id, Responder::Cloud);
            self.arbiter.replace_legs(Responder::Cloud, &RequestLeg::Asked, &RequestLeg::Lost);
        }
        self.decide(now);
    }

    /// Returns the sides that receive messages that await no answer. While the link is down and the local original is
    /// not fed, these are queued for the cloud.
    pub(super) fn forward_sides(&self) -> Responders {
        let Responders { cloud, local } = self.sides();
        let cloud = cloud || !local;
        Responders { cloud, local }
    }

    /// Forwards a message that is no request of its own.
    pub(super) fn forward(&mut self, topic: &Arc<str>, payload: &P) {
        for side in self.forward_sides().iter() {
            let channel = RequestChannel::Topic(topic.clone());
            self.give(side, None, channel, payload.clone());
        }
    }

    pub(super) fn ask(&mut self, now: Instant, id: RequestId, side: Responder) {
        let Some(payload) = self.arbiter.ask(now, id, side) else {
            return;
        };
        let Some(record) = self.arbiter.get(id) else {
            return;
        };
        if let Kind::Input(pair) = record.kind {
            let stream = &mut self.pairs[pair];
            stream.queues[side.index()].add(id);
            if side == Responder::Local {
                stream.arrivals.note_given_locally(now, record.asked_at, record.deadline - record.asked_at);
            }
        }
        let channel = record.channel.clone();
        self.give(side, Some(id), channel, payload);
    }

    /// Sends a request to a side that is busy with an earlier one: the side's next output will not be taken as the
    /// answer to this one.
    fn send_unawaited(&mut self, now: Instant, id: RequestId, side: Responder) {
        let Some(record) = self.arbiter.get_mut(id) else {
            return;
        };
        record.mark_left_out(side);
        if let (Kind::Input(pair), Responder::Local) = (record.kind, side) {
            let t_max = record.deadline - record.asked_at;
            self.pairs[pair].arrivals.note_given_locally(now, record.asked_at, t_max);
        }
        if let Some(payload) = record.payload.clone() {
            let channel = record.channel.clone();
            self.give(side, None, channel, payload);
        }
    }

    pub(super) fn give(&mut self, side: Responder, request: Option<RequestId>, channel: RequestChannel, payload: P) {
        self.effects.push_back(Effect::Give { side, request, channel, payload });
    }

    /// Sends the open requests to a side that has become available: calls always, inputs while they are fresh.
    pub(super) fn ask_open_requests(&mut self, now: Instant, side: Responder) {
        let is_fresh = |record: &Record<P>| !record.overdue && record.cloud != RequestLeg::LeftOut;
        let wanted = |record: &Record<P>| record.is_open() && (record.is_call() || is_fresh(record));
        for id in self.arbiter.select(wanted) {
            self.ask(now, id, side);
        }
    }

    /// Sends an overdue input to the local original if that is idle, and fast enough that a fresh input arriving
    /// meanwhile is still answered in time.
    pub(super) fn ask_straggler(&mut self, now: Instant) {
        if !self.decider.is_fed() {
            return;
        }
        let Some(id) = self.arbiter.next_straggler() else {
            return;
        };
        let Some(record) = self.arbiter.get(id).filter(|record| record.key.is_some()) else {
            return;
        };
        let t_max = record.deadline - record.asked_at;
        let quick = self.local_time.is_none_or(|time| 2 * time <= t_max);
        let busy = |record: &Record<P>| {
            record.local == RequestLeg::Asked && record.local_asked.is_some_and(|asked| now < asked + t_max)
        };
        if quick && self.arbiter.select(busy).is_empty() {
            self.ask(now, id, Responder::Local);
        }
    }
}
