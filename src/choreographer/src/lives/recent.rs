//! What requests of each servant took lately: for decisions, and to be shown beside the servant. (`RequestTimes` keeps histograms
//! of a service.)

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use api::ResponseTimes;
use parking_lot::Mutex;
use qos::nearest_rank;
use tokio::sync::broadcast;

use crate::decide::controller::Measured;

/// Requests that count: those that became known within this time.
const LATELY: Duration = Duration::from_secs(10);
/// Requests of one servant that are remembered at most.
const MOST: usize = 256;
/// Requests that a decision needs at least.
const LEAST: usize = 3;

/// Requests that whoever listens to them may be behind; beyond, the oldest are not told.
const UNHEARD: usize = 1024;

/// By servant.
pub(crate) struct Recent {
    by_servant: Mutex<HashMap<String, VecDeque<Took>>>,
    told: broadcast::Sender<Answered>,
}

/// A robot's request was answered.
#[derive(Debug, Clone, PartialEq)]
pub struct Answered {
    /// By the servant of this id.
    pub servant: Arc<str>,
    /// After so many milliseconds.
    pub total: f64,
}

impl Default for Recent {
    fn default() -> Self {
        Self {
            by_servant: Mutex::default(),
            told: broadcast::Sender::new(UNHEARD),
        }
    }
}

#[derive(Clone, Copy)]
struct Took {
    asked: Instant,
    known: Instant,
    total: f64,
    cloud: f64,
}

impl Recent {
    /// Requests that are answered from now on.
    pub(crate) fn answered(&self) -> broadcast::Receiver<Answered> {
        self.told.subscribe()
    }

    /// A request of this servant was answered after so many milliseconds, of which it was so many in the cloud.
    pub(crate) fn note(&self, servant: &str, total: f64, cloud: f64, now: Instant) {
        // Robots are not to be trusted.
        let sane = |milliseconds: f64| milliseconds.is_finite() && milliseconds >= 0.0;
        if !sane(total) {
            return;
        }
        if self.told.receiver_count() > 0 {
            let servant = Arc::from(servant);
            let _ = self.told.send(Answered { servant, total });
        }
        let cloud = if sane(cloud) { cloud.min(total) } else { 0.0 };
        let mut all = self.by_servant.lock();
        let took = match all.get_mut(servant) {
            Some(known) => known,
            None => all.entry(servant.to_owned()).or_default(),
        };
        if took.len() >= MOST {
            took.pop_front();
        }
        let age = Duration::try_from_secs_f64(total / 1e3).ok();
        took.push_back(Took {
            asked: age.and_then(|age| now.checked_sub(age)).unwrap_or(now),
            known: now,
            total,
            cloud,
        });
    }

    /// What 19 of 20 requests of this servant did not exceed lately; none where too few are known.
    pub(crate) fn of(&self, servant: &str, now: Instant) -> Option<Measured> {
        self.measured(servant, None, now)
    }

    /// The same of those that were asked since then; of all lately, where these are too few.
    pub(crate) fn since(
        &self,
        servant: &str,
        since: Option<Instant>,
        now: Instant,
    ) -> Option<Measured> {
        let measured = self.measured(servant, since, now);
        measured.or_else(|| self.of(servant, now))
    }

    fn measured(&self, servant: &str, since: Option<Instant>, now: Instant) -> Option<Measured> {
        let (total, cloud) = self.times(servant, since, now)?;
        if total.len() < LEAST {
            return None;
        }
        Some(Measured {
            total: nearest_rank(&total, 95)?,
            cloud: nearest_rank(&cloud, 95)?,
        })
    }

    /// The same to be shown; none where nothing is known.
    pub(crate) fn shown(&self, servant: &str, now: Instant) -> Option<ResponseTimes> {
        let (total, _) = self.times(servant, None, now)?;
        Some(ResponseTimes {
            requests: total.len(),
            p50_ms: nearest_rank(&total, 50)?,
            p95_ms: nearest_rank(&total, 95)?,
        })
    }

    /// What requests took lately that were asked `since` then, and of that in the cloud; each in ascending order.
    fn times(
        &self,
        servant: &str,
        since: Option<Instant>,
        now: Instant,
    ) -> Option<(Vec<f64>, Vec<f64>)> {
        let mut all = self.by_servant.lock();
        let took = all.get_mut(servant)?;
        took.retain(|one| now.saturating_duration_since(one.known) < LATELY);
        let counts = |one: &&Took| since.is_none_or(|since| one.asked >= since);
        let sorted = |of: fn(&Took) -> f64| {
            let mut times: Vec<f64> = took.iter().filter(counts).map(of).collect();
            times.sort_unstable_by(f64::total_cmp);
            times
        };
        Some((sorted(|one| one.total), sorted(|one| one.cloud)))
    }

    /// Forgets servants that are gone.
    pub(crate) fn keep(&self, lives: impl Fn(&str) -> bool) {
        self.by_servant.lock().retain(|id, _| lives(id));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_lately_counts_and_nonsense_does_not() {
        let began = Instant::now();
        let recent = Recent::default();
        for total in [9000.0, 9000.0, 9000.0] {
            recent.note("a", total, 1.0, began);
        }
        let now = began + LATELY;
        for total in 1..=20 {
            recent.note("a", f64::from(total), f64::from(total) / 2.0, now);
        }
        for nonsense in [f64::NAN, f64::INFINITY, -1.0] {
            recent.note("a", nonsense, 1.0, now);
        }
        let measured = Measured {
            total: 19.0,
            cloud: 9.5,
        };
        assert_eq!(recent.of("a", now), Some(measured));
        let shown = ResponseTimes {
            requests: 20,
            p50_ms: 10.0,
            p95_ms: 19.0,
        };
        assert_eq!(recent.shown("a", now), Some(shown));
        // It cannot have been longer in the cloud than it took.
        for _ in 0..LEAST {
            recent.note("b", 5.0, f64::INFINITY, now);
            recent.note("c", 5.0, 70.0, now);
        }
        assert_eq!(recent.of("b", now).map(|it| it.cloud), Some(0.0));
        assert_eq!(recent.of("c", now).map(|it| it.cloud), Some(5.0));
        // One is enough to be shown, and too few to decide upon.
        recent.note("d", 5.0, 5.0, now);
        assert_eq!(recent.of("d", now), None);
        assert_eq!(recent.shown("d", now).map(|it| it.requests), Some(1));
        assert_eq!(recent.of("a", now + LATELY), None);
        assert_eq!(recent.shown("a", now + LATELY), None);
        recent.keep(|id| id == "c");
        assert_eq!(
            (recent.of("b", now), recent.of("c", now).is_some()),
            (None, true)
        );
    }

    #[test]
    fn what_was_asked_before_does_not_count_once_enough_was_asked_since() {
        let began = Instant::now();
        let recent = Recent::default();
        for _ in 0..20 {
            recent.note("a", 500.0, 1.0, began);
        }
        let raised = began + Duration::from_secs(2);
        let later = raised + Duration::from_secs(2);
        let since = |since| recent.since("a", since, later).map(|it| it.total);
        // The first was asked before, although it is answered after it.
        for total in [1500.0, 40.0, 30.0] {
            recent.note("a", total, 1.0, raised + Duration::from_secs(1));
        }
        assert_eq!(since(Some(raised)), Some(500.0), "two are too few");
        recent.note("a", 20.0, 1.0, later);
        assert_eq!(since(Some(raised)), Some(40.0));
        assert_eq!(since(None), Some(500.0));
        assert_eq!(recent.since("b", None, later), None);
    }

    #[test]
    fn robots_cannot_make_it_grow() {
        let recent = Recent::default();
        let now = Instant::now();
        for _ in 0..10 * MOST {
            recent.note("a", 1.0, 1.0, now);
        }
        assert_eq!(recent.by_servant.lock()["a"].len(), MOST);
    }
}
