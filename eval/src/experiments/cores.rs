//! Part of experiment 2: packages in the cloud with several limits of cores, a model of their response times that is
//! fitted to some of them, its error at the others, and its predictions for clouds with more cores than this machine.

mod drawn;
mod model;
mod told;

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};

use crate::cells::{CachedResult, RunCache};
use crate::examples::{DETECTOR, EvalFixtures, EvalPackage, ExecutionSite, LASER_SLAM};
use crate::place::{NetworkProfile, RobotHardware, RunCost};
use crate::robot::NodeUnderTest;
use crate::trace::Trace;

use model::{Model, ResponseParts, mean_parts};
pub use told::section;

/// Network between robot and servant.
const NETWORK: NetworkProfile = NetworkProfile::Lan;

/// A program, and the limits at which it is measured.
#[derive(Debug, Clone, Copy)]
pub struct Subject {
    example: EvalPackage,
    /// Name in the report.
    name: &'static str,
    /// Arguments of its node in addition to the example's own.
    arguments: &'static [&'static str],
    /// Number of threads of its computation.
    threads: usize,
    fitted: &'static [f64],
    /// Some limits between the fitted ones, and one above them, because the predictions lie above them as well.
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

/// Program of a quick evaluation.
const QUICK: Subject = Subject { fitted: &[0.25, 0.5, 1.0], held_back: &[0.75], requests: 6, ..SUBJECTS[0] };

/// One run in the cloud.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CoreLimitRun {
    /// Cores of the servant that the kernel enforces.
    enforced: f64,
    trace: Trace,
    cost: RunCost,
}

/// All runs of one program.
pub struct ProgramStudy {
    subject: Subject,
    /// Run on the robot itself, a Raspberry Pi in this evaluation.
    native: CachedResult<Trace>,
    /// Runs in the cloud, by the requested limit.
    runs: Vec<(f64, CachedResult<CoreLimitRun>)>,
}

/// Measures all programs; a quick evaluation measures one at few limits.
pub fn measure(cells: &RunCache, workshop: &EvalFixtures, quick: bool) -> Result<Vec<ProgramStudy>> {
    let subjects = if quick { vec![QUICK] } else { SUBJECTS.to_vec() };
    subjects.into_iter().map(|subject| measure_study(cells, workshop, subject)).collect()
}

fn measure_study(cells: &RunCache, workshop: &EvalFixtures, subject: Subject) -> Result<ProgramStudy> {
    let name = format!("cores {}", subject.name);
    let native = cells.measure(&format!("{name} native"), &subject.requests, || measure_native(workshop, &subject))?;
    let mut limits = [subject.fitted, subject.held_back].concat();
    limits.sort_by(f64::total_cmp);
    let mut runs = Vec::new();
    for cores in limits {
        let of = (cores, subject.requests, subject.arguments);
        let measured =
            cells.measure(&format!("{name} {cores}"), &of, || measure_outsourced(workshop, &subject, cores))?;
        runs.push((cores, measured));
    }
    Ok(ProgramStudy { subject, native, runs })
}

fn measure_native(workshop: &EvalFixtures, subject: &Subject) -> Result<Trace> {
    let robot = (RobotHardware::PI, NETWORK);
    let ran = workshop.run(&subject.example, ExecutionSite::Native, robot, |plan| {
        plan.most = subject.requests;
    });
    Ok(ran?.0)
}

/// Measures in the cloud. The robot's stub states the servant's cores; the enforced limit is read from the daemon while
/// the servant is kept for the robot.
fn measure_outsourced(workshop: &EvalFixtures, subject: &Subject, cores: f64) -> Result<CoreLimitRun> {
    let robot = format!("cores-{}-{cores}-{}", subject.threads, std::process::id());
    let (at, place) = (ExecutionSite::Outsourced, (RobotHardware::PI, NETWORK));
    let (trace, cost) = workshop.run(&subject.example, at, place, |plan| {
        plan.most = subject.requests;
        if let NodeUnderTest::Stub { argv, settings, .. } = &mut plan.node {
            argv.extend(subject.arguments.iter().map(|word| (*word).to_owned()));
            settings.push_str(&format!("\nrobot = \"{robot}\"\ncpus = {cores:?}"));
        }
    })?;
    let servant = workshop.daemon.servant_of(subject.example.name, &robot)?;
    let enforced = servant["enforced"]["cpus"].as_f64();
    let enforced = enforced.context("the servant's cores are not limited")?;
    let id = servant["id"].as_str().context("a servant's id")?;
    // The servant's cores stay promised until it ends.
    workshop.daemon.deployer().run(&["stop", id])?.expect_success()?;
    ensure!((enforced - cores).abs() < 0.01, "the servant was to have {cores} cores and had {enforced}");
    ensure!(trace.answered_count() > 0, "no request was answered");
    Ok(CoreLimitRun { enforced, trace, cost })
}

/// Use of a limit in the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum LimitUse {
    /// The model is fitted to it.
    Fitted,
    /// Not used for fitting, but between limits that were.
    Inside,
    /// Not used for fitting, and above all limits that were.
    Beyond,
}

impl LimitUse {
    /// Name in tables.
    fn name(self) -> &'static str {
        match self {
            Self::Fitted => "fitting",
            Self::Inside => "held back, inside",
            Self::Beyond => "held back, beyond",
        }
    }
}

impl Subject {
    fn use_of_limit(&self, cores: f64) -> LimitUse {
        if self.fitted.contains(&cores) {
            LimitUse::Fitted
        } else if self.fitted.iter().all(|fitted| *fitted < cores) {
            LimitUse::Beyond
        } else {
            LimitUse::Inside
        }
    }
}

/// Model and measurements of one program.
struct ProgramFit<'a> {
    study: &'a ProgramStudy,
    /// Cores, parts of the response time, and use in the model.
    points: Vec<(f64, ResponseParts, LimitUse)>,
    model: Option<Model>,
    /// Mean response time on the robot itself, in seconds.
    native: Option<f64>,
}

impl<'a> ProgramFit<'a> {
    fn from_study(study: &'a ProgramStudy) -> Self {
        let mut points = Vec::new();
        for (cores, measured) in &study.runs {
            let parts = measured.value().and_then(|run| mean_parts(&run.trace));
            let of = study.subject.use_of_limit(*cores);
            points.extend(parts.map(|parts| (*cores, parts, of)));
        }
        let fitted = points.iter().filter(|point| point.2 == LimitUse::Fitted);
        let fitted: Vec<(f64, ResponseParts)> = fitted.map(|(cores, parts, _)| (*cores, *parts)).collect();
        let native = study.native.value().and_then(mean_parts);
        Self { study, points, model: Model::fit(&fitted, study.subject.threads), native: native.map(total_time) }
    }

    fn name(&self) -> &'static str {
        self.study.subject.name
    }

    /// Returns (predicted, measured) at the points with this use, for one of the model's predictions.
    fn pairs(&self, of: LimitUse, predict: fn(&Model, f64) -> f64) -> Vec<(f64, f64)> {
        let those = self.points.iter().filter(|point| point.2 == of);
        let pair = |(cores, parts, _): &(f64, ResponseParts, LimitUse)| {
            Some((predict(&self.model?, *cores), total_time(*parts)))
        };
        those.filter_map(pair).collect()
    }
}

fn total_time(parts: ResponseParts) -> f64 {
    parts.iter().sum()
}
