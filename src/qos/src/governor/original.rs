//! The local original: what is decided of it, and what follows when it is gone.

use std::time::Instant;

use super::{EVENTS, Effect, Governor, UNMATCHED};
use crate::decider::Event;
use crate::pair::Correlation;
use crate::request::{Leg, Side};
use crate::sla::{Measure, Mode};

impl<P: Clone> Governor<P> {
    /// The link is down from now on. Where no time was promised, or nothing can be asked yet, it may come before that
    /// means anything; where one was, Q decides.
    pub(super) fn left_alone(&mut self, now: Instant) {
        match (&self.sla.measure, self.sla.mode) {
            (Measure::Link { after }, _) => {
                self.away_at = Some(now + *after);
                self.decider.late();
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
                stream.queues = Default::default();
                let input = stream.pair.input.clone();
                self.say(now, Event::Uncorrelated(input));
            }
        }
    }

    pub(super) fn say(&mut self, now: Instant, event: Event) {
        if self.events.len() == EVENTS {
            self.events.pop_front();
        }
        self.events.push_back((now, event.clone()));
        self.effects.push_back(Effect::Event(event));
    }

    /// The local original is gone with what it was asked; the cloud is asked where it was not.
    pub(super) fn local_lost(&mut self, now: Instant) {
        let reason = Leg::Failed("the local original ended".into());
        let lost = self.arbiter.turn(Side::Local, &Leg::Asked, &reason);
        for stream in &mut self.pairs {
            stream.queues[Side::Local.index()].waiting.clear();
        }
        for id in lost {
            if self.link {
                self.ask(now, id, Side::Cloud);
            }
            self.fail_if_hopeless(id);
        }
    }
}
