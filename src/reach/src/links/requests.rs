//! What a robot's stub tells of its requests: the last ones are kept for whoever explains, and each is counted once.

use std::collections::{BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use link::control::Request;
use parking_lot::Mutex;

/// Requests remembered, for whoever explains.
const REQUESTS: usize = 128;
/// Late requests whose answers are awaited at most; of more the oldest are forgotten.
const LATE: usize = 4096;
/// Stubs tell once a second; the first report after a connection may be one of these late.
const REPORT: Duration = Duration::from_secs(2);

/// What is new of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RequestNews {
    /// The cloud has answered it.
    Answered,
    /// The cloud has not answered it within its T_max, although the link stood.
    Late,
    /// The cloud has answered one of which it was told before that it was late.
    AnsweredLate,
}

/// The requests of one link.
#[derive(Default)]
pub(super) struct Requests(Mutex<State>);

#[derive(Default)]
struct State {
    last: VecDeque<Request>,
    /// Ids of requests of which it was told that they are late, and not that they were answered.
    late: BTreeSet<u64>,
    /// Since when the connection is there that carries the link.
    connected: Option<Instant>,
}

impl Requests {
    /// A connection carries the link from now on.
    pub(super) fn connected(&self, now: Instant) {
        self.0.lock().connected = Some(now);
    }

    /// Notes what the robot told of requests, whose answers it accepts for `max` seconds; each with what is new of it.
    pub(super) fn note(
        &self,
        told: Vec<Request>,
        max: Option<f64>,
        now: Instant,
    ) -> Vec<(Request, RequestNews)> {
        let mut state = self.0.lock();
        // What was asked before may be late since there was no link, which is not the servant's fault.
        let max = max.map_or(Ok(Duration::ZERO), Duration::try_from_secs_f64);
        let settled = max.map(|max| max.saturating_add(REPORT)).ok();
        let stood = state.connected.map(|at| now.saturating_duration_since(at));
        let stood = stood
            .zip(settled)
            .is_some_and(|(stood, settled)| stood >= settled);
        let mut news = Vec::new();
        for request in told {
            news.extend(
                state
                    .news(&request, stood)
                    .map(|new| (request.clone(), new)),
            );
            match state.last.iter_mut().find(|known| known.id == request.id) {
                Some(known) => *known = request,
                None => state.last.push_back(request),
            }
        }
        let surplus = state.last.len().saturating_sub(REQUESTS);
        state.last.drain(..surplus);
        news
    }

    /// The last ones, the oldest first.
    pub(super) fn last(&self) -> Vec<Request> {
        self.0.lock().last.iter().cloned().collect()
    }
}

impl State {
    fn news(&mut self, request: &Request, stood: bool) -> Option<RequestNews> {
        let known = self.last.iter().find(|known| known.id == request.id);
        if request.total.is_some() {
            return match known {
                Some(known) if known.total.is_some() => None,
                _ if self.late.remove(&request.id) => Some(RequestNews::AnsweredLate),
                _ => Some(RequestNews::Answered),
            };
        }
        if known.is_some() || !stood || !self.late.insert(request.id) {
            return None;
        }
        if self.late.len() > LATE {
            self.late.pop_first();
        }
        Some(RequestNews::Late)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn request(id: u64, total: Option<f64>) -> Request {
        Request {
            id,
            total,
            ..Request::default()
        }
    }

    fn news(
        requests: &Requests,
        told: &[(u64, Option<f64>)],
        now: Instant,
    ) -> Vec<(u64, RequestNews)> {
        let told = told.iter().map(|(id, total)| request(*id, *total));
        let news = requests.note(told.collect(), Some(0.3), now);
        news.into_iter()
            .map(|(request, new)| (request.id, new))
            .collect()
    }

    #[test]
    fn late_requests_are_told_once_and_their_answers_too() {
        use RequestNews::{Answered, AnsweredLate, Late};
        let (requests, began) = (Requests::default(), Instant::now());
        requests.connected(began);
        let now = began + SECOND * 3;
        let told = [(1, Some(5.0)), (2, None), (3, None)];
        assert_eq!(
            news(&requests, &told, now),
            [(1, Answered), (2, Late), (3, Late)]
        );
        // The local original's answer is taken meanwhile, and the cloud's comes after all.
        let told = [(1, Some(5.0)), (2, None), (3, Some(900.0))];
        assert_eq!(news(&requests, &told, now), [(3, AnsweredLate)]);
        assert_eq!(news(&requests, &[(3, Some(900.0))], now), []);
        assert_eq!(requests.last().len(), 3);
        // After so many others that it is not shown any more.
        let others: Vec<_> = (10..10 + 2 * REQUESTS as u64)
            .map(|id| (id, Some(1.0)))
            .collect();
        assert_eq!(news(&requests, &others, now).len(), others.len());
        assert_eq!(
            news(&requests, &[(2, Some(2000.0))], now),
            [(2, AnsweredLate)]
        );
    }

    #[test]
    fn what_is_late_for_want_of_a_link_is_not_told() {
        let (requests, began) = (Requests::default(), Instant::now());
        assert_eq!(
            news(&requests, &[(1, None)], began),
            [],
            "nothing is connected"
        );
        requests.connected(began);
        assert_eq!(news(&requests, &[(2, None)], began + SECOND * 2), []);
        assert_eq!(
            news(&requests, &[(2, Some(3000.0))], began + SECOND * 2),
            [(2, RequestNews::Answered)],
            "its time is known"
        );
        let late = news(&requests, &[(3, None)], began + SECOND * 3);
        assert_eq!(late, [(3, RequestNews::Late)]);
        requests.connected(began + SECOND * 9);
        assert_eq!(news(&requests, &[(4, None)], began + SECOND * 10), []);
        assert_eq!(requests.last().len(), 4, "all are shown");
        // Robots are not to be trusted.
        for max in [f64::NAN, -1.0, f64::INFINITY, 1e300] {
            let told = vec![request(9, None)];
            assert_eq!(requests.note(told, Some(max), began + SECOND * 99), []);
        }
    }

    #[test]
    fn a_robot_cannot_make_it_grow() {
        let (requests, began) = (Requests::default(), Instant::now());
        requests.connected(began);
        for id in 0..3 * LATE as u64 {
            news(&requests, &[(id, None)], began + SECOND * 9);
        }
        let state = requests.0.lock();
        assert_eq!((state.late.len(), state.last.len()), (LATE, REQUESTS));
    }
}
