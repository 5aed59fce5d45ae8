//! Carries out decisions about the local original, and handles its loss.

use std::time::Instant;

use super::{EVENTS, Effect, Governor, UNMATCHED};
use crate::decider::QosEvent;
use crate::pair::Correlation;
use crate::request::{RequestLeg, Responder};
use crate::sla::{Measure, Mode};

impl<P: Clone> Governor<P> {
    /// Handles the start of a time without a link. If the SLA has no response time, or nothing can be asked yet, the
    /// local original takes over after a delay; otherwise Q decides.
    pub(super) fn on_link_lost(&mut self, now: Instant) {
        match (&self.sla.measure, self.sla.mode) {
            (Measure::Link { after }, _) => {
                self.away_at = Some(now + *after);
                self.decider.note_late();
            }
            (_, Mode::Stateful) => self.away = true,
            (_, Mode::Stateless) if !self.reached => {
                self.away_at = Some(now + self.sla.unreached);
            }
            (_, Mode::Stateless) => {}
        }
    }

    pub(super) fn decide(&mut self, now: Instant) {
        for event in self.decider.decide(&self.satisfaction, !self.away) {
            let (feed, stop) = (matches!(event, QosEvent::Feed(_)), matches!(event, QosEvent::Stop(_)));
            self.push_event(now, event);
            if feed {
                self.ask_open_requests(now, Responder::Local);
            }
            if stop {
                self.on_local_lost(now);
            }
        }
        self.ask_straggler(now);
        for index in 0..self.pairs.len() {
            let stream = &mut self.pairs[index];
            if stream.by == Correlation::Stamp && stream.unmatched.is_some_and(|n| n >= UNMATCHED) {
                stream.by = Correlation::Arrival;
                stream.queues = Default::default();
                let input = stream.pair.input.clone();
                self.push_event(now, QosEvent::Uncorrelated(input));
            }
        }
    }

    pub(super) fn push_event(&mut self, now: Instant, event: QosEvent) {
        if self.events.len() == EVENTS {
            self.events.pop_front();
        }
        self.events.push_back((now, event.clone()));
        self.effects.push_back(Effect::Event(event));
    }

    /// Handles the loss of the local original and of its open requests; the cloud is asked for those it was not asked
    /// for before.
    pub(super) fn on_local_lost(&mut self, now: Instant) {
        let reason = RequestLeg::Failed("the local original ended".into());
        let lost = self.arbiter.replace_legs(Responder::Local, &RequestLeg::Asked, &reason);
        for stream in &mut self.pairs {
            stream.queues[Responder::Local.index()].waiting.clear();
        }
        for id in lost {
            if self.link {
                self.ask(now, id, Responder::Cloud);
            }
            self.fail_if_hopeless(id);
        }
    }
}
