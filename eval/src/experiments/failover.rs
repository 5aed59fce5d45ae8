//! Experiment 6: the detector gets requests at a fixed rate while the robot's network is degraded at times: through the
//! stub with a warm and with a cold local original, from the cloud alone, and from the original alone.

mod report;

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result};
use qos::Satisfaction;
use serde::{Deserialize, Serialize};

use crate::cells::{RunCache, Runs};
use crate::examples::{DETECTOR, EvalFixtures, ExecutionSite};
use crate::place::{NetworkProfile, RobotHardware, RobotSandbox, RunCost};
use crate::robot::{NodeUnderTest, RequestPacing, RobotPlan};
use crate::section::About;
use crate::trace::{RequestSample, Trace};

pub use report::section;

/// The experiment.
pub const ABOUT: About = About {
    number: 6,
    id: "failover",
    title: "A network that becomes bad and good again",
    published: "Fig. 7 of the publication: response times of 130 requests while the network is bad during requests \
        24-45, 75-96 and 111-122: the local original takes over within a few requests, and hands back. No mean and no \
        share is published.",
    differs: &[
        "object_detector stands in for SSD. Q stays below a cap here, so that two late requests in a row always \
        suffice (the published algorithm has none).",
    ],
};

/// Requests per second: half of what the detector can answer on half a core.
const HERTZ: f64 = 2.0;
/// T_desire and T_max, in seconds.
const TIMES: (f64, f64) = (0.4, 0.8);
/// Initial value of Q, Q_t, and the maximum of Q.
const Q: (f64, f64, f64) = (15.0, 4.0, 16.0);
/// The robot: on a quarter of a core the detector takes 0.4 to 0.5 s, on half a core 0.2 s.
const CLASS: RobotHardware = RobotHardware::ULTRABOOK;

/// Number of requests, and the phases in which the network is degraded.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FaultSchedule {
    requests: usize,
    /// First and last request of each phase, counted from 1.
    bad: Vec<(usize, usize)>,
    /// Seconds to wait for answers after the last request.
    stragglers: f64,
}

impl FaultSchedule {
    pub fn from_publication() -> Self {
        Self { requests: 130, bad: vec![(24, 45), (75, 96), (111, 122)], stragglers: 10.0 }
    }

    pub fn quick() -> Self {
        Self { requests: 18, bad: vec![(5, 12)], stragglers: 2.0 }
    }

    fn network_changes(&self) -> Vec<(usize, NetworkProfile)> {
        let both = |(first, last): &(usize, usize)| [(*first, NetworkProfile::Bad), (last + 1, NetworkProfile::Lan)];
        self.bad.iter().flat_map(both).collect()
    }
}

/// Programs that may answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum FailoverSetUp {
    Stub,
    /// The cloud, and an original on the robot that is started when it is needed.
    Cold,
    Cloud,
    Local,
}

impl FailoverSetUp {
    pub fn name(self) -> &'static str {
        match self {
            Self::Stub => "stub, warm local original",
            Self::Cold => "stub, cold local original",
            Self::Cloud => "cloud alone",
            Self::Local => "local original alone",
        }
    }
}

/// Results of all set-ups.
pub struct FailoverRuns {
    course: FaultSchedule,
    runs: Vec<(FailoverSetUp, Runs<(Trace, RunCost)>)>,
}

/// Measures all set-ups; a quick evaluation has one degraded phase, and neither a cold original nor one alone.
pub fn measure(cells: &RunCache, workshop: &EvalFixtures, quick: bool) -> Result<FailoverRuns> {
    use FailoverSetUp::{Cloud, Cold, Local, Stub};
    let (course, set_ups) = if quick {
        (FaultSchedule::quick(), &[Stub, Cloud][..])
    } else {
        (FaultSchedule::from_publication(), &[Stub, Cold, Cloud, Local][..])
    };
    let mut runs = Vec::new();
    for set_up in set_ups {
        let (name, of) = (format!("failover {}", set_up.name()), (&course, CLASS, HERTZ, TIMES));
        runs.push((*set_up, cells.repeat(&name, &of, || run_once(workshop, *set_up, &course))?));
    }
    Ok(FailoverRuns { course, runs })
}

fn run_once(workshop: &EvalFixtures, set_up: FailoverSetUp, course: &FaultSchedule) -> Result<(Trace, RunCost)> {
    workshop.publish(&DETECTOR)?;
    let directory = workshop.directory()?;
    let native = workshop.plan(&DETECTOR, ExecutionSite::Native, directory.path())?;
    let mut plan = match set_up {
        FailoverSetUp::Local => native,
        FailoverSetUp::Stub => stub_plan(workshop, "warm", Some(&native), directory.path())?,
        FailoverSetUp::Cold => stub_plan(workshop, "cold", Some(&native), directory.path())?,
        FailoverSetUp::Cloud => stub_plan(workshop, "none", None, directory.path())?,
    };
    plan.pace = RequestPacing::Rate { hertz: HERTZ, in_time: 2.0 * TIMES.1 };
    plan.most = course.requests;
    plan.give_up = course.stragglers;
    plan.changes = course.network_changes();
    plan.patience = 300.0;
    let place = RobotSandbox::new(&workshop.daemon.address, CLASS, NetworkProfile::Lan)?;
    place.run(&plan, directory.path())
}

/// Returns the plan of the stub; the original of `native` is installed on the robot.
fn stub_plan(workshop: &EvalFixtures, local: &str, native: Option<&RobotPlan>, directory: &Path) -> Result<RobotPlan> {
    let mut plan = workshop.plan(&DETECTOR, ExecutionSite::Outsourced, directory)?;
    if let NodeUnderTest::Stub { settings, environment, .. } = &mut plan.node {
        *settings = format!(
            "service = \"{}\"\nrequest = \"{} -> {}\"\nlocal = \"{local}\"\ndesire = {:?}\nmax = {:?}\nthreshold = \
             {:?}\ninitial = {:?}\ncap = {:?}\nfallback_after = 300.0",
            DETECTOR.name, DETECTOR.request, DETECTOR.answer, TIMES.0, TIMES.1, Q.1, Q.0, Q.2
        );
        if let Some(native) = native {
            let workspace = install_original(native, directory)?;
            environment.push(("CMAKE_PREFIX_PATH".to_owned(), workspace));
        }
    }
    Ok(plan)
}

/// Creates a workspace whose program runs the original in its image's file system; returns its path.
fn install_original(native: &RobotPlan, directory: &Path) -> Result<String> {
    let NodeUnderTest::Native { script, program, argv } = &native.node else {
        anyhow::bail!("the plan of the original runs a stub");
    };
    // Arguments after the node's program come from the stub.
    let ends = argv.iter().position(|word| word.ends_with(DETECTOR.executable));
    let words = &argv[..=ends.context("the node's program is among the words")?];
    let quoted: Vec<String> = words.iter().map(|word| format!("'{word}'")).collect();
    let workspace = directory.join("workspace");
    let launcher = workspace.join("lib").join(DETECTOR.name).join(DETECTOR.executable);
    std::fs::create_dir_all(launcher.parent().context("a directory")?)?;
    std::fs::write(workspace.join(".catkin"), "")?;
    // The stub sets the Master's address in environment variables, which `env` extends.
    let text = format!(
        "#!/bin/sh\nexport HOME=/root\nexec unshare --mount sh -c '{script}' sh {program} {} \"$@\"\n",
        quoted.join(" ")
    );
    std::fs::write(&launcher, text)?;
    std::fs::set_permissions(&launcher, PermissionsExt::from_mode(0o755))?;
    Ok(workspace.to_string_lossy().into_owned())
}

/// Computes Q after each request with the algorithm of the crate `qos`, from the times of the robot's first answers,
/// whoever gave them.
fn replay_satisfaction(requests: &[RequestSample]) -> Vec<f64> {
    let mut satisfaction = Satisfaction::new(Q.0, Q.1, Q.2);
    let [desire, max] = [TIMES.0, TIMES.1].map(Duration::from_secs_f64);
    let mut after = |request: &RequestSample| {
        let time = request.response.map(Duration::from_secs_f64);
        satisfaction.observe(time, desire, max);
        satisfaction.q()
    };
    requests.iter().map(&mut after).collect()
}

/// Returns whether a request was answered after T_max, or never.
fn is_late(request: &RequestSample) -> bool {
    request.response.is_none_or(|response| response > TIMES.1)
}

/// Counts the late requests from each onset of degradation to the next.
fn count_late(course: &FaultSchedule, requests: &[RequestSample]) -> Vec<usize> {
    let starts = course.bad.iter().map(|(first, _)| first - 1);
    let ends = starts.clone().skip(1).chain([requests.len()]);
    let during = starts.zip(ends).map(|(start, end)| {
        let those = requests.get(start..end).unwrap_or_default();
        those.iter().filter(|request| is_late(request)).count()
    });
    during.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn test_requests(responses: &[Option<f64>]) -> Vec<RequestSample> {
        let one = |response: &Option<f64>| RequestSample { response: *response, ..RequestSample::default() };
        responses.iter().map(one).collect()
    }

    #[test]
    fn q_rises_by_two_or_one_and_is_halved() {
        let all = test_requests(&[Some(0.9), Some(0.8), Some(0.4), None, Some(0.1)]);
        assert_eq!(replay_satisfaction(&all), [7.5, 8.5, 10.5, 5.25, 7.25]);
    }

    #[test]
    fn late_requests_are_counted_from_onset_to_onset() {
        let course = FaultSchedule { requests: 6, bad: vec![(2, 3), (5, 5)], stragglers: 1.0 };
        let all = test_requests(&[None, Some(0.9), Some(0.1), None, Some(0.1), Some(2.0)]);
        assert_eq!(count_late(&course, &all), [2, 1]);
    }

    #[test]
    fn the_network_is_good_again_after_the_last_bad_request() {
        assert_eq!(FaultSchedule::quick().network_changes(), [(5, NetworkProfile::Bad), (13, NetworkProfile::Lan)]);
        assert_eq!(FaultSchedule::from_publication().network_changes().len(), 6);
    }

    #[test]
    fn the_original_is_installed_without_its_arguments() {
        let place = tempfile::tempdir().expect("a directory");
        let words = ["A=b c", "/opt/lib/object_detector/object_detector_node", "__name:=x"];
        let node = NodeUnderTest::Native {
            script: "exec chroot /root \"$@\"".to_owned(),
            program: "/usr/bin/env".to_owned(),
            argv: words.map(str::to_owned).to_vec(),
        };
        let workspace = launcher(node, place.path()).expect("it is written");
        assert!(workspace.contains("'A=b c' '/opt/lib/object_detector/object_detector_node' \"$@\""));
        assert!(!workspace.contains("__name"), "{workspace}");
    }

    fn launcher(node: NodeUnderTest, directory: &Path) -> Result<String> {
        let plan = crate::rehearsal::plan(directory, 1.0)?;
        let workspace = install_original(&RobotPlan { node, ..plan }, directory)?;
        let path = Path::new(&workspace).join("lib/object_detector/object_detector_node");
        Ok(std::fs::read_to_string(path)?)
    }
}
