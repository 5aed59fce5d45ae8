//! What requests of each servant took lately, as its robot tells it: for decisions, where `RequestTimes` keeps histograms for people.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use link::control::Request;
use parking_lot::Mutex;

use crate::decide::controller::Measured;

/// Requests that count: those that became known within this time, …
const LATELY: Duration = Duration::from_secs(10);
/// … and no more than so many of them; …
const MOST: usize = 256;
/// … with fewer nothing is said.
const LEAST: usize = 3;

/// By servant.
#[derive(Default)]
pub(crate) struct Recent {
    by_servant: Mutex<HashMap<String, VecDeque<Took>>>,
}

#[derive(Clone, Copy)]
struct Took {
    known: Instant,
    total: f64,
    cloud: f64,
}

impl Recent {
    /// A request of this servant was answered.
    pub(crate) fn note(&self, servant: &str, request: &Request, now: Instant) {
        let sane = |milliseconds: f64| milliseconds.is_finite() && milliseconds >= 0.0;
        let Some(total) = request.total.filter(|total| sane(*total)) else {
            return;
        };
        // Robots are not to be trusted.
        let cloud = request.queue + request.compute;
        let cloud = if sane(cloud) { cloud.min(total) } else { 0.0 };
        let mut all = self.by_servant.lock();
        let took = match all.get_mut(servant) {
            Some(known) => known,
            None => all.entry(servant.to_owned()).or_default(),
        };
        if took.len() >= MOST {
            took.pop_front();
        }
        took.push_back(Took {
            known: now,
            total,
            cloud,
        });
    }

    /// What 19 of 20 requests of this servant did not exceed lately; none where too few are known.
    pub(crate) fn of(&self, servant: &str, now: Instant) -> Option<Measured> {
        let mut all = self.by_servant.lock();
        let took = all.get_mut(servant)?;
        took.retain(|one| now.saturating_duration_since(one.known) < LATELY);
        if took.len() < LEAST {
            return None;
        }
        let most = |of: fn(&Took) -> f64| {
            let mut times: Vec<f64> = took.iter().map(of).collect();
            times.sort_unstable_by(f64::total_cmp);
            times[(times.len() * 19).div_ceil(20) - 1]
        };
        Some(Measured {
            total: most(|one| one.total),
            cloud: most(|one| one.cloud),
        })
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
        let request = |total: f64, compute: f64| Request {
            total: Some(total),
            compute,
            ..Request::default()
        };
        for total in [9000.0, 9000.0, 9000.0] {
            recent.note("a", &request(total, 1.0), began);
        }
        let now = began + LATELY;
        for total in 1..=20 {
            recent.note("a", &request(f64::from(total), f64::from(total) / 2.0), now);
        }
        recent.note("a", &request(f64::NAN, 1.0), now);
        recent.note("a", &request(-1.0, 1.0), now);
        recent.note("a", &Request::default(), now);
        let measured = Measured {
            total: 19.0,
            cloud: 9.5,
        };
        assert_eq!(recent.of("a", now), Some(measured));
        // It cannot have been longer in the cloud than it took.
        for _ in 0..LEAST {
            recent.note("b", &request(5.0, f64::INFINITY), now);
            recent.note("c", &request(5.0, 70.0), now);
        }
        assert_eq!(recent.of("b", now).map(|it| it.cloud), Some(0.0));
        assert_eq!(recent.of("c", now).map(|it| it.cloud), Some(5.0));
        assert_eq!(recent.of("a", now + LATELY), None);
        recent.keep(|id| id == "c");
        assert_eq!(
            (recent.of("b", now), recent.of("c", now).is_some()),
            (None, true)
        );
    }

    #[test]
    fn robots_cannot_make_it_grow() {
        let recent = Recent::default();
        let now = Instant::now();
        let request = Request {
            total: Some(1.0),
            ..Request::default()
        };
        for _ in 0..10 * MOST {
            recent.note("a", &request, now);
        }
        assert_eq!(recent.by_servant.lock()["a"].len(), MOST);
    }
}
