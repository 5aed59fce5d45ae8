//! One side of an evaluation: its measurement, and the phases of its requests.

use api::calibration::{Point, TimeSpread};
use api::{Calibration, Size};
use serde::Serialize;

use super::network::AddedNetwork;
use super::probe::ProbeOutcome;
use super::robot::RobotResources;

/// Share of the recording's rate that must be reached, and of the requests that must be answered.
const MIN_SHARE: f64 = 0.95;
/// Smallest number of answers for a meaningful 95th percentile.
const FEWEST: usize = 10;

/// Returns the only measured point.
pub(super) fn only_point(calibration: &Calibration) -> Point {
    calibration.points.first().copied().unwrap_or_default()
}

/// Result of one side.
#[derive(Debug, Clone, Default, Serialize)]
pub struct SideResult {
    /// Cores of the servant.
    pub cpus: f64,
    /// Memory limit of the servant.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_limit: Option<Size>,
    /// Reason why the kernel killed the servant for lack of memory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub out_of_memory: Option<String>,
    /// Reason why the measurement over the network failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub broken: Option<String>,
    /// Number of requests.
    pub requests: usize,
    /// Number of answered requests.
    pub answered: usize,
    /// Response times, as the robot would see them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rrt: Option<TimeSpread>,
    /// Phases of the median response time.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub phases: Option<Phases>,
    /// Achieved request rate in Hz, if known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate: Option<f64>,
    /// Peak memory use.
    pub memory: Size,
    /// Sizes of the largest request and of the largest answer received here, in bytes.
    pub bytes: (usize, usize),
    /// Input that was sent requests from here.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub asked: Option<String>,
    /// Output whose answers were received here.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub answered_by: Option<String>,
    /// Response times of the answered requests.
    pub times: Vec<f64>,
}

/// Phases of a request, in milliseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Phases {
    /// Upload through the added network; `None` if requests cross no network.
    pub up: Option<f64>,
    /// Transport between this machine and the servant's node, both ways: the median response time minus the median at
    /// the node. `None` if the difference is not positive, as the medians are of two runs.
    pub transport: Option<f64>,
    /// Download through the added network.
    pub down: Option<f64>,
    /// Time from the request's arrival at the node to its answer (median).
    pub compute: f64,
    /// Processor time in `compute`, on average, summed over cores.
    pub running: f64,
    /// Time in `compute` that the CPU limit throttled, on average, summed over the threads' cores.
    pub held_up: f64,
}

impl SideResult {
    /// Returns the result of a measurement with the robot's resources. Its requests cross no network.
    pub fn from_calibration(calibration: &Calibration, times: Vec<f64>, robot: &RobotResources) -> SideResult {
        let point = only_point(calibration);
        SideResult {
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
            ..SideResult::default()
        }
    }

    /// Returns the result of a servant that the robot's memory does not suffice for.
    pub fn out_of_memory(robot: &RobotResources, why: String) -> SideResult {
        SideResult {
            cpus: robot.cpus,
            memory_limit: Some(robot.memory),
            out_of_memory: Some(why),
            ..SideResult::default()
        }
    }

    /// Returns the result as seen over the network, plus the delays of `network`.
    pub fn from_probe(calibration: &Calibration, asked: &ProbeOutcome, network: Option<AddedNetwork>) -> SideResult {
        let point = only_point(calibration);
        let (up, down) = network.map_or((0.0, 0.0), |network| {
            (network.one_way_millis(asked.request), network.one_way_millis(asked.answer))
        });
        let heard: Vec<f64> = asked.times.iter().flatten().copied().collect();
        let seen = TimeSpread::from_samples(heard.clone());
        let times: Vec<f64> = heard.iter().map(|time| time + up + down).collect();
        let phases = point.compute.map(|compute| Phases {
            up: seen.and(Some(up)),
            transport: seen.map(|seen| seen.p50 - compute.p50).filter(|over| *over > 0.0),
            down: seen.and(Some(down)),
            compute: compute.p50,
            running: point.running,
            held_up: point.throttled,
        });
        SideResult {
            cpus: point.cpus,
            broken: asked.broken.clone(),
            requests: asked.times.len(),
            answered: times.len(),
            rrt: TimeSpread::from_samples(times.clone()),
            phases,
            rate: Some(point.rate),
            memory: point.memory,
            bytes: (asked.request, asked.answer),
            asked: asked.asked.clone(),
            answered_by: asked.answered_by.clone(),
            times,
            ..SideResult::default()
        }
    }

    /// Returns whether there are enough answers for the times to be meaningful.
    pub fn has_enough_answers(&self) -> bool {
        self.answered >= FEWEST && self.answered as f64 >= self.requests as f64 * MIN_SHARE
    }

    /// Returns whether one request after the other keeps up with the recording's rate.
    pub fn keeps_pace(&self, pace: Option<f64>) -> bool {
        pace.is_none_or(|pace| {
            let possible = self.rrt.map_or(0.0, |rrt| 1000.0 / rrt.p50);
            possible >= pace * MIN_SHARE
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
    use crate::eval::robot::RobotClass;

    pub(in crate::eval) fn robot() -> RobotResources {
        RobotResources::new(RobotClass::Pi, None, None)
    }

    /// Returns a calibration of twenty requests with this response time at the node, in milliseconds.
    pub(in crate::eval) fn calibration(cpus: f64, compute: f64, answered: usize) -> Calibration {
        let spread = TimeSpread { p50: compute, p95: compute, max: compute };
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
                limits: Limits { cpus: Some(cpus), memory: Some(Size(64 << 20)), ..Limits::default() },
                spread: None,
                revision: None,
                written: 0,
            }],
            ..Calibration::default()
        }
    }

    pub(in crate::eval) fn probe_outcome(time: f64) -> ProbeOutcome {
        ProbeOutcome { times: vec![Some(time); 20], request: 125_000, ..ProbeOutcome::default() }
    }

    #[test]
    fn a_network_is_added_to_what_was_measured_and_told_apart_from_it() {
        let side = SideResult::from_probe(&calibration(1.0, 40.0, 20), &probe_outcome(45.0), "lan".parse().ok());
        // 1 ms plus 10 ms for a megabit up; 1 ms down.
        let phases = side.phases.expect("phases");
        let is = |part: Option<f64>, time: f64| part.is_some_and(|part| (part - time).abs() < 1e-9);
        assert!(is(phases.up, 11.0) && is(phases.down, 1.0), "{phases:?}");
        assert!(is(phases.transport, 5.0), "{phases:?}");
        assert_eq!((phases.compute, phases.running, phases.held_up), (40.0, 40.0, 7.0));
        assert!((side.rrt.expect("times").p50 - 57.0).abs() < 1e-9);
        assert_eq!(side.times.len(), 20);
    }

    #[test]
    fn a_difference_of_two_runs_that_is_not_positive_is_not_shown() {
        let side = SideResult::from_probe(&calibration(1.0, 40.0, 20), &probe_outcome(38.0), None);
        let phases = side.phases.expect("phases");
        assert_eq!((phases.transport, phases.compute), (None, 40.0));
        let told = serde_json::to_value(phases).expect("plain data");
        assert!(told["transport"].is_null(), "{told}");
        // Native requests cross no network.
        let native = SideResult::from_calibration(&calibration(0.25, 40.0, 20), vec![40.0; 20], &robot());
        let phases = native.phases.expect("phases");
        assert_eq!((phases.up, phases.transport, phases.down), (None, None, None));
    }

    #[test]
    fn what_the_daemon_has_measured_is_kept_where_asking_over_the_network_fails() {
        let asked = ProbeOutcome::from_failure("the daemon broke the connection".into());
        let side = SideResult::from_probe(&calibration(1.0, 40.0, 20), &asked, None);
        assert_eq!(side.phases.map(|phases| phases.compute), Some(40.0));
        assert_eq!((side.rrt, side.broken), (None, asked.broken));
    }
}
