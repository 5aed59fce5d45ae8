//! Experiment 6: the detector is asked at a rate while the robot's network becomes bad and good again: through the stub with a local original
//! that is kept ready, by the cloud alone, and by the original alone.

mod told;

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result};
use qos::Satisfaction;
use serde::{Deserialize, Serialize};

use crate::cells::{Cells, Measured};
use crate::examples::{DETECTOR, Where, Workshop};
use crate::place::{Class, Cost, Network, Place};
use crate::robot::{Node, Pace, Plan};
use crate::trace::{Request, Trace};

pub use told::section;

/// Requests per second: half of what the detector can answer on half a core.
const HERTZ: f64 = 2.0;
/// T_desire and T_max, seconds.
const TIMES: (f64, f64) = (0.4, 0.8);
/// Q at the beginning, Q_t, and the cap of Q.
const Q: (f64, f64, f64) = (15.0, 4.0, 16.0);
/// The robot: on a quarter of a core the detector takes 0.4 to 0.5 s, on half of one 0.2 s.
const CLASS: Class = Class::ULTRABOOK;

/// How many requests there are, and during which the network is bad.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Course {
    requests: usize,
    /// First and last ones, counted from 1.
    bad: Vec<(usize, usize)>,
    /// Seconds that answers are waited for after the last request.
    stragglers: f64,
}

impl Course {
    /// The published one.
    pub fn published() -> Self {
        Self {
            requests: 130,
            bad: vec![(24, 45), (75, 96), (111, 122)],
            stragglers: 10.0,
        }
    }

    /// One bad time.
    pub fn quick() -> Self {
        Self {
            requests: 18,
            bad: vec![(5, 12)],
            stragglers: 2.0,
        }
    }

    /// Before which requests the network becomes another one.
    fn changes(&self) -> Vec<(usize, Network)> {
        let both =
            |(first, last): &(usize, usize)| [(*first, Network::Bad), (last + 1, Network::Lan)];
        self.bad.iter().flat_map(both).collect()
    }
}

/// Who may answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum SetUp {
    /// The cloud, and an original on the robot that is kept ready.
    Stub,
    /// The cloud.
    Cloud,
    /// The original on the robot, without a stub.
    Local,
}

impl SetUp {
    /// As tables name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Stub => "stub, warm local original",
            Self::Cloud => "cloud alone",
            Self::Local => "local original alone",
        }
    }
}

/// One set-up, and what came out.
pub struct Run {
    set_up: SetUp,
    measured: Measured<(Trace, Cost)>,
}

/// All set-ups.
pub struct Runs {
    course: Course,
    runs: Vec<Run>,
}

/// Measures them; a quick evaluation has one bad time, and no run of the original alone.
pub fn measure(cells: &Cells, workshop: &Workshop, quick: bool) -> Result<Runs> {
    let (course, set_ups) = if quick {
        (Course::quick(), &[SetUp::Stub, SetUp::Cloud][..])
    } else {
        let all = &[SetUp::Stub, SetUp::Cloud, SetUp::Local][..];
        (Course::published(), all)
    };
    let mut runs = Vec::new();
    for set_up in set_ups {
        let name = format!("failover {}", set_up.name());
        let of = (&course, CLASS, HERTZ, TIMES);
        let measured = cells.measure(&name, &of, || one(workshop, *set_up, &course))?;
        runs.push(Run {
            set_up: *set_up,
            measured,
        });
    }
    Ok(Runs { course, runs })
}

fn one(workshop: &Workshop, set_up: SetUp, course: &Course) -> Result<(Trace, Cost)> {
    workshop.publishes(&DETECTOR)?;
    let directory = workshop.directory()?;
    let native = workshop.plan(&DETECTOR, Where::Native, directory.path())?;
    let mut plan = match set_up {
        SetUp::Local => native,
        SetUp::Stub => stub(workshop, "warm", Some(&native), directory.path())?,
        SetUp::Cloud => stub(workshop, "none", None, directory.path())?,
    };
    plan.pace = Pace::Rate {
        hertz: HERTZ,
        in_time: 2.0 * TIMES.1,
    };
    plan.most = course.requests;
    plan.give_up = course.stragglers;
    plan.changes = course.changes();
    plan.patience = 300.0;
    let place = Place::new(&workshop.daemon.address, CLASS, Network::Lan)?;
    place.runs(&plan, directory.path())
}

/// The stub's plan; with the original of `native` installed on the robot.
fn stub(workshop: &Workshop, local: &str, native: Option<&Plan>, directory: &Path) -> Result<Plan> {
    let mut plan = workshop.plan(&DETECTOR, Where::Outsourced, directory)?;
    if let Node::Stub {
        settings,
        environment,
        ..
    } = &mut plan.node
    {
        *settings = format!(
            "service = \"{}\"\nrequest = \"{} -> {}\"\nlocal = \"{local}\"\ndesire = {:?}\nmax = {:?}\nthreshold = {:?}\ninitial = {:?}\ncap = {:?}\nfallback_after = 300.0",
            DETECTOR.name, DETECTOR.request, DETECTOR.answer, TIMES.0, TIMES.1, Q.1, Q.0, Q.2
        );
        if let Some(native) = native {
            let workspace = installs(native, directory)?;
            environment.push(("CMAKE_PREFIX_PATH".to_owned(), workspace));
        }
    }
    Ok(plan)
}

/// Makes a workspace whose program is the original in its image's file system; where it is.
fn installs(native: &Plan, directory: &Path) -> Result<String> {
    let Node::Native {
        script,
        program,
        argv,
    } = &native.node
    else {
        anyhow::bail!("the plan of the original runs a stub");
    };
    // What comes after the node's program is given by the stub.
    let ends = argv
        .iter()
        .position(|word| word.ends_with(DETECTOR.executable));
    let words = &argv[..=ends.context("the node's program is among the words")?];
    let quoted: Vec<String> = words.iter().map(|word| format!("'{word}'")).collect();
    let workspace = directory.join("workspace");
    let launcher = workspace
        .join("lib")
        .join(DETECTOR.name)
        .join(DETECTOR.executable);
    std::fs::create_dir_all(launcher.parent().context("a directory")?)?;
    std::fs::write(workspace.join(".catkin"), "")?;
    // Where its Master is, the stub says in variables of the environment, which `env` adds to.
    let text = format!(
        "#!/bin/sh\nexport HOME=/root\nexec unshare --mount sh -c '{script}' sh {program} {} \"$@\"\n",
        quoted.join(" ")
    );
    std::fs::write(&launcher, text)?;
    std::fs::set_permissions(&launcher, PermissionsExt::from_mode(0o755))?;
    Ok(workspace.to_string_lossy().into_owned())
}

/// Q after each request by the algorithm of the crate `qos`, of the times of the robot's first answers, whoever gave them.
fn satisfaction(requests: &[Request]) -> Vec<f64> {
    let mut satisfaction = Satisfaction::new(Q.0, Q.1, Q.2);
    let [desire, max] = [TIMES.0, TIMES.1].map(Duration::from_secs_f64);
    let mut after = |request: &Request| {
        let time = request.response.map(Duration::from_secs_f64);
        satisfaction.observe(time, desire, max);
        satisfaction.q()
    };
    requests.iter().map(&mut after).collect()
}

/// Answered after T_max, or never.
fn is_late(request: &Request) -> bool {
    request.response.is_none_or(|response| response > TIMES.1)
}

/// Late requests from each time that the network becomes bad to the next.
fn late(course: &Course, requests: &[Request]) -> Vec<usize> {
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

    fn requests(responses: &[Option<f64>]) -> Vec<Request> {
        let one = |response: &Option<f64>| Request {
            response: *response,
            ..Request::default()
        };
        responses.iter().map(one).collect()
    }

    #[test]
    fn q_rises_by_two_or_one_and_is_halved() {
        let all = requests(&[Some(0.9), Some(0.8), Some(0.4), None, Some(0.1)]);
        assert_eq!(satisfaction(&all), [7.5, 8.5, 10.5, 5.25, 7.25]);
    }

    #[test]
    fn late_requests_are_counted_from_onset_to_onset() {
        let course = Course {
            requests: 6,
            bad: vec![(2, 3), (5, 5)],
            stragglers: 1.0,
        };
        let all = requests(&[None, Some(0.9), Some(0.1), None, Some(0.1), Some(2.0)]);
        assert_eq!(late(&course, &all), [2, 1]);
    }

    #[test]
    fn the_network_is_good_again_after_the_last_bad_request() {
        assert_eq!(
            Course::quick().changes(),
            [(5, Network::Bad), (13, Network::Lan)]
        );
        assert_eq!(Course::published().changes().len(), 6);
    }

    #[test]
    fn the_original_is_installed_without_its_arguments() {
        let place = tempfile::tempdir().expect("a directory");
        let words = [
            "A=b c",
            "/opt/lib/object_detector/object_detector_node",
            "__name:=x",
        ];
        let node = Node::Native {
            script: "exec chroot /root \"$@\"".to_owned(),
            program: "/usr/bin/env".to_owned(),
            argv: words.map(str::to_owned).to_vec(),
        };
        let workspace = launcher(node, place.path()).expect("it is written");
        assert!(
            workspace.contains("'A=b c' '/opt/lib/object_detector/object_detector_node' \"$@\"")
        );
        assert!(!workspace.contains("__name"), "{workspace}");
    }

    fn launcher(node: Node, directory: &Path) -> Result<String> {
        let plan = serde_json::json!({
            "server": "", "node": node, "recording": "", "request": "", "left_out": [], "answer": "", "tells_pose": false,
            "timing": null, "map": null, "pace": "one_by_one", "every": 1, "most": 1, "give_up": 1.0, "patience": 1.0,
        });
        let workspace = installs(&serde_json::from_value(plan)?, directory)?;
        let path = Path::new(&workspace).join("lib/object_detector/object_detector_node");
        Ok(std::fs::read_to_string(path)?)
    }
}
