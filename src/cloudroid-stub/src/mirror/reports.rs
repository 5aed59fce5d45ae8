//! Reports on the outcome of requests: each one in the log (`CLOUDROID_LOG=info,requests=debug`), once a second to the
//! cloud (`cloudroidctl explain`) and on the robot's `/diagnostics`.

use std::collections::VecDeque;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use link::control::{Decision, FromRobot, RequestTiming};
use link::drops::Cause;
use link::record::Data;
use parking_lot::Mutex;
use qos::{DecisionReason, HandOver, Phases, QosEvent, RequestChannel, RequestOutcome, Responder};
use tokio::time::{MissedTickBehavior, interval};

use super::diagnostics::Diagnostics;
use super::state::Mirror;
use crate::local::OutputTiming;

/// Interval between reports, the usual rate of `/diagnostics`.
const PERIOD: Duration = Duration::from_secs(1);
/// Maximum number of requests that wait for the next report; while the link is down none is sent.
const WAITING: usize = 512;
/// Maximum number of decisions that wait.
const DECISIONS: usize = 32;

/// Requests that were not reported yet.
#[derive(Default)]
pub struct Reports {
    waiting: Mutex<Vec<RequestTiming>>,
    decisions: Mutex<VecDeque<(Instant, Decision)>>,
}

impl Reports {
    /// Records the outcome of a request, or adds to it.
    pub fn record_outcome(&self, outcome: &RequestOutcome) {
        let milliseconds = |time: Duration| time.as_secs_f64() * 1e3;
        let (RequestChannel::Call(name) | RequestChannel::Topic(name)) = &outcome.channel;
        let answer = outcome.answer.map(|(side, after)| (side, milliseconds(after)));
        let id = outcome.request.0;
        let stamp = outcome.stamp.map(|stamp| (stamp.secs, stamp.nsecs));
        let cloud = outcome.cloud.map(milliseconds);
        let (q, phases) = (outcome.q, outcome.phases);
        tracing::debug!(target: "requests", id, %name, ?stamp, ?answer, ?cloud, q, ?phases);
        let part = |of: fn(&Phases) -> Duration| phases.as_ref().map_or(0.0, |all| milliseconds(of(all)));
        let request = RequestTiming {
            id,
            name: name.to_string(),
            total: cloud,
            serialise: part(|phases| phases.serialise),
            up: part(|phases| phases.up),
            queue: part(|phases| phases.queue),
            compute: part(|phases| phases.compute),
            down: part(|phases| phases.down),
            local: matches!(outcome.answer, Some((Responder::Local, _))),
            satisfaction: q,
        };
        let mut waiting = self.waiting.lock();
        match waiting.iter_mut().find(|known| known.id == id) {
            Some(known) => *known = request,
            None => waiting.push(request),
        }
        let surplus = waiting.len().saturating_sub(WAITING);
        waiting.drain(..surplus);
    }
}

impl Reports {
    /// Records a decision about the local original.
    pub fn record_decision(&self, event: &QosEvent) {
        if let Some(decision) = to_decision(event) {
            self.push_decision(decision);
        }
    }

    /// Records a hand-over in which the continuing side did not receive some of the messages.
    pub fn record_hand_over(&self, over: &HandOver) {
        self.push_decision(Decision { kind: "state-lost".to_owned(), warning: true, text: over.to_string(), ago: 0.0 });
    }

    fn push_decision(&self, decision: Decision) {
        let mut decisions = self.decisions.lock();
        if decisions.len() == DECISIONS {
            decisions.pop_front();
        }
        decisions.push_back((Instant::now(), decision));
    }

    /// Returns the decisions that were not reported yet.
    fn take_decisions(&self) -> Vec<Decision> {
        let decisions = std::mem::take(&mut *self.decisions.lock());
        let told = |(at, decision): (Instant, Decision)| Decision { ago: at.elapsed().as_secs_f64(), ..decision };
        decisions.into_iter().map(told).collect()
    }
}

/// Returns the decision if it is relevant for the cloud; starts and stops of the process are internal to the robot.
fn to_decision(event: &QosEvent) -> Option<Decision> {
    let (kind, warning, text) = match event {
        QosEvent::Feed(DecisionReason::LinkDown) => {
            ("local-takes-over", true, "the local original takes over: the link is down".to_owned())
        }
        QosEvent::StopFeeding(DecisionReason::LinkUp) => {
            ("local-hands-back", false, "the local original hands back: the link is up again".to_owned())
        }
        QosEvent::Feed(DecisionReason::Satisfaction { q }) => {
            ("local-answers-too", true, format!("the local original answers, too: Q has fallen to {q:.1}"))
        }
        QosEvent::StopFeeding(DecisionReason::Satisfaction { q }) => {
            ("cloud-answers-alone", false, format!("the cloud answers alone again: Q has risen to {q:.1}"))
        }
        QosEvent::SaidOnceMissing => {
            ("local-missing", true, "there is no local original: only the cloud answers".to_owned())
        }
        QosEvent::Crashed(reason) => ("local-crashed", true, format!("the local original ended: {reason}")),
        _ => return None,
    };
    Some(Decision { kind: kind.to_owned(), warning, text, ago: 0.0 })
}

/// Reports until the node ends.
pub async fn report_loop(mirror: Weak<Mirror>, mut diagnostics: Diagnostics) {
    let mut due = interval(PERIOD);
    due.set_missed_tick_behavior(MissedTickBehavior::Delay);
    // The session of the last report, and the number of messages that it had not sent.
    let mut told = (Weak::new(), [0; 2]);
    loop {
        due.tick().await;
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        let Some(promise) = mirror.promise.get() else {
            return;
        };
        let session = mirror.session();
        if session.is_up() {
            let requests = std::mem::take(&mut *promise.reports.waiting.lock());
            if !requests.is_empty() {
                session.send_control(&FromRobot::Requests(requests));
            }
            let (of, drops) = (Arc::downgrade(&session), session.drops());
            let count = |cause| drops.iter().filter(|drop| drop.cause == cause).map(|drop| drop.count).sum();
            let unsent @ [replaced, stale] = [count(Cause::Replaced), count(Cause::Stale)];
            if !Weak::ptr_eq(&told.0, &of) {
                told = (of, [0; 2]);
            }
            if told.1 != unsent {
                told.1 = unsent;
                session.send_control(&FromRobot::Unsent { replaced, stale });
            }
            let decisions = promise.reports.take_decisions();
            if !decisions.is_empty() {
                session.send_control(&FromRobot::Decided(decisions));
            }
        }
        diagnostics.publish(&promise.keeper().report());
    }
}

fn elapsed_between(from: i64, to: i64) -> Duration {
    // The offset of two machines' clocks is not exact: a short time may come out negative.
    Duration::from_nanos(u64::try_from(to.saturating_sub(from)).unwrap_or(0))
}

/// Returns the times of an output; its phases are known only with the `offset` of the cloud's clock.
pub fn output_timing(data: &Data, arrived: i64, offset: Option<i64>) -> OutputTiming {
    OutputTiming {
        since_input: data.answered.map(|input| elapsed_between(input.born, arrived)),
        phases: offset.and_then(|offset| output_phases(data, arrived, offset)),
    }
}

/// Returns the phases of an input that an output may answer. `offset` is the cloud's clock minus the robot's, in
/// nanoseconds.
fn output_phases(data: &Data, arrived: i64, offset: i64) -> Option<Phases> {
    let input = data.answered?;
    let encoding = |microseconds: u32| Duration::from_micros(microseconds.into());
    let waited = elapsed_between(input.born, input.left).saturating_sub(encoding(input.serialise));
    let waited_there = elapsed_between(data.born, data.left).saturating_sub(encoding(data.serialise));
    Some(Phases {
        serialise: encoding(input.serialise) + encoding(data.serialise),
        up: elapsed_between(input.left, input.taken - offset),
        queue: waited + elapsed_between(input.taken, input.given) + waited_there,
        compute: elapsed_between(input.given, data.born),
        down: elapsed_between(data.left - offset, arrived),
    })
}

/// Returns the phases of a call from four times: request sent (robot's clock), received and answered (cloud's clock),
/// answer received (robot's clock). Time spent in queues counts as transfer.
pub fn call_phases([asked, taken, given, arrived]: [i64; 4], offset: i64) -> Phases {
    Phases {
        up: elapsed_between(asked, taken - offset),
        compute: elapsed_between(taken, given),
        down: elapsed_between(given - offset, arrived),
        ..Phases::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use link::record::InputTiming;

    const MS: i64 = 1_000_000;

    #[test]
    fn decisions_wait_until_they_are_told_and_the_oldest_give_way() {
        let reports = Reports::default();
        reports.record_decision(&QosEvent::Start(DecisionReason::LinkDown));
        assert_eq!(reports.take_decisions(), [], "a process is no decision");
        for number in 0..DECISIONS {
            reports.record_decision(&QosEvent::Crashed(format!("signal {number}")));
        }
        reports.record_decision(&QosEvent::Feed(DecisionReason::LinkDown));
        let told = reports.take_decisions();
        assert_eq!(told.len(), DECISIONS);
        assert!(told[0].text.ends_with("signal 1"), "{told:?}");
        assert_eq!(told[DECISIONS - 1].kind, "local-takes-over");
        assert!(told[DECISIONS - 1].warning && told[DECISIONS - 1].ago >= 0.0);
        assert_eq!(reports.take_decisions(), []);
    }

    #[test]
    fn the_parts_of_a_request_are_its_whole_by_either_clock() {
        // The cloud's clock is 10 s ahead.
        let offset = 10_000 * MS;
        let data = Data {
            channel: 1,
            encoded: false,
            latching: false,
            born: offset + 130 * MS,
            left: offset + 135 * MS,
            serialise: 2000,
            answered: Some(InputTiming {
                born: 0,
                serialise: 3000,
                left: 5 * MS,
                taken: offset + 25 * MS,
                given: offset + 26 * MS,
            }),
            message: bytes::Bytes::new(),
        };
        let phases = output_phases(&data, 140 * MS, offset).unwrap();
        let ms = Duration::from_millis;
        assert_eq!(
            phases,
            Phases { serialise: ms(5), up: ms(20), queue: ms(2 + 1 + 3), compute: ms(104), down: ms(5) }
        );
        assert_eq!(phases.total(), ms(140));
        let call = call_phases([0, offset + 2 * MS, offset + 9 * MS, 10 * MS], offset);
        assert_eq!((call.up, call.compute, call.down), (ms(2), ms(7), ms(1)));
    }
}
