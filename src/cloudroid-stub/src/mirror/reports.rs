//! How requests went, for whoever wants to know: each in the log (`CLOUDROID_LOG=info,requests=debug`), once a second to the
//! cloud (`cloudroidctl explain`) and on the robot's `/diagnostics`.

use std::sync::Weak;
use std::time::Duration;

use link::control::{Control, Request};
use link::record::Data;
use parking_lot::Mutex;
use qos::{Channel, Outcome, Phases, Side};
use tokio::time::{MissedTickBehavior, interval};

use super::Mirror;
use super::diagnostics::Diagnostics;

/// Between reports: the usual rate of `/diagnostics`.
const PERIOD: Duration = Duration::from_secs(1);
/// Requests that wait for the next report, at most: while the link is down nobody takes them.
const WAITING: usize = 512;

/// Requests that were not reported yet.
#[derive(Default)]
pub struct Reports {
    waiting: Mutex<Vec<Request>>,
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

/// Reports until the node ends.
pub async fn tell(mirror: Weak<Mirror>, mut diagnostics: Diagnostics) {
    let mut due = interval(PERIOD);
    due.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        due.tick().await;
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        let Some(promise) = mirror.promise.get() else {
            return;
        };
        let session = mirror.session();
        if *session.up().borrow() {
            let requests = std::mem::take(&mut *promise.reports.waiting.lock());
            if !requests.is_empty() {
                session.tell(&Control::Requests(requests));
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
