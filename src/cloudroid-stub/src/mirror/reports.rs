//! How requests went, for whoever wants to know: each in the log (`CLOUDROID_LOG=info,requests=debug`), once a second to the
//! cloud (`cloudroidctl explain`) and on the robot's `/diagnostics`.

use std::collections::VecDeque;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use link::control::{Decision, FromRobot, Request};
use link::record::Data;
use parking_lot::Mutex;
use qos::{Channel, Event, HandOver, Outcome, Phases, Side, Why};
use tokio::time::{MissedTickBehavior, interval};

use super::Mirror;
use super::diagnostics::Diagnostics;

/// Between reports: the usual rate of `/diagnostics`.
const PERIOD: Duration = Duration::from_secs(1);
/// Requests that wait for the next report, at most: while the link is down nobody takes them.
const WAITING: usize = 512;
/// And decisions.
const DECISIONS: usize = 32;

/// Requests that were not reported yet.
#[derive(Default)]
pub struct Reports {
    waiting: Mutex<Vec<Request>>,
    decisions: Mutex<VecDeque<(Instant, Decision)>>,
}

impl Reports {
    /// A request's outcome is known, or more of it.
    pub fn note(&self, outcome: &Outcome) {
        let milliseconds = |time: Duration| time.as_secs_f64() * 1e3;
        let (Channel::Call(name) | Channel::Topic(name)) = &outcome.channel;
        let answer = outcome
            .answer
            .map(|(side, after)| (side, milliseconds(after)));
        let id = outcome.request.0;
        let stamp = outcome.stamp.map(|stamp| (stamp.secs, stamp.nsecs));
        let cloud = outcome.cloud.map(milliseconds);
        let (q, phases) = (outcome.q, outcome.phases);
        tracing::debug!(target: "requests", id, %name, ?stamp, ?answer, ?cloud, q, ?phases);
        let part =
            |of: fn(&Phases) -> Duration| phases.as_ref().map_or(0.0, |all| milliseconds(of(all)));
        let request = Request {
            id,
            name: name.to_string(),
            total: cloud,
            serialise: part(|phases| phases.serialise),
            up: part(|phases| phases.up),
            queue: part(|phases| phases.queue),
            compute: part(|phases| phases.compute),
            down: part(|phases| phases.down),
            local: matches!(outcome.answer, Some((Side::Local, _))),
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
    /// Something was decided about the local original.
    pub fn decided(&self, event: &Event) {
        if let Some(decision) = decision(event) {
            self.tell(decision);
        }
    }

    /// One side goes on in place of the other, without some of what that was given.
    pub fn handed_over(&self, over: &HandOver) {
        self.tell(Decision {
            kind: "state-lost".to_owned(),
            warning: true,
            text: over.to_string(),
            ago: 0.0,
        });
    }

    fn tell(&self, decision: Decision) {
        let mut decisions = self.decisions.lock();
        if decisions.len() == DECISIONS {
            decisions.pop_front();
        }
        decisions.push_back((Instant::now(), decision));
    }

    /// What was decided and not told yet.
    fn take_decisions(&self) -> Vec<Decision> {
        let decisions = std::mem::take(&mut *self.decisions.lock());
        let told = |(at, decision): (Instant, Decision)| Decision {
            ago: at.elapsed().as_secs_f64(),
            ..decision
        };
        decisions.into_iter().map(told).collect()
    }
}

/// What the cloud is to know of; that a process starts or ends is the robot's own affair.
fn decision(event: &Event) -> Option<Decision> {
    let (kind, warning, text) = match event {
        Event::Feed(Why::LinkDown) => (
            "local-takes-over",
            true,
            "the local original takes over: the link is down".to_owned(),
        ),
        Event::StopFeeding(Why::LinkUp) => (
            "local-hands-back",
            false,
            "the local original hands back: the link is up again".to_owned(),
        ),
        Event::Feed(Why::Satisfaction { q }) => (
            "local-answers-too",
            true,
            format!("the local original answers, too: Q has fallen to {q:.1}"),
        ),
        Event::StopFeeding(Why::Satisfaction { q }) => (
            "cloud-answers-alone",
            false,
            format!("the cloud answers alone again: Q has risen to {q:.1}"),
        ),
        Event::SaidOnceMissing => (
            "local-missing",
            true,
            "there is no local original: the cloud is alone".to_owned(),
        ),
        Event::Crashed(reason) => (
            "local-crashed",
            true,
            format!("the local original ended: {reason}"),
        ),
        _ => return None,
    };
    Some(Decision {
        kind: kind.to_owned(),
        warning,
        text,
        ago: 0.0,
    })
}

/// Reports until the node ends.
pub async fn report(mirror: Weak<Mirror>, mut diagnostics: Diagnostics) {
    let mut due = interval(PERIOD);
    due.set_missed_tick_behavior(MissedTickBehavior::Delay);
    // Of which session, and how many messages it had not sent.
    let mut told = (Weak::new(), link::Dropped::default());
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
                session.report(&FromRobot::Requests(requests));
            }
            let (of, dropped) = (Arc::downgrade(&session), session.dropped());
            if !Weak::ptr_eq(&told.0, &of) {
                told = (of, link::Dropped::default());
            }
            if told.1 != dropped {
                told.1 = dropped;
                session.report(&FromRobot::Unsent {
                    replaced: dropped.replaced,
                    stale: dropped.stale,
                });
            }
            let decisions = promise.reports.take_decisions();
            if !decisions.is_empty() {
                session.report(&FromRobot::Decided(decisions));
            }
        }
        diagnostics.publish(&promise.keeper().report());
    }
}

fn span(from: i64, to: i64) -> Duration {
    // Clocks of two machines are not known exactly: a short way may come out as a negative one.
    Duration::from_nanos(u64::try_from(to.saturating_sub(from)).unwrap_or(0))
}

/// Where the time went of the input that an output may answer. `offset` is the cloud's clock minus the robot's,
/// nanoseconds.
pub fn of_output(data: &Data, arrived: i64, offset: i64) -> Option<Phases> {
    let input = data.answered?;
    let encoding = |microseconds: u32| Duration::from_micros(microseconds.into());
    let waited = span(input.born, input.left).saturating_sub(encoding(input.serialise));
    let waited_there = span(data.born, data.left).saturating_sub(encoding(data.serialise));
    Some(Phases {
        serialise: encoding(input.serialise) + encoding(data.serialise),
        up: span(input.left, input.taken - offset),
        queue: waited + span(input.taken, input.given) + waited_there,
        compute: span(input.given, data.born),
        down: span(data.left - offset, arrived),
    })
}

/// The same of a call: when it was asked (robot's clock), had arrived and was answered (cloud's), and its answer had
/// come (robot's). What it waited on the way counts as the way.
pub fn of_call([asked, taken, given, arrived]: [i64; 4], offset: i64) -> Phases {
    Phases {
        up: span(asked, taken - offset),
        compute: span(taken, given),
        down: span(given - offset, arrived),
        ..Phases::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use link::record::Answered;

    const MS: i64 = 1_000_000;

    #[test]
    fn decisions_wait_until_they_are_told_and_the_oldest_give_way() {
        let reports = Reports::default();
        reports.decided(&Event::Start(Why::LinkDown));
        assert_eq!(reports.take_decisions(), [], "a process is no decision");
        for number in 0..DECISIONS {
            reports.decided(&Event::Crashed(format!("signal {number}")));
        }
        reports.decided(&Event::Feed(Why::LinkDown));
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
            answered: Some(Answered {
                born: 0,
                serialise: 3000,
                left: 5 * MS,
                taken: offset + 25 * MS,
                given: offset + 26 * MS,
            }),
            message: bytes::Bytes::new(),
        };
        let phases = of_output(&data, 140 * MS, offset).unwrap();
        let ms = Duration::from_millis;
        assert_eq!(
            phases,
            Phases {
                serialise: ms(5),
                up: ms(20),
                queue: ms(2 + 1 + 3),
                compute: ms(104),
                down: ms(5),
            }
        );
        assert_eq!(phases.total(), ms(140));
        let call = of_call([0, offset + 2 * MS, offset + 9 * MS, 10 * MS], offset);
        assert_eq!((call.up, call.compute, call.down), (ms(2), ms(7), ms(1)));
    }
}
