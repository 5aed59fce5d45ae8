//! Limits the reporting of refusals: a robot that asks again and again, or under ever new names, does not fill the
//! journal.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

/// Length of a window.
const WINDOW: Duration = Duration::from_secs(60);
/// Maximum number of robots of a service reported in one window, each once.
const ROBOTS: usize = 20;
/// Maximum number of services remembered.
const SERVICES: usize = 1000;

/// Recently reported refusals.
#[derive(Debug, Default)]
pub struct RefusalLog {
    services: BTreeMap<String, Window>,
}

#[derive(Debug)]
struct Window {
    began: Instant,
    robots: BTreeSet<String>,
    left_out: u64,
}

impl RefusalLog {
    /// Records the refusal of a robot; returns the number of unreported refusals before it if this one is to be
    /// reported.
    pub fn record_refusal(&mut self, service: &str, robot: &str, now: Instant) -> Option<u64> {
        let over = |window: &Window| now.saturating_duration_since(window.began) >= WINDOW;
        if !self.services.contains_key(service) && self.services.len() >= SERVICES {
            self.services.retain(|_, window| !over(window));
            if self.services.len() >= SERVICES {
                return None;
            }
        }
        let fresh = || Window { began: now, robots: BTreeSet::new(), left_out: 0 };
        let window = self.services.entry(service.to_owned()).or_insert_with(fresh);
        let mut left_out = 0;
        if over(window) {
            left_out = window.left_out;
            *window = fresh();
        }
        if window.robots.contains(robot) || window.robots.len() >= ROBOTS {
            window.left_out += 1;
            return None;
        }
        window.robots.insert(robot.to_owned());
        Some(left_out)
    }
}

/// Returns the suffix of a report that gives the number of unreported refusals.
pub fn suppressed_note(count: u64) -> String {
    match count {
        0 => String::new(),
        count => format!(" ({count} more refusals of this service were not reported)"),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn each_robot_is_told_of_once_and_then_how_often_it_was_not() {
        let began = Instant::now();
        let mut told = RefusalLog::default();
        let second = Duration::from_secs(1);
        for (robot, after, tells) in [
            ("a", 0, Some(0)),
            ("a", 1, None),
            ("b", 2, Some(0)),
            ("a", 59, None),
            ("b", 60, Some(2)),
            ("a", 61, Some(0)),
            ("a", 121, Some(0)),
        ] {
            let now = began + second * after;
            assert_eq!(told.record_refusal("s", robot, now), tells, "{robot} {after}");
        }
        assert_eq!(told.record_refusal("other", "a", began), Some(0));
        assert_eq!((suppressed_note(0).as_str(), suppressed_note(2).contains("2 more")), ("", true));
    }

    #[test]
    fn it_does_not_grow() {
        let mut told = RefusalLog::default();
        let now = Instant::now();
        for number in 0..SERVICES + 2 {
            let tells = told.record_refusal(&number.to_string(), "a", now);
            assert_eq!(tells.is_some(), number < SERVICES, "{number}");
        }
        // Expired ones make room.
        assert_eq!(told.record_refusal("late", "a", now + WINDOW), Some(0));
        assert_eq!(told.services.len(), 1);
    }

    proptest! {
        #[test]
        fn however_many_are_refused_few_are_told_and_none_is_forgotten(
            asks in prop::collection::vec((0u8..2, 0u16..400, 0u64..3000), 1..600),
        ) {
            let mut told = RefusalLog::default();
            let mut now = Instant::now();
            let (mut tells, mut counted, mut passed) = ([0usize; 2], 0u64, Duration::ZERO);
            let all = asks.len() as u64;
            for (service, robot, pause) in asks {
                now += Duration::from_millis(pause);
                passed += Duration::from_millis(pause);
                if let Some(more) = told.record_refusal(&service.to_string(), &robot.to_string(), now) {
                    tells[service as usize] += 1;
                    counted += more;
                }
            }
            let windows = passed.as_secs() as usize / 60 + 1;
            prop_assert!(tells.iter().all(|tells| *tells <= ROBOTS * windows));
            let open: u64 = told.services.values().map(|window| window.left_out).sum();
            prop_assert_eq!(tells.iter().sum::<usize>() as u64 + counted + open, all);
        }
    }
}
