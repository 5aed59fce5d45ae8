//! One side of an evaluation: what was measured of it, and the parts of its requests' time.

use api::calibration::TimeSpread;
use api::{Calibration, Size};
use serde::Serialize;

use super::measure::point;
use super::network::Network;
use super::probe::Asked;
use super::robot::Robot;

/// Such a share of the recording's pace is to be kept, and of the requests to be answered.
const ENOUGH: f64 = 0.95;
/// Fewer answers say nothing of a 95th percentile.
const FEWEST: usize = 10;

/// One side.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Side {
    /// Cores that it had.
    pub cpus: f64,
    /// Memory that it was limited to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_limit: Option<Size>,
    /// Why the kernel has ended it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub out_of_memory: Option<String>,
    /// Why it was not measured over the network.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub broken: Option<String>,
    /// Requests.
    pub requests: usize,
    /// Of them were answered.
    pub answered: usize,
    /// Response times, as the robot would see them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rrt: Option<TimeSpread>,
    /// The medians' parts.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub phases: Option<Phases>,
    /// Requests a second that were made, as far as that is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate: Option<f64>,
    /// The most memory that was in use.
    pub memory: Size,
    /// Size of the largest request, and of the largest answer where it was heard from here.
    pub bytes: (usize, usize),
    /// The input that was asked from here.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub asked: Option<String>,
    /// The output that answered, where it was heard from here.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub answered_by: Option<String>,
    /// Of each answered request.
    pub times: Vec<f64>,
}

/// Parts of a request's time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Phases {
    /// Up by the added network; none where requests cross none.
    pub up: Option<f64>,
    /// Between here and the servant's node, both ways: what is over of the median when that of the node is taken away. None where
    /// nothing is over: the medians are of two runs.
    pub transport: Option<f64>,
    /// Down by the added network.
    pub down: Option<f64>,
    /// From the request's arrival at the node to its answer (median).
    pub compute: f64,
    /// Of it processor time, on average, summed over cores.
    pub running: f64,
    /// Of it held up by the limit of cores, on average, summed over the threads' cores.
    pub held_up: f64,
}

impl Side {
    /// With as much as the robot has. Its requests cross no network.
    pub fn native(calibration: &Calibration, times: Vec<f64>, robot: &Robot) -> Side {
        let point = point(calibration);
        Side {
            cpus: point.cpus,
            memory_limit: Some(robot.memory),
            requests: point.requests,
            answered: point.answered,
            rrt: point.compute,
            phases: point.compute.map(|compute| Phases {
                compute: compute.p50,
                running: point.running,
                held_up: point.throttled,
                ..Phases::default()
            }),
            rate: Some(point.rate),
            memory: point.memory,
            bytes: (calibration.largest.0 as usize, 0),
            times,
            ..Side::default()
        }
    }

    /// It did not get along with the robot's memory.
    pub fn starved(robot: &Robot, why: String) -> Side {
        Side {
            cpus: robot.cpus,
            memory_limit: Some(robot.memory),
            out_of_memory: Some(why),
            ..Side::default()
        }
    }

    /// As it was heard over the network, with what `network` adds.
    pub fn outsourced(calibration: &Calibration, asked: &Asked, network: Option<Network>) -> Side {
        let point = point(calibration);
        let (up, down) = network.map_or((0.0, 0.0), |network| {
            (
                network.one_way(asked.request),
                network.one_way(asked.answer),
            )
        });
        let heard: Vec<f64> = asked.times.iter().flatten().copied().collect();
        let seen = TimeSpread::of(heard.clone());
        let times: Vec<f64> = heard.iter().map(|time| time + up + down).collect();
        let phases = point.compute.map(|compute| Phases {
            up: seen.and(Some(up)),
            transport: seen
                .map(|seen| seen.p50 - compute.p50)
                .filter(|over| *over > 0.0),
            down: seen.and(Some(down)),
            compute: compute.p50,
            running: point.running,
            held_up: point.throttled,
        });
        Side {
            cpus: point.cpus,
            broken: asked.broken.clone(),
            requests: asked.times.len(),
            answered: times.len(),
            rrt: TimeSpread::of(times.clone()),
            phases,
            rate: Some(point.rate),
            memory: point.memory,
            bytes: (asked.request, asked.answer),
            asked: asked.asked.clone(),
            answered_by: asked.answered_by.clone(),
            times,
            ..Side::default()
        }
    }

    /// Whether its times say something.
    pub fn answers_enough(&self) -> bool {
        self.answered >= FEWEST && self.answered as f64 >= self.requests as f64 * ENOUGH
    }

    /// Whether it keeps the recording's pace, one request after the other.
    pub fn keeps(&self, pace: Option<f64>) -> bool {
        pace.is_none_or(|pace| {
            let possible = self.rrt.map_or(0.0, |rrt| 1000.0 / rrt.p50);
            possible >= pace * ENOUGH
        })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::collections::BTreeMap;

    use api::calibration::Point;
    use api::dictionary::Row;
    use api::{Limits, Measure};

    use super::*;
    use crate::eval::robot::Class;

    pub(in crate::eval) fn robot() -> Robot {
        Robot::new(Class::Pi, None, None)
    }

    /// Twenty requests that took so long each at the node.
    pub(in crate::eval) fn calibration(cpus: f64, compute: f64, answered: usize) -> Calibration {
        let spread = TimeSpread {
            p50: compute,
            p95: compute,
            max: compute,
        };
        Calibration {
            service: "people".into(),
            points: vec![Point {
                cpus,
                requests: 20,
                answered,
                compute: (answered > 0).then_some(spread),
                running: 40.0,
                throttled: 7.0,
                ..Point::default()
            }],
            rows: vec![Row {
                id: 0,
                measure: Measure::Rrt,
                value: 0.001,
                aux: BTreeMap::new(),
                limits: Limits {
                    cpus: Some(cpus),
                    memory: Some(Size(64 << 20)),
                    ..Limits::default()
                },
                spread: None,
                revision: None,
                written: 0,
            }],
            ..Calibration::default()
        }
    }

    pub(in crate::eval) fn asked(time: f64) -> Asked {
        Asked {
            times: vec![Some(time); 20],
            request: 125_000,
            ..Asked::default()
        }
    }

    #[test]
    fn a_network_is_added_to_what_was_measured_and_told_apart_from_it() {
        let side = Side::outsourced(
            &calibration(1.0, 40.0, 20),
            &asked(45.0),
            "lan".parse().ok(),
        );
        // 1 ms up and 10 ms for a megabit; 1 ms down.
        let phases = side.phases.expect("phases");
        let is = |part: Option<f64>, time: f64| part.is_some_and(|part| (part - time).abs() < 1e-9);
        assert!(is(phases.up, 11.0) && is(phases.down, 1.0), "{phases:?}");
        assert!(is(phases.transport, 5.0), "{phases:?}");
        assert_eq!(
            (phases.compute, phases.running, phases.held_up),
            (40.0, 40.0, 7.0)
        );
        assert!((side.rrt.expect("times").p50 - 57.0).abs() < 1e-9);
        assert_eq!(side.times.len(), 20);
    }

    #[test]
    fn a_difference_of_two_runs_that_is_not_positive_is_not_shown() {
        let side = Side::outsourced(&calibration(1.0, 40.0, 20), &asked(38.0), None);
        let phases = side.phases.expect("phases");
        assert_eq!((phases.transport, phases.compute), (None, 40.0));
        let told = serde_json::to_value(phases).expect("plain data");
        assert!(told["transport"].is_null(), "{told}");
        // Native requests cross no network.
        let native = Side::native(&calibration(0.25, 40.0, 20), vec![40.0; 20], &robot());
        let phases = native.phases.expect("phases");
        assert_eq!(
            (phases.up, phases.transport, phases.down),
            (None, None, None)
        );
    }

    #[test]
    fn what_the_daemon_has_measured_is_kept_where_asking_over_the_network_fails() {
        let asked = Asked::broken("the daemon broke the connection".into());
        let side = Side::outsourced(&calibration(1.0, 40.0, 20), &asked, None);
        assert_eq!(side.phases.map(|phases| phases.compute), Some(40.0));
        assert_eq!((side.rrt, side.broken), (None, asked.broken));
    }
}
