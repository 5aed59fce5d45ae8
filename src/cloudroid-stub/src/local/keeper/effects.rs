//! What follows from a change of the keeper's state: carried out on the link, the local original and the application, in the order in which it
//! was decided.

use std::sync::atomic::Ordering;
use std::time::Instant;

use bytes::Bytes;
use qos::{Channel, Effect, Event, Failure, HandOver, RequestId, Side, Why};

use super::{Answer, Keeper, Payload, State};

impl Keeper {
    /// Changes the state, and does what follows.
    pub(super) fn change<T>(&self, change: impl FnOnce(&mut State, Instant) -> T) -> T {
        let (result, effects, over, is_stateful) = {
            let mut state = self.state.lock();
            let now = Instant::now();
            let result = change(&mut state, now);
            let effects: Vec<_> = std::iter::from_fn(|| state.governor.next_effect()).collect();
            for effect in &effects {
                if let Effect::Fail {
                    request, reason, ..
                } = effect
                {
                    state.reply(*request, Err(reason.clone()));
                    state.goals.fail(*request);
                }
            }
            let over = state.hands_over(now, &effects);
            (result, effects, over, state.is_stateful)
        };
        for effect in effects {
            self.carry_out(effect);
        }
        match over {
            Some(over) if is_stateful => self.robot.handed_over(&over),
            Some(over) => self.robot.lacks(&over),
            None => {}
        }
        result
    }

    fn carry_out(&self, effect: Effect<Payload>) {
        match effect {
            Effect::Give {
                side,
                request,
                channel,
                payload,
            } => match (side, channel, payload, request) {
                // Both have it since it came.
                (_, _, Payload::Input(kept), _) if kept.is_latched => {}
                (Side::Cloud, Channel::Topic(topic), Payload::Input(kept), _) => {
                    if let Some(message) = kept.message() {
                        self.cloud.publish(&topic, &message);
                    }
                }
                (Side::Cloud, Channel::Call(service), Payload::Call(bytes), Some(id)) => {
                    self.cloud.call(id, &service, bytes);
                }
                (side, _, Payload::Goal(sent), Some(id)) => self.give_goal(side, id, &sent),
                (Side::Local, channel, payload, request) => {
                    self.give_local(&channel, payload, request)
                }
                _ => unreachable!("calls carry requests, topics carry messages"),
            },
            Effect::Fail {
                reason, channel, ..
            } => tracing::debug!(?channel, reason, "a request failed"),
            Effect::SafeStop => {
                if let Some(stop) = &self.safe_stop {
                    self.robot.safe_stop(stop);
                }
            }
            Effect::Outcome(outcome) => self.robot.told(&outcome),
            Effect::Event(_) if self.ending.load(Ordering::Relaxed) => {}
            Effect::Event(event) => {
                match (&event, &self.original) {
                    (Event::Start(_), Some(original)) => original.start(),
                    (Event::Start(_), None) => return self.missing(),
                    (Event::Stop(_), Some(original)) => original.stop(),
                    _ => {}
                }
                self.robot.decided(&event);
            }
        }
    }

    /// Calls a side, which is not measured.
    pub(super) fn ask(&self, side: Side, service: &str, bytes: Bytes) -> Answer {
        match (side, &self.original) {
            (Side::Cloud, _) => self.cloud.ask(service, bytes),
            (Side::Local, Some(original)) => original.call(service, bytes),
            (Side::Local, None) => {
                let reason = "there is no local original".to_owned();
                Box::pin(async move { Err(Failure::Unreachable(reason)) })
            }
        }
    }

    fn give_local(&self, channel: &Channel, payload: Payload, request: Option<RequestId>) {
        let Some(original) = &self.original else {
            return;
        };
        match (channel, payload, request) {
            (Channel::Topic(topic), Payload::Input(kept), _) => {
                if let Some(message) = kept.message() {
                    original.feed(topic, &message);
                }
            }
            (Channel::Call(service), Payload::Call(bytes), Some(id)) => {
                let answer = original.call(service, bytes);
                let keeper = self.this.clone();
                tokio::spawn(async move {
                    let result = answer.await;
                    if let Some(keeper) = keeper.upgrade() {
                        keeper.answered(Side::Local, id, result, None);
                    }
                });
            }
            _ => unreachable!("calls carry requests, topics carry messages"),
        }
    }
}

impl State {
    /// Notes who is given what, and tells what is lost where one side goes on in place of the other.
    fn hands_over(&mut self, now: Instant, effects: &[Effect<Payload>]) -> Option<HandOver> {
        let ledger = &mut self.ledger;
        let mut to = None;
        for effect in effects {
            match effect {
                Effect::Give {
                    payload: Payload::Input(kept),
                    ..
                } if kept.is_latched => {}
                Effect::Give {
                    side,
                    channel: Channel::Topic(name) | Channel::Call(name),
                    ..
                } => ledger.given(*side, name),
                Effect::Event(Event::Start(_) | Event::Crashed(_)) => ledger.original_begins(),
                Effect::Event(Event::Feed(Why::LinkDown)) => to = Some(Side::Local),
                Effect::Event(Event::Feed(_)) if !self.is_stateful => to = Some(Side::Local),
                Effect::Event(Event::StopFeeding(Why::LinkUp)) => to = Some(Side::Cloud),
                _ => {}
            }
        }
        // All that was given at this moment counts as given before.
        let over = ledger.hands_over(now, to?)?;
        if self.is_stateful {
            self.lost = Some((now, over.to_string()));
        }
        Some(over)
    }
}
