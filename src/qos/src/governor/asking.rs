//! Who is asked.

use std::time::Instant;

use super::{Channel, Effect, Governor};
use crate::arbiter::{Kind, Record};
use crate::request::{Leg, RequestId, Side};

impl<P: Clone> Governor<P> {
    /// A request was opened: ask whom there is.
    pub(super) fn asked(&mut self, now: Instant, id: RequestId) {
        self.counts.requests += 1;
        let sides = self.asked_sides();
        for side in &sides {
            self.ask(now, id, *side);
        }
        let waits = |record: &Record<P>| !record.is_call();
        if sides.is_empty() && self.arbiter.get(id).is_some_and(waits) {
            // The way to the cloud keeps it in order with what awaits no answer. A call waits here: it may fail before the
            // link is back, and must not be done then.
            self.ask(now, id, Side::Cloud);
            self.arbiter.turn(Side::Cloud, &Leg::Asked, &Leg::Lost);
        }
        self.decide(now);
    }

    pub(super) fn asked_sides(&self) -> Vec<Side> {
        let sides = self.sides();
        let asked = [(sides.cloud, Side::Cloud), (sides.local, Side::Local)];
        asked
            .into_iter()
            .filter(|(asked, _)| *asked)
            .map(|(_, side)| side)
            .collect()
    }

    /// Who is given what awaits no answer. While the link is down and nobody stands in, the way to the cloud takes it.
    pub(super) fn told_sides(&self) -> Vec<Side> {
        let sides = self.asked_sides();
        if sides.is_empty() {
            return vec![Side::Cloud];
        }
        sides
    }

    pub(super) fn ask(&mut self, now: Instant, id: RequestId, side: Side) {
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

    pub(super) fn channel(&self, kind: &Kind) -> Channel {
        match kind {
            Kind::Call(name) | Kind::Goal(name) => Channel::Call(name.clone()),
            Kind::Input { pair, .. } => Channel::Topic(self.pairs[*pair].input.clone()),
        }
    }

    /// Who can answer now is asked for what still waits: calls always, inputs while they are fresh.
    pub(super) fn give_waiting(&mut self, now: Instant, side: Side) {
        let wanted = |record: &Record<P>| record.is_open() && (record.is_call() || !record.overdue);
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
}
