//! Experiments 2, 4 and 5: packages on two kinds of robots, run on the robot and in the cloud: response times, their
//! parts, and their variation.

mod jitter;
mod phases;
mod response_times;

use anyhow::Result;
use serde::{Deserialize, Serialize};

use crate::cells::{RunCache, Runs};
use crate::examples::{ALL, EvalFixtures, EvalPackage, ExecutionSite, LASER_SLAM};
use crate::place::{NetworkProfile, RobotHardware, RunCost};
use crate::section::Section;
use crate::trace::Trace;

pub use jitter::{JITTER, jitter};
pub use phases::{PHASES, phases};
pub use response_times::{RESPONSE_TIMES, response_times};

/// Place where a package ran.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum OutsourcingSetUp {
    Native,
    Behind(NetworkProfile),
}

impl OutsourcingSetUp {
    pub fn name(self) -> &'static str {
        match self {
            Self::Native => "native",
            Self::Behind(network) => network.name(),
        }
    }
}

/// Set-ups of the published figure.
const SET_UPS: [OutsourcingSetUp; 3] = [
    OutsourcingSetUp::Native,
    OutsourcingSetUp::Behind(NetworkProfile::Lan),
    OutsourcingSetUp::Behind(NetworkProfile::Wan),
];

/// One package on one robot in one set-up.
pub struct OutsourcingRun {
    example: EvalPackage,
    class: RobotHardware,
    set_up: OutsourcingSetUp,
    measured: Runs<(Trace, RunCost)>,
}

impl OutsourcingRun {
    fn labels(&self) -> [&'static str; 3] {
        [self.example.name, self.class.name(), self.set_up.name()]
    }

    fn place_name(&self) -> String {
        format!("{}, {}", self.class.name(), self.set_up.name())
    }

    /// Returns the same package on the same robot, natively.
    fn native<'a>(&self, runs: &'a [Self]) -> Option<&'a Self> {
        let is_native = |run: &&Self| run.set_up == OutsourcingSetUp::Native;
        runs.iter().filter(is_native).find(|run| run.example.name == self.example.name && run.class == self.class)
    }
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
                let (at, network) = match set_up {
                    OutsourcingSetUp::Native => (ExecutionSite::Native, NetworkProfile::Lan),
                    OutsourcingSetUp::Behind(network) => (ExecutionSite::Outsourced, network),
                };
                let measured = cells.repeat(&name, &(class, set_up, most), || {
                    workshop.run(&example, at, (class, network), |plan| plan.most = most)
                })?;
                runs.push(OutsourcingRun { example, class, set_up, measured });
            }
        }
    }
    Ok(runs)
}

fn examples(runs: &[OutsourcingRun]) -> impl Iterator<Item = EvalPackage> {
    ALL.into_iter().filter(|example| runs.iter().any(|run| run.example.name == example.name))
}

fn add_missing<'a>(section: &mut Section, runs: impl IntoIterator<Item = &'a OutsourcingRun>) {
    for run in runs {
        let what = run.labels().join(", ");
        run.measured.require(section, &what);
        run.measured.done.iter().for_each(|(trace, _)| section.note_early_end(&what, trace));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::{ComputationPhases, RequestSample};

    /// Creates a run of one package on the smaller robot with these response times, in seconds.
    pub(super) fn test_run(set_up: OutsourcingSetUp, responses: &[f64]) -> OutsourcingRun {
        let request = |response: &f64| {
            let [acquisition, computation, rendering] = [0.1, 0.5, 0.2].map(|share| response * share);
            let phases = Some(ComputationPhases { acquisition, computation, rendering });
            RequestSample { response: Some(*response), phases, ..RequestSample::default() }
        };
        let trace = Trace { requests: responses.iter().map(request).collect(), ..Trace::default() };
        let measured = Runs::from((trace, RunCost::default()));
        OutsourcingRun { example: LASER_SLAM, class: RobotHardware::PI, set_up, measured }
    }

    #[test]
    fn what_was_not_measured_is_named() {
        let measured = Runs::from_failure("the robot's place was ended by signal 9");
        let lost = OutsourcingRun { measured, ..test_run(OutsourcingSetUp::Native, &[]) };
        let section = jitter(&[lost]);
        assert!(section.missing[0].why.contains("signal 9"));
        assert!(section.missing[0].what.contains("laser_slam"));
    }
}
