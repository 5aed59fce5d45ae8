//! Recent response times of each servant: for decisions, and for display. (`RequestTimes` keeps histograms by service.)

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use api::ResponseTimes;
use parking_lot::Mutex;
use qos::nearest_rank;
use tokio::sync::broadcast;

use crate::decide::controller::MeasuredTimes;

/// Age up to which requests count.
const LATELY: Duration = Duration::from_secs(10);
/// Maximum number of requests remembered per servant.
const MAX_REQUESTS: usize = 256;
/// Minimum number of requests for a decision.
const MIN_REQUESTS: usize = 3;

/// Capacity of a subscription; a slower subscriber loses the oldest.
const UNHEARD: usize = 1024;

/// Recent requests by servant.
pub(crate) struct RecentRequests {
    by_servant: Mutex<HashMap<String, VecDeque<RecentRequest>>>,
    told: broadcast::Sender<AnsweredRequest>,
}

/// An answered request of a robot.
#[derive(Debug, Clone, PartialEq)]
pub struct AnsweredRequest {
    /// Id of the servant that answered.
    pub servant: Arc<str>,
    /// Response time in milliseconds.
    pub total: f64,
}

impl Default for RecentRequests {
    fn default() -> Self {
        Self { by_servant: Mutex::default(), told: broadcast::Sender::new(UNHEARD) }
    }
}

#[derive(Clone, Copy)]
struct RecentRequest {
    asked: Instant,
    known: Instant,
    total: f64,
    cloud: f64,
}

impl RecentRequests {
    /// Subscribes to answered requests.
    pub(crate) fn subscribe(&self) -> broadcast::Receiver<AnsweredRequest> {
        self.told.subscribe()
    }

    /// Records that this servant answered a request after `total` milliseconds, of which `cloud` were spent in the
    /// cloud.
    pub(crate) fn record(&self, servant: &str, total: f64, cloud: f64, now: Instant) {
        // Robots are not trusted.
        let sane = |milliseconds: f64| milliseconds.is_finite() && milliseconds >= 0.0;
        if !sane(total) {
            return;
        }
        if self.told.receiver_count() > 0 {
            let servant = Arc::from(servant);
            let _ = self.told.send(AnsweredRequest { servant, total });
        }
        let cloud = if sane(cloud) { cloud.min(total) } else { 0.0 };
        let mut all = self.by_servant.lock();
        let took = match all.get_mut(servant) {
            Some(known) => known,
            None => all.entry(servant.to_owned()).or_default(),
        };
        if took.len() >= MAX_REQUESTS {
            took.pop_front();
        }
        let age = Duration::try_from_secs_f64(total / 1e3).ok();
        took.push_back(RecentRequest {
            asked: age.and_then(|age| now.checked_sub(age)).unwrap_or(now),
            known: now,
            total,
            cloud,
        });
    }

    /// Returns the recent 95th percentiles of this servant; `None` if too few requests are known.
    pub(crate) fn p95(&self, servant: &str, now: Instant) -> Option<MeasuredTimes> {
        self.p95_times(servant, None, now)
    }

    /// Returns the percentiles of requests sent after `since`; of all recent ones, if these are too few.
    pub(crate) fn p95_since(&self, servant: &str, since: Option<Instant>, now: Instant) -> Option<MeasuredTimes> {
        let measured = self.p95_times(servant, since, now);
        measured.or_else(|| self.p95(servant, now))
    }

    fn p95_times(&self, servant: &str, since: Option<Instant>, now: Instant) -> Option<MeasuredTimes> {
        let (total, cloud) = self.times(servant, since, now)?;
        if total.len() < MIN_REQUESTS {
            return None;
        }
        Some(MeasuredTimes { total: nearest_rank(&total, 95)?, cloud: nearest_rank(&cloud, 95)? })
    }

    /// Returns the recent response times for display; `None` if nothing is known.
    pub(crate) fn response_times(&self, servant: &str, now: Instant) -> Option<ResponseTimes> {
        let (total, _) = self.times(servant, None, now)?;
        Some(ResponseTimes {
            requests: total.len(),
            p50_ms: nearest_rank(&total, 50)?,
            p95_ms: nearest_rank(&total, 95)?,
        })
    }

    /// Returns the recent response times of requests sent after `since`, and the parts in the cloud; each in ascending
    /// order.
    fn times(&self, servant: &str, since: Option<Instant>, now: Instant) -> Option<(Vec<f64>, Vec<f64>)> {
        let mut all = self.by_servant.lock();
        let took = all.get_mut(servant)?;
        took.retain(|one| now.saturating_duration_since(one.known) < LATELY);
        let counts = |one: &&RecentRequest| since.is_none_or(|since| one.asked >= since);
        let sorted = |of: fn(&RecentRequest) -> f64| {
            let mut times: Vec<f64> = took.iter().filter(counts).map(of).collect();
            times.sort_unstable_by(f64::total_cmp);
            times
        };
        Some((sorted(|one| one.total), sorted(|one| one.cloud)))
    }

    /// Forgets servants for which `lives` returns false.
    pub(crate) fn retain(&self, lives: impl Fn(&str) -> bool) {
        self.by_servant.lock().retain(|id, _| lives(id));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_lately_counts_and_nonsense_does_not() {
        let began = Instant::now();
        let recent = RecentRequests::default();
        for total in [9000.0, 9000.0, 9000.0] {
            recent.record("a", total, 1.0, began);
        }
        let now = began + LATELY;
        for total in 1..=20 {
            recent.record("a", f64::from(total), f64::from(total) / 2.0, now);
        }
        for nonsense in [f64::NAN, f64::INFINITY, -1.0] {
            recent.record("a", nonsense, 1.0, now);
        }
        let measured = MeasuredTimes { total: 19.0, cloud: 9.5 };
        assert_eq!(recent.p95("a", now), Some(measured));
        let shown = ResponseTimes { requests: 20, p50_ms: 10.0, p95_ms: 19.0 };
        assert_eq!(recent.response_times("a", now), Some(shown));
        // The time in the cloud is at most the total.
        for _ in 0..MIN_REQUESTS {
            recent.record("b", 5.0, f64::INFINITY, now);
            recent.record("c", 5.0, 70.0, now);
        }
        assert_eq!(recent.p95("b", now).map(|it| it.cloud), Some(0.0));
        assert_eq!(recent.p95("c", now).map(|it| it.cloud), Some(5.0));
        // One is enough for display, and too few for a decision.
        recent.record("d", 5.0, 5.0, now);
        assert_eq!(recent.p95("d", now), None);
        assert_eq!(recent.response_times("d", now).map(|it| it.requests), Some(1));
        assert_eq!(recent.p95("a", now + LATELY), None);
        assert_eq!(recent.response_times("a", now + LATELY), None);
        recent.retain(|id| id == "c");
        assert_eq!((recent.p95("b", now), recent.p95("c", now).is_some()), (None, true));
    }

    #[test]
    fn what_was_asked_before_does_not_count_once_enough_was_asked_since() {
        let began = Instant::now();
        let recent = RecentRequests::default();
        for _ in 0..20 {
            recent.record("a", 500.0, 1.0, began);
        }
        let raised = began + Duration::from_secs(2);
        let later = raised + Duration::from_secs(2);
        let since = |since| recent.p95_since("a", since, later).map(|it| it.total);
        // The first was sent before, although it is answered afterwards.
        for total in [1500.0, 40.0, 30.0] {
            recent.record("a", total, 1.0, raised + Duration::from_secs(1));
        }
        assert_eq!(since(Some(raised)), Some(500.0), "two are too few");
        recent.record("a", 20.0, 1.0, later);
        assert_eq!(since(Some(raised)), Some(40.0));
        assert_eq!(since(None), Some(500.0));
        assert_eq!(recent.p95_since("b", None, later), None);
    }

    #[test]
    fn robots_cannot_make_it_grow() {
        let recent = RecentRequests::default();
        let now = Instant::now();
        for _ in 0..10 * MAX_REQUESTS {
            recent.record("a", 1.0, 1.0, now);
        }
        assert_eq!(recent.by_servant.lock()["a"].len(), MAX_REQUESTS);
    }
}
