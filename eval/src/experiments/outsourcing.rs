//! Experiments 2, 4 and 5: packages on two kinds of robots, run on the robot and in the cloud: response times, their
//! parts, and their variation.

mod jitter;
mod phases;
mod response_times;

use anyhow::Result;
use serde::{Deserialize, Serialize};

use crate::cells::{CachedResult, RunCache};
use crate::examples::{ALL, EvalFixtures, EvalPackage, ExecutionSite, LASER_SLAM};
use crate::place::{NetworkProfile, RobotHardware, RunCost};
use crate::section::{AGAIN, Section};
use crate::trace::Trace;

pub use jitter::jitter;
pub use phases::phases;
pub use response_times::response_times;

/// Place where a package ran.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum OutsourcingSetUp {
    /// On the robot.
    Native,
    /// In the cloud, over this network.
    Behind(NetworkProfile),
}

impl OutsourcingSetUp {
    /// Name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Native => "native",
            Self::Behind(network) => network.name(),
        }
    }
}

/// Set-ups of the published figure.
pub const SET_UPS: [OutsourcingSetUp; 3] = [
    OutsourcingSetUp::Native,
    OutsourcingSetUp::Behind(NetworkProfile::Lan),
    OutsourcingSetUp::Behind(NetworkProfile::Wan),
];

/// One package on one robot in one set-up.
pub struct OutsourcingRun {
    /// The package.
    pub example: EvalPackage,
    /// The robot.
    pub class: RobotHardware,
    /// Place where it ran.
    pub set_up: OutsourcingSetUp,
    /// Result.
    pub measured: CachedResult<(Trace, RunCost)>,
}

/// Measures all runs with `most` requests each, or as many as the example specifies.
pub fn measure(cells: &RunCache, workshop: &EvalFixtures, most: Option<usize>) -> Result<Vec<OutsourcingRun>> {
    // A quick evaluation shows that everything works, for which one package on one kind of robot suffices.
    let (examples, classes) = if most.is_some() {
        (&[LASER_SLAM][..], &[RobotHardware::PI][..])
    } else {
        (&ALL[..], &[RobotHardware::PI, RobotHardware::ULTRABOOK][..])
    };
    let mut runs = Vec::new();
    for &example in examples {
        for &class in classes {
            for set_up in SET_UPS {
                let name = format!("{} {} {}", example.name, class.name(), set_up.name());
                let most = most.unwrap_or(example.requests).min(example.requests);
                let measured = cells.measure(&name, &(class, set_up, most), || {
                    let (at, network) = match set_up {
                        OutsourcingSetUp::Native => (ExecutionSite::Native, NetworkProfile::Lan),
                        OutsourcingSetUp::Behind(network) => (ExecutionSite::Outsourced, network),
                    };
                    workshop.run(&example, at, (class, network), |plan| plan.most = most)
                })?;
                runs.push(OutsourcingRun { example, class, set_up, measured });
            }
        }
    }
    Ok(runs)
}

/// Returns the result of one package, robot and set-up.
fn find_run<'a>(
    runs: &'a [OutsourcingRun],
    example: &str,
    class: RobotHardware,
    set_up: OutsourcingSetUp,
) -> Option<&'a (Trace, RunCost)> {
    let wanted = |run: &&OutsourcingRun| run.example.name == example && run.class == class && run.set_up == set_up;
    runs.iter().find(wanted)?.measured.value()
}

/// Returns the packages of these runs.
fn examples(runs: &[OutsourcingRun]) -> impl Iterator<Item = EvalPackage> {
    let tried = |example: &EvalPackage| runs.iter().any(|run| run.example.name == example.name);
    ALL.into_iter().filter(tried)
}

/// Lists the runs without a result.
fn add_missing<R: std::borrow::Borrow<OutsourcingRun>>(section: &mut Section, runs: &[R]) {
    for run in runs.iter().map(std::borrow::Borrow::borrow) {
        let what = format!("{}, {}, {}", run.example.name, run.class.name(), run.set_up.name());
        if let Some((trace, _)) = run.measured.require(section, &what, AGAIN) {
            let answered = trace.requests.len();
            section.note_early_end(format!("{what}: after request {answered}"), trace);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::examples::LASER_SLAM;
    use crate::trace::{ComputationPhases, RequestSample};

    /// Creates a run of one package on the smaller robot with these response times, in seconds.
    pub(super) fn test_run(set_up: OutsourcingSetUp, responses: &[f64]) -> OutsourcingRun {
        let request = |response: &f64| RequestSample {
            response: Some(*response),
            phases: Some(ComputationPhases {
                acquisition: response * 0.1,
                computation: response * 0.5,
                rendering: response * 0.2,
            }),
            ..RequestSample::default()
        };
        let trace = Trace { requests: responses.iter().map(request).collect(), ..Trace::default() };
        OutsourcingRun {
            example: LASER_SLAM,
            class: RobotHardware::PI,
            set_up,
            measured: CachedResult::Done((trace, RunCost::default())),
        }
    }

    #[test]
    fn what_was_not_measured_is_named() {
        let lost = OutsourcingRun {
            measured: CachedResult::Missing("the robot's place was ended by signal 9".to_owned()),
            ..test_run(OutsourcingSetUp::Native, &[])
        };
        let section = jitter(&[lost]).expect("a section");
        assert!(section.missing[0].why.contains("signal 9"));
        assert!(section.missing[0].what.contains("laser_slam"));
    }
}
