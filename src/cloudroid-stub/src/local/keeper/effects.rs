//! Effects of a change of the keeper's state, applied to the link, the local original and the application in the order
//! of the decisions.

use std::sync::atomic::Ordering;
use std::time::Instant;

use bytes::Bytes;
use qos::{DecisionReason, Effect, Failure, HandOver, QosEvent, RequestChannel, RequestId, Responder};
use ros::bus::FailureReason;

use super::{Keeper, Payload, PendingAnswer, State};

impl Keeper {
    /// Changes the state and applies the effects.
    pub(super) fn change<T>(&self, change: impl FnOnce(&mut State, Instant) -> T) -> T {
        let (result, effects, over, is_stateful) = {
            let mut state = self.state.lock();
            let now = Instant::now();
            let result = change(&mut state, now);
            let effects: Vec<_> = std::iter::from_fn(|| state.governor.next_effect()).collect();
            for effect in &effects {
                if let Effect::Fail { request, reason, .. } = effect {
                    state.reply(*request, Err(FailureReason::new(reason.as_str())));
                    state.goals.fail(*request);
                }
            }
            let over = state.track_hand_over(now, &effects);
            (result, effects, over, state.is_stateful)
        };
        for effect in effects {
            self.apply_effect(effect);
        }
        match over {
            Some(over) if is_stateful => self.robot.on_hand_over(&over),
            Some(over) => self.robot.on_missed_requests(&over),
            None => {}
        }
        result
    }

    fn apply_effect(&self, effect: Effect<Payload>) {
        match effect {
            Effect::Give { side, request, channel, payload } => match (side, channel, payload, request) {
                // Both sides have received it already.
                (_, _, Payload::Input(kept), _) if kept.is_latched => {}
                (Responder::Cloud, RequestChannel::Topic(topic), Payload::Input(kept), _) => {
                    if let Some(message) = kept.message() {
                        self.cloud.publish(&topic, &message);
                    }
                }
                (Responder::Cloud, RequestChannel::Call(service), Payload::Call(bytes), Some(id)) => {
                    self.cloud.call(id, &service, bytes);
                }
                (side, _, Payload::Goal(sent), Some(id)) => self.give_goal(side, id, &sent),
                (Responder::Local, channel, payload, request) => self.give_local(&channel, payload, request),
                _ => unreachable!("calls carry requests, topics carry messages"),
            },
            Effect::Fail { reason, channel, .. } => tracing::debug!(?channel, reason, "a request failed"),
            Effect::SafeStop => {
                if let Some(stop) = &self.safe_stop {
                    self.robot.safe_stop(stop);
                }
            }
            Effect::Outcome(outcome) => self.robot.on_outcome(&outcome),
            Effect::Event(_) if self.ending.load(Ordering::Relaxed) => {}
            Effect::Event(event) => {
                match (&event, &self.original) {
                    (QosEvent::Start(_), Some(original)) => original.start(),
                    (QosEvent::Start(_), None) => return self.report_missing_original(),
                    (QosEvent::Stop(_), Some(original)) => original.stop(),
                    _ => {}
                }
                self.robot.on_decision(&event);
            }
        }
    }

    /// Makes a call to a side that is not measured.
    pub(super) fn call_side(&self, side: Responder, service: &str, bytes: Bytes) -> PendingAnswer {
        match (side, &self.original) {
            (Responder::Cloud, _) => self.cloud.call_unmeasured(service, bytes),
            (Responder::Local, Some(original)) => original.call(service, bytes),
            (Responder::Local, None) => {
                let reason = "there is no local original".to_owned();
                Box::pin(async move { Err(Failure::Unreachable(reason)) })
            }
        }
    }

    fn give_local(&self, channel: &RequestChannel, payload: Payload, request: Option<RequestId>) {
        let Some(original) = &self.original else {
            return;
        };
        match (channel, payload, request) {
            (RequestChannel::Topic(topic), Payload::Input(kept), _) => {
                if let Some(message) = kept.message() {
                    original.feed(topic, &message);
                }
            }
            (RequestChannel::Call(service), Payload::Call(bytes), Some(id)) => {
                let answer = original.call(service, bytes);
                let keeper = self.this.clone();
                tokio::spawn(async move {
                    let result = answer.await;
                    if let Some(keeper) = keeper.upgrade() {
                        keeper.on_answer(Responder::Local, id, result, None);
                    }
                });
            }
            _ => unreachable!("calls carry requests, topics carry messages"),
        }
    }
}

impl State {
    /// Records which side receives what, and returns the losses if one side takes over from the other.
    fn track_hand_over(&mut self, now: Instant, effects: &[Effect<Payload>]) -> Option<HandOver> {
        let ledger = &mut self.ledger;
        let mut to = None;
        for effect in effects {
            match effect {
                Effect::Give { payload: Payload::Input(kept), .. } if kept.is_latched => {}
                Effect::Give { side, channel: RequestChannel::Topic(name) | RequestChannel::Call(name), .. } => {
                    ledger.record_delivery(*side, name)
                }
                Effect::Event(QosEvent::Start(_) | QosEvent::Crashed(_)) => ledger.on_local_start(),
                Effect::Event(QosEvent::Feed(DecisionReason::LinkDown)) => to = Some(Responder::Local),
                Effect::Event(QosEvent::Feed(_)) if !self.is_stateful => to = Some(Responder::Local),
                Effect::Event(QosEvent::StopFeeding(DecisionReason::LinkUp)) => to = Some(Responder::Cloud),
                _ => {}
            }
        }
        // Messages of this very moment count as received before.
        let over = ledger.hand_over(now, to?)?;
        if self.is_stateful {
            self.lost = Some((now, over.to_string()));
        }
        Some(over)
    }
}
