//! Part of experiment 2: packages in the cloud with several limits of cores, a model of their response times that is
//! fitted to some of them, its error at the others, and its predictions for clouds with more cores than this machine.

mod model;
mod report;

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};

use crate::cells::{RunCache, Runs};
use crate::examples::{DETECTOR, EvalFixtures, EvalPackage, ExecutionSite, LASER_SLAM};
use crate::place::{NetworkProfile, RobotHardware, RunCost};
use crate::robot::NodeUnderTest;
use crate::section::About;
use crate::statistics::Spread;
use crate::trace::{ResponseParts, Trace};

use model::Model;
pub use report::section;

/// Network between robot and servant.
const NETWORK: NetworkProfile = NetworkProfile::Lan;

/// The experiment.
pub const ABOUT: About = About {
    number: 2,
    id: "cores",
    title: "What more cores would give: a model, and its error at points that were held back",
    published: "Fig. 5 of the publication: outsourced to a cloud of many cores, packages answered up to 25 times as \
        fast as on a Raspberry Pi.",
    differs: &[
        "Each part of the response time has a model of its own, overhead + work / min(cores, parallel), fitted to \
         means of whole runs, because only means follow a limit of a fraction of a core: the kernel stops the program \
         for a part of each tenth of a second.",
        "The cautious prediction: more cores than were measured give nothing more. The bound, for several threads: all \
         work of the computation is divided among all cores as among the first ones.",
        "Robot, daemon and servant share this machine's cores. The model knows no other speed of cores, no GPU, no \
         other robots and no other network than the LAN.",
    ],
};

/// A program, and the limits at which it is measured.
#[derive(Debug, Clone, Copy)]
pub struct Subject {
    example: EvalPackage,
    name: &'static str,
    /// Arguments of its node in addition to the example's own.
    arguments: &'static [&'static str],
    threads: usize,
    fitted: &'static [f64],
    /// Some limits between the fitted ones, and one above them, because the predictions lie above them as well.
    held_back: &'static [f64],
    requests: usize,
}

const SLAM: Subject = Subject {
    example: LASER_SLAM,
    name: "laser_slam",
    arguments: &[],
    threads: 1,
    fitted: &[0.25, 0.5, 1.0, 1.25],
    held_back: &[0.35, 0.75, 1.5],
    requests: 60,
};
const SUBJECTS: [Subject; 3] = [
    SLAM,
    Subject { example: DETECTOR, name: "object_detector, 1 thread", requests: 16, ..SLAM },
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
const QUICK: Subject = Subject { fitted: &[0.25, 0.5, 1.0], held_back: &[0.75], requests: 6, ..SLAM };

/// One run in the cloud.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CoreLimitRun {
    enforced: f64,
    trace: Trace,
    cost: RunCost,
}

/// All runs of one program.
pub struct ProgramStudy {
    subject: Subject,
    /// Runs on the robot itself, a Raspberry Pi in this evaluation.
    native: Runs<Trace>,
    runs: Vec<(f64, Runs<CoreLimitRun>)>,
}

/// Measures all programs; a quick evaluation measures one at few limits.
pub fn measure(cells: &RunCache, workshop: &EvalFixtures, quick: bool) -> Result<Vec<ProgramStudy>> {
    let subjects = if quick { &[QUICK][..] } else { &SUBJECTS };
    subjects.iter().map(|subject| measure_study(cells, workshop, *subject)).collect()
}

fn measure_study(cells: &RunCache, workshop: &EvalFixtures, subject: Subject) -> Result<ProgramStudy> {
    let name = format!("cores {}", subject.name);
    let native = cells.repeat(&format!("{name} native"), &subject.requests, || {
        let robot = (RobotHardware::PI, NETWORK);
        let ran = workshop.run(&subject.example, ExecutionSite::Native, robot, |plan| plan.most = subject.requests);
        Ok(ran?.0)
    })?;
    let mut limits = [subject.fitted, subject.held_back].concat();
    limits.sort_by(f64::total_cmp);
    let measure = |cores: f64| {
        let of = (cores, subject.requests, subject.arguments);
        let measured = cells.repeat(&format!("{name} {cores}"), &of, || measure_outsourced(workshop, &subject, cores));
        Ok((cores, measured?))
    };
    Ok(ProgramStudy { subject, native, runs: limits.into_iter().map(measure).collect::<Result<_>>()? })
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
    let enforced = servant["enforced"]["cpus"].as_f64().context("the servant's cores are not limited")?;
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
    Fitted,
    /// Not used for fitting, but between limits that were.
    Inside,
    /// Not used for fitting, and above all limits that were.
    Beyond,
}

impl LimitUse {
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

/// Measurements at a limit.
struct LimitPoint {
    cores: f64,
    purpose: LimitUse,
    runs: Vec<ResponseParts>,
}

impl LimitPoint {
    fn part(&self, index: usize) -> Option<Spread> {
        Spread::from_values(&self.runs.iter().map(|parts| parts[index]).collect::<Vec<_>>())
    }

    fn whole(&self) -> Option<Spread> {
        Spread::from_values(&self.runs.iter().map(|parts| parts.iter().sum()).collect::<Vec<f64>>())
    }
}

/// Model and measurements of one program.
struct ProgramFit<'a> {
    study: &'a ProgramStudy,
    points: Vec<LimitPoint>,
    model: Option<Model>,
    /// Mean response time on the robot itself, in seconds.
    native: Option<Spread>,
}

impl<'a> ProgramFit<'a> {
    fn from_study(study: &'a ProgramStudy) -> Self {
        let point = |(cores, measured): &(f64, Runs<CoreLimitRun>)| {
            let runs: Vec<ResponseParts> = measured.done.iter().filter_map(|run| run.trace.mean_parts()).collect();
            let purpose = study.subject.use_of_limit(*cores);
            (!runs.is_empty()).then_some(LimitPoint { cores: *cores, purpose, runs })
        };
        let points: Vec<LimitPoint> = study.runs.iter().filter_map(point).collect();
        let fitted = points.iter().filter(|point| point.purpose == LimitUse::Fitted);
        let fitted: Vec<(f64, ResponseParts)> =
            fitted.flat_map(|point| point.runs.iter().map(|parts| (point.cores, *parts))).collect();
        let model = Model::fit(&fitted, study.subject.threads);
        Self { study, points, model, native: study.native.figure(|trace| Some(trace.mean_parts()?.iter().sum())) }
    }

    fn name(&self) -> &'static str {
        self.study.subject.name
    }

    /// Returns the relative errors of one of the model's predictions at the points with this use.
    fn errors(&self, purpose: LimitUse, predict: fn(&Model, f64) -> f64) -> Vec<f64> {
        let those = self.points.iter().filter(|point| point.purpose == purpose);
        those
            .filter_map(|point| Some(predict(self.model.as_ref()?, point.cores) / point.whole()?.median - 1.0))
            .collect()
    }
}
