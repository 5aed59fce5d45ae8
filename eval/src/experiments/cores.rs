//! A part of experiment 2: packages in the cloud with several limits of cores, a model of their response times that is fitted to some of these,
//! its error at the others, and what it says of clouds with more cores than this machine has.

mod drawn;
mod model;
mod told;

use anyhow::{Context, Result, bail, ensure};
use serde::{Deserialize, Serialize};

use crate::cells::{Cells, Measured};
use crate::examples::{DETECTOR, Example, LASER_SLAM, Where, Workshop};
use crate::place::{Class, Cost, Network, Place};
use crate::robot::Node;
use crate::trace::Trace;

use model::{Model, Parts, parts};
pub use told::section;

/// Where the servant's robot is.
const NETWORK: Network = Network::Lan;

/// One program, with the limits that it is measured at.
#[derive(Debug, Clone, Copy)]
pub struct Subject {
    example: Example,
    /// What it is called here.
    name: &'static str,
    /// Arguments of its node beside the example's own.
    arguments: &'static [&'static str],
    /// Threads that it computes with.
    threads: usize,
    fitted: &'static [f64],
    /// Some between those, and one beyond the greatest of them: what is predicted lies beyond, too.
    held_back: &'static [f64],
    requests: usize,
}

const SUBJECTS: [Subject; 3] = [
    Subject {
        example: LASER_SLAM,
        name: "laser_slam",
        arguments: &[],
        threads: 1,
        fitted: &[0.25, 0.5, 1.0, 1.25],
        held_back: &[0.35, 0.75, 1.5],
        requests: 60,
    },
    Subject {
        example: DETECTOR,
        name: "object_detector, 1 thread",
        arguments: &[],
        threads: 1,
        fitted: &[0.25, 0.5, 1.0, 1.25],
        held_back: &[0.35, 0.75, 1.5],
        requests: 16,
    },
    Subject {
        example: DETECTOR,
        name: "object_detector, 2 threads",
        arguments: &["_threads:=2"],
        threads: 2,
        fitted: &[0.25, 0.5, 1.0, 1.5],
        held_back: &[0.35, 0.75, 1.25, 1.75],
        requests: 16,
    },
];

/// What a quick evaluation measures.
const QUICK: Subject = Subject {
    fitted: &[0.25, 0.5, 1.0],
    held_back: &[0.75],
    requests: 6,
    ..SUBJECTS[0]
};

/// One run in the cloud.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Reading {
    /// Cores of the servant, as the kernel has them.
    enforced: f64,
    trace: Trace,
    cost: Cost,
}

/// All runs of one program.
pub struct Study {
    subject: Subject,
    /// On the robot itself, which is of the class Pi.
    native: Measured<Trace>,
    /// By the limit that was asked for.
    runs: Vec<(f64, Measured<Reading>)>,
}

/// Measures all programs; of a quick evaluation, one at few limits.
pub fn measure(cells: &Cells, workshop: &Workshop, quick: bool) -> Result<Vec<Study>> {
    let subjects = if quick {
        vec![QUICK]
    } else {
        SUBJECTS.to_vec()
    };
    subjects
        .into_iter()
        .map(|subject| study(cells, workshop, subject))
        .collect()
}

fn study(cells: &Cells, workshop: &Workshop, subject: Subject) -> Result<Study> {
    let name = format!("cores {}", subject.name);
    let native = cells.measure(&format!("{name} native"), &subject.requests, || {
        native(workshop, &subject)
    })?;
    let mut limits = [subject.fitted, subject.held_back].concat();
    limits.sort_by(f64::total_cmp);
    let mut runs = Vec::new();
    for cores in limits {
        let of = (cores, subject.requests, subject.arguments);
        let measured = cells.measure(&format!("{name} {cores}"), &of, || {
            outsourced(workshop, &subject, cores)
        })?;
        runs.push((cores, measured));
    }
    Ok(Study {
        subject,
        native,
        runs,
    })
}

fn native(workshop: &Workshop, subject: &Subject) -> Result<Trace> {
    workshop.publishes(&subject.example)?;
    let directory = workshop.directory()?;
    let mut plan = workshop.plan(&subject.example, Where::Native, directory.path())?;
    plan.most = subject.requests;
    let place = Place::new(&workshop.daemon.address, Class::PI, NETWORK)?;
    Ok(place.runs(&plan, directory.path())?.0)
}

/// The robot's stub states the servant's cores; what the kernel made of it is read from the daemon, whose servant waits for the robot a while.
fn outsourced(workshop: &Workshop, subject: &Subject, cores: f64) -> Result<Reading> {
    workshop.publishes(&subject.example)?;
    let directory = workshop.directory()?;
    let mut plan = workshop.plan(&subject.example, Where::Outsourced, directory.path())?;
    plan.most = subject.requests;
    let robot = format!("cores-{}-{cores}-{}", subject.threads, std::process::id());
    let Node::Stub { argv, settings, .. } = &mut plan.node else {
        bail!("a robot that asks the cloud has a stub");
    };
    argv.extend(subject.arguments.iter().map(|word| (*word).to_owned()));
    settings.push_str(&format!("\nrobot = \"{robot}\"\ncpus = {cores:?}"));
    let place = Place::new(&workshop.daemon.address, Class::PI, NETWORK)?;
    let (trace, cost) = place.runs(&plan, directory.path())?;
    let servant = workshop.daemon.servant_of(subject.example.name, &robot)?;
    let enforced = servant["enforced"]["cpus"].as_f64();
    let enforced = enforced.context("the servant's cores are not limited")?;
    let id = servant["id"].as_str().context("a servant's id")?;
    // Its cores are promised until it ends.
    workshop
        .daemon
        .deployer()
        .types(&["stop", id])?
        .succeeded()?;
    ensure!(
        (enforced - cores).abs() < 0.01,
        "the servant was to have {cores} cores and had {enforced}"
    );
    ensure!(trace.answered() > 0, "no request was answered");
    Ok(Reading {
        enforced,
        trace,
        cost,
    })
}

/// What a limit is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Use {
    /// The model is fitted to it.
    Fitted,
    /// The model has not seen it, but smaller ones and greater ones.
    Inside,
    /// The model has seen only smaller ones.
    Beyond,
}

impl Use {
    /// As tables name it.
    fn name(self) -> &'static str {
        match self {
            Self::Fitted => "fitting",
            Self::Inside => "held back, inside",
            Self::Beyond => "held back, beyond",
        }
    }
}

impl Subject {
    fn uses(&self, cores: f64) -> Use {
        if self.fitted.contains(&cores) {
            Use::Fitted
        } else if self.fitted.iter().all(|fitted| *fitted < cores) {
            Use::Beyond
        } else {
            Use::Inside
        }
    }
}

/// What one program's runs come to.
struct Found<'a> {
    study: &'a Study,
    /// Cores, parts, what they are for.
    points: Vec<(f64, Parts, Use)>,
    model: Option<Model>,
    /// Mean response time on the robot itself, seconds.
    native: Option<f64>,
}

impl<'a> Found<'a> {
    fn of(study: &'a Study) -> Self {
        let mut points = Vec::new();
        for (cores, measured) in &study.runs {
            let parts = measured.done().and_then(|run| parts(&run.trace));
            let of = study.subject.uses(*cores);
            points.extend(parts.map(|parts| (*cores, parts, of)));
        }
        let fitted = points.iter().filter(|point| point.2 == Use::Fitted);
        let fitted: Vec<(f64, Parts)> = fitted.map(|(cores, parts, _)| (*cores, *parts)).collect();
        let native = study.native.done().and_then(parts);
        Self {
            study,
            points,
            model: Model::fit(&fitted, study.subject.threads),
            native: native.map(total),
        }
    }

    fn name(&self) -> &'static str {
        self.study.subject.name
    }

    /// (predicted, measured) at the points that are for this, by this prediction of the model.
    fn pairs(&self, of: Use, predict: fn(&Model, f64) -> f64) -> Vec<(f64, f64)> {
        let those = self.points.iter().filter(|point| point.2 == of);
        let pair = |(cores, parts, _): &(f64, Parts, Use)| {
            Some((predict(&self.model?, *cores), total(*parts)))
        };
        those.filter_map(pair).collect()
    }
}

fn total(parts: Parts) -> f64 {
    parts.iter().sum()
}
