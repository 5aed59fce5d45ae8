//! Requests reported by a robot's stub: keeps the last ones for explanations and classifies each update once.

use std::collections::{BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use link::control::RequestTiming;
use parking_lot::Mutex;

/// Number of requests kept for explanations.
const REQUESTS: usize = 128;
/// Maximum number of late requests whose answers are awaited; beyond it the oldest are forgotten.
const LATE: usize = 4096;
/// Tolerance: stubs report once a second, and the first report after a reconnection may be delayed.
const REPORT: Duration = Duration::from_secs(2);

/// An update about a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RequestUpdate {
    /// The cloud has answered it.
    Answered,
    /// The cloud has not answered it within its T_max although the link was up.
    Late,
    /// The cloud has answered a request that was reported late before.
    AnsweredLate,
}

/// A robot's request, of which something became known.
#[derive(Debug, Clone, Copy)]
pub struct MeasuredRequest<'a> {
    /// Id of the link's session.
    pub session: &'a str,
    /// Name of the node that was asked.
    pub node: &'a str,
    /// Longest response time that the robot accepts (T_max), in milliseconds.
    pub max: Option<f64>,
    /// Response time and phases as reported by the stub.
    pub timing: &'a RequestTiming,
    /// The update.
    pub update: RequestUpdate,
}

impl MeasuredRequest<'_> {
    /// Returns true if the cloud's answer took longer than the robot accepts, or never came.
    pub fn is_late(&self) -> bool {
        self.max.is_some_and(|max| self.timing.total.is_none_or(|total| total > max))
    }
}

/// The requests of one link.
#[derive(Default)]
pub(super) struct RequestLog(Mutex<State>);

#[derive(Default)]
struct State {
    last: VecDeque<RequestTiming>,
    /// Ids of requests reported late and not yet answered.
    late: BTreeSet<u64>,
    /// Time at which the current connection began.
    connected: Option<Instant>,
}

impl RequestLog {
    /// Handles a new connection of the link.
    pub(super) fn on_connected(&self, now: Instant) {
        self.0.lock().connected = Some(now);
    }

    /// Records the requests reported by the robot, which accepts answers for `max` seconds; returns those with updates.
    pub(super) fn record(
        &self,
        told: Vec<RequestTiming>,
        max: Option<f64>,
        now: Instant,
    ) -> Vec<(RequestTiming, RequestUpdate)> {
        let mut state = self.0.lock();
        // A request made before may be late because the link was down, which is not the servant's fault.
        let max = max.map_or(Ok(Duration::ZERO), Duration::try_from_secs_f64);
        let settled = max.map(|max| max.saturating_add(REPORT)).ok();
        let stood = state.connected.map(|at| now.saturating_duration_since(at));
        let stood = stood.zip(settled).is_some_and(|(stood, settled)| stood >= settled);
        let mut news = Vec::new();
        for request in told {
            news.extend(state.classify(&request, stood).map(|new| (request.clone(), new)));
            match state.last.iter_mut().find(|known| known.id == request.id) {
                Some(known) => *known = request,
                None => state.last.push_back(request),
            }
        }
        let surplus = state.last.len().saturating_sub(REQUESTS);
        state.last.drain(..surplus);
        news
    }

    /// Returns the last requests, oldest first.
    pub(super) fn last(&self) -> Vec<RequestTiming> {
        self.0.lock().last.iter().cloned().collect()
    }
}

impl State {
    fn classify(&mut self, request: &RequestTiming, stood: bool) -> Option<RequestUpdate> {
        let known = self.last.iter().find(|known| known.id == request.id);
        if request.total.is_some() {
            return match known {
                Some(known) if known.total.is_some() => None,
                _ if self.late.remove(&request.id) => Some(RequestUpdate::AnsweredLate),
                _ => Some(RequestUpdate::Answered),
            };
        }
        if known.is_some() || !stood || !self.late.insert(request.id) {
            return None;
        }
        if self.late.len() > LATE {
            self.late.pop_first();
        }
        Some(RequestUpdate::Late)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn request(id: u64, total: Option<f64>) -> RequestTiming {
        RequestTiming { id, total, ..RequestTiming::default() }
    }

    fn record_updates(requests: &RequestLog, told: &[(u64, Option<f64>)], now: Instant) -> Vec<(u64, RequestUpdate)> {
        let told = told.iter().map(|(id, total)| request(*id, *total));
        let news = requests.record(told.collect(), Some(0.3), now);
        news.into_iter().map(|(request, new)| (request.id, new)).collect()
    }

    #[test]
    fn late_requests_are_told_once_and_their_answers_too() {
        use RequestUpdate::{Answered, AnsweredLate, Late};
        let (requests, began) = (RequestLog::default(), Instant::now());
        requests.on_connected(began);
        let now = began + SECOND * 3;
        let told = [(1, Some(5.0)), (2, None), (3, None)];
        assert_eq!(record_updates(&requests, &told, now), [(1, Answered), (2, Late), (3, Late)]);
        // Meanwhile the local original's answer is used, and then the cloud's arrives.
        let told = [(1, Some(5.0)), (2, None), (3, Some(900.0))];
        assert_eq!(record_updates(&requests, &told, now), [(3, AnsweredLate)]);
        assert_eq!(record_updates(&requests, &[(3, Some(900.0))], now), []);
        assert_eq!(requests.last().len(), 3);
        // After so many others that it is no longer kept.
        let others: Vec<_> = (10..10 + 2 * REQUESTS as u64).map(|id| (id, Some(1.0))).collect();
        assert_eq!(record_updates(&requests, &others, now).len(), others.len());
        assert_eq!(record_updates(&requests, &[(2, Some(2000.0))], now), [(2, AnsweredLate)]);
    }

    #[test]
    fn requests_late_while_the_link_was_down_are_not_reported() {
        let (requests, began) = (RequestLog::default(), Instant::now());
        assert_eq!(record_updates(&requests, &[(1, None)], began), [], "nothing is connected");
        requests.on_connected(began);
        assert_eq!(record_updates(&requests, &[(2, None)], began + SECOND * 2), []);
        assert_eq!(
            record_updates(&requests, &[(2, Some(3000.0))], began + SECOND * 2),
            [(2, RequestUpdate::Answered)],
            "its time is known"
        );
        let late = record_updates(&requests, &[(3, None)], began + SECOND * 3);
        assert_eq!(late, [(3, RequestUpdate::Late)]);
        requests.on_connected(began + SECOND * 9);
        assert_eq!(record_updates(&requests, &[(4, None)], began + SECOND * 10), []);
        assert_eq!(requests.last().len(), 4, "all are shown");
        // Robots are not trusted.
        for max in [f64::NAN, -1.0, f64::INFINITY, 1e300] {
            let told = vec![request(9, None)];
            assert_eq!(requests.record(told, Some(max), began + SECOND * 99), []);
        }
    }

    #[test]
    fn a_robot_cannot_make_it_grow() {
        let (requests, began) = (RequestLog::default(), Instant::now());
        requests.on_connected(began);
        for id in 0..3 * LATE as u64 {
            record_updates(&requests, &[(id, None)], began + SECOND * 9);
        }
        let state = requests.0.lock();
        assert_eq!((state.late.len(), state.last.len()), (LATE, REQUESTS));
    }
}
