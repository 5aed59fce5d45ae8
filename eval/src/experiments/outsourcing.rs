//! Experiments 2, 4 and 5: packages on two kinds of robots, there and in the cloud: response times, their parts, and how much they differ
//! from request to request.

mod jitter;
mod phases;
mod response_times;

use anyhow::Result;
use serde::{Deserialize, Serialize};

use crate::cells::{Cells, Measured};
use crate::examples::{ALL, Example, LASER_SLAM, Where, Workshop};
use crate::place::{Class, Cost, Network, Place};
use crate::section::{Missing, Section};
use crate::trace::Trace;

pub use jitter::jitter;
pub use phases::phases;
pub use response_times::response_times;

/// Where one package ran.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum SetUp {
    /// On the robot.
    Native,
    /// In the cloud, behind this network.
    Behind(Network),
}

impl SetUp {
    /// As tables name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Native => "native",
            Self::Behind(network) => network.name(),
        }
    }
}

/// The set-ups of the published figure.
pub const SET_UPS: [SetUp; 3] = [
    SetUp::Native,
    SetUp::Behind(Network::Lan),
    SetUp::Behind(Network::Wan),
];

/// One package on one robot in one set-up.
pub struct Run {
    /// The package.
    pub example: Example,
    /// The robot.
    pub class: Class,
    /// Where it answered.
    pub set_up: SetUp,
    /// What came out.
    pub measured: Measured<(Trace, Cost)>,
}

/// Measures all; so many requests each, or as many as the example says.
pub fn measure(cells: &Cells, workshop: &Workshop, most: Option<usize>) -> Result<Vec<Run>> {
    // A quick evaluation shows that it works, which one package on one kind of robots does.
    let (examples, classes) = if most.is_some() {
        (&[LASER_SLAM][..], &[Class::PI][..])
    } else {
        (&ALL[..], &[Class::PI, Class::ULTRABOOK][..])
    };
    let mut runs = Vec::new();
    for &example in examples {
        for &class in classes {
            for set_up in SET_UPS {
                let name = format!("{} {} {}", example.name, class.name(), set_up.name());
                let most = most.unwrap_or(example.requests).min(example.requests);
                let measured = cells.measure(&name, &(class, set_up, most), || {
                    one(workshop, &example, class, set_up, most)
                })?;
                runs.push(Run {
                    example,
                    class,
                    set_up,
                    measured,
                });
            }
        }
    }
    Ok(runs)
}

fn one(
    workshop: &Workshop,
    example: &Example,
    class: Class,
    set_up: SetUp,
    most: usize,
) -> Result<(Trace, Cost)> {
    workshop.publishes(example)?;
    let (at, network) = match set_up {
        SetUp::Native => (Where::Native, Network::Lan),
        SetUp::Behind(network) => (Where::Outsourced, network),
    };
    let directory = workshop.directory()?;
    let mut plan = workshop.plan(example, at, directory.path())?;
    plan.most = most;
    let place = Place::new(&workshop.daemon.address, class, network)?;
    place.runs(&plan, directory.path())
}

/// What was measured of one package, robot and set-up.
fn find<'a>(
    runs: &'a [Run],
    example: &str,
    class: Class,
    set_up: SetUp,
) -> Option<&'a (Trace, Cost)> {
    let wanted =
        |run: &&Run| run.example.name == example && run.class == class && run.set_up == set_up;
    runs.iter().find(wanted)?.measured.done()
}

/// The packages of these runs.
fn examples(runs: &[Run]) -> impl Iterator<Item = Example> {
    let tried = |example: &Example| runs.iter().any(|run| run.example.name == example.name);
    ALL.into_iter().filter(tried)
}

/// Names what was not measured.
fn missing<R: std::borrow::Borrow<Run>>(section: &mut Section, runs: &[R]) {
    for run in runs.iter().map(std::borrow::Borrow::borrow) {
        let what = format!(
            "{}, {}, {}",
            run.example.name,
            run.class.name(),
            run.set_up.name()
        );
        match &run.measured {
            Measured::Missing(why) => section.missing.push(Missing::again(what, why)),
            Measured::Done((trace, _)) => {
                if let Some(why) = &trace.node_ended {
                    section.missing.push(Missing {
                        what: format!("{what}: after request {}", trace.requests.len()),
                        why: why.clone(),
                        next: "look at what the node printed".to_owned(),
                    });
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::examples::LASER_SLAM;
    use crate::trace::{Phases, Request};

    /// A run of one package on the smaller robot, with these response times in seconds.
    pub(super) fn run(set_up: SetUp, responses: &[f64]) -> Run {
        let request = |response: &f64| Request {
            response: Some(*response),
            phases: Some(Phases {
                acquisition: response * 0.1,
                computation: response * 0.5,
                rendering: response * 0.2,
            }),
            ..Request::default()
        };
        let trace = Trace {
            requests: responses.iter().map(request).collect(),
            ..Trace::default()
        };
        Run {
            example: LASER_SLAM,
            class: Class::PI,
            set_up,
            measured: Measured::Done((trace, Cost::default())),
        }
    }

    #[test]
    fn what_was_not_measured_is_named() {
        let lost = Run {
            measured: Measured::Missing("the robot's place was ended by signal 9".to_owned()),
            ..run(SetUp::Native, &[])
        };
        let section = jitter(&[lost]).expect("a section");
        assert!(section.missing[0].why.contains("signal 9"));
        assert!(section.missing[0].what.contains("laser_slam"));
    }
}
