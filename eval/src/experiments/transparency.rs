//! Experiment 1: packages give the same answers on the robot and through the stub, and the robot's application is not
//! modified.

use std::collections::BTreeMap;

use anyhow::Result;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::application;
use crate::cells::{RunCache, Runs};
use crate::examples::{ALL, DISPARITY, EvalFixtures, EvalPackage, ExecutionSite, LASER_SLAM, Origin, PEOPLE};
use crate::place::{NetworkProfile, RobotHardware};
use crate::robot::RequestPacing;
use crate::section::{About, Section, Table};
use crate::trace::{MapGrid, Trace};
use crate::words::{digits, or_dash};

/// A fast robot, because answers are compared and not times.
const FAST: RobotHardware = RobotHardware { cores: 1.0, memory: 4 << 30 };
/// Number of runs on the robot, which show the variation of a package between its own runs; and that of a quick
/// evaluation.
const NATIVES: [usize; 2] = [3, 2];
/// Seconds of the drive that `rosbag play` plays; and those of a quick evaluation.
const PLAYED: [f64; 2] = [20.0, 4.0];

/// The experiment.
pub const ABOUT: About = About {
    number: 1,
    id: "transparency",
    title: "Unmodified packages answer the same",
    published: "The publication's packages and robot applications were not modified; their results are said to be the \
        same.",
    differs: &[
        "Each package is asked the same requests several times on the robot, and through the stub: what the runs on \
         the robot differ by is the package's own difference from run to run.",
        "people_detect of opencv_apps (boxes around pedestrians in a video of opencv-doc) and stereo_image_proc \
         (disparities of Middlebury's Aloe) are Debian's own; the others are those of examples/.",
        "The robot's application is once the evaluation's own node, and once rosbag play and rosbag record as Debian \
         packages them, which play the drive at its own rate; the same files run in both set-ups.",
        "The order of messages of different topics is not kept by the stub's link, as ROS does not keep it: a node \
         that takes whatever odometry came last answers differently from run to run; these take that of the scan's \
         time.",
    ],
};

/// Runs of one package: several on the robot and one through the stub.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ComparedRuns {
    natives: Vec<Trace>,
    outsourced: Trace,
    /// Files of the robot's application, with their SHA-256 before and after.
    application: Vec<[String; 3]>,
}

/// Results by package and application.
pub struct TransparencyRuns(Vec<(ComparedPair, Runs<ComparedRuns>)>);

/// A package, and the application that uses it.
#[derive(Debug, Clone, PartialEq)]
struct ComparedPair {
    package: String,
    /// True if it is `rosbag play` and `rosbag record` of Debian, else it is the node of this evaluation.
    is_rosbag: bool,
}

impl ComparedPair {
    fn application(&self) -> &'static str {
        if self.is_rosbag { "rosbag" } else { "the evaluation's node" }
    }

    fn name(&self) -> String {
        format!("{}, asked by {}", self.package, self.application())
    }

    /// Returns the application's files with their SHA-256.
    fn checksums(&self) -> Result<Vec<(String, String)>> {
        if self.is_rosbag {
            return application::checksums();
        }
        let program = std::fs::read("/proc/self/exe")?;
        Ok(vec![("eval".to_owned(), format!("{:x}", Sha256::digest(program)))])
    }
}

/// Measures all packages; a quick evaluation measures two, with at most `most` requests each.
pub fn measure(cells: &RunCache, workshop: &EvalFixtures, most: Option<usize>) -> Result<TransparencyRuns> {
    // One package of each origin shows that everything works.
    let own = match most {
        Some(_) => vec![LASER_SLAM, DISPARITY],
        None => [&ALL[..], &[PEOPLE, DISPARITY]].concat(),
    };
    let own = own.into_iter().map(|example| (example, false));
    let (seconds, times) = (PLAYED[usize::from(most.is_some())], NATIVES[usize::from(most.is_some())]);
    let mut compared = Vec::new();
    for (example, is_rosbag) in own.chain([(LASER_SLAM, true)]) {
        let pair = ComparedPair { package: package_title(&example), is_rosbag };
        let requests = most.unwrap_or(example.requests).min(example.requests);
        let name = format!("transparency {} {}", example.name, pair.application());
        let measured = cells.measure(&name, &(requests, seconds, times), || {
            workshop.publish(&example)?;
            let before = pair.checksums()?;
            let run = |at: ExecutionSite| -> Result<Trace> {
                let ran = workshop.run(&example, at, (FAST, NetworkProfile::Lan), |plan| {
                    plan.most = requests;
                    if is_rosbag {
                        plan.pace = RequestPacing::Played(seconds);
                    }
                });
                Ok(ran?.0)
            };
            let natives = (0..times).map(|_| run(ExecutionSite::Native)).collect::<Result<_>>()?;
            let outsourced = run(ExecutionSite::Outsourced)?;
            let both = before.into_iter().zip(pair.checksums()?);
            let application = both.map(|((file, before), (_, after))| [file, before, after]).collect();
            Ok(ComparedRuns { natives, outsourced, application })
        })?;
        compared.push((pair, measured));
    }
    Ok(TransparencyRuns(compared))
}

fn package_title(example: &EvalPackage) -> String {
    match example.origin {
        Origin::Checkout => example.name.to_owned(),
        Origin::Debian => format!("{}/{} of Debian", example.name, example.executable),
    }
}

/// Differences between runs.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Difference {
    both: usize,
    equal: usize,
    /// Answers among them with equal boxes in any order, for answers that are lists of boxes; `None` for other answers.
    boxes: Option<usize>,
    /// Largest distance between positions, in metres.
    distance: Option<f64>,
    map: Option<f64>,
}

impl Difference {
    fn compare(one: &Trace, other: &Trace) -> Self {
        // Matched by stamp, because a robot that plays at its own rate may not get every answer.
        let key = |stamp: f64| (stamp * 1e6).round() as i64;
        let others: BTreeMap<i64, _> = other.requests.iter().map(|one| (key(one.stamp), one)).collect();
        let mut found = Self { map: one.map.as_ref().zip(other.map.as_ref()).map(differing_cells), ..Self::default() };
        for one in &one.requests {
            let Some(other) = others.get(&key(one.stamp)) else {
                continue;
            };
            let (Some(digest), Some(another)) = (one.digest, other.digest) else {
                continue;
            };
            found.both += 1;
            found.equal += usize::from(digest == another);
            if let (Some(one), Some(other)) = (one.boxes, other.boxes) {
                *found.boxes.get_or_insert(0) += usize::from(one == other);
            }
            if let (Some(one), Some(other)) = (one.pose, other.pose) {
                let distance = f64::hypot(one[0] - other[0], one[1] - other[1]);
                found.distance = largest(found.distance, Some(distance));
            }
        }
        found
    }

    fn combine(all: impl Iterator<Item = Self>) -> Self {
        all.fold(Self::default(), |sum, one| Self {
            both: sum.both + one.both,
            equal: sum.equal + one.equal,
            boxes: sum.boxes.map_or(one.boxes, |sum| Some(sum + one.boxes.unwrap_or(0))),
            distance: largest(sum.distance, one.distance),
            map: largest(sum.map, one.map),
        })
    }

    fn compare_pairs(runs: &[Trace]) -> Self {
        let pairs = runs.iter().enumerate();
        Self::combine(pairs.flat_map(|(at, one)| runs[at + 1..].iter().map(move |other| Self::compare(one, other))))
    }

    /// Returns whether these differences do not exceed `own`.
    fn is_within(self, own: Self) -> bool {
        let share = |of: Self| of.equal as f64 / of.both.max(1) as f64;
        share(self) >= share(own)
            && self.distance.unwrap_or(0.0) <= own.distance.unwrap_or(0.0)
            && self.map.unwrap_or(0.0) <= own.map.unwrap_or(0.0)
    }
}

fn largest(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    [one, other].into_iter().flatten().reduce(f64::max)
}

/// Returns the fraction of cells that differ; 1 if the maps differ in position or size.
fn differing_cells((one, other): (&MapGrid, &MapGrid)) -> f64 {
    let same = (one.width, one.height, one.origin) == (other.width, other.height, other.origin);
    if !same || one.cells.is_empty() {
        return 1.0;
    }
    let pairs = one.cells.iter().zip(&other.cells);
    let differ = pairs.filter(|(one, other)| one != other).count();
    differ as f64 / one.cells.len() as f64
}

pub fn section(runs: &TransparencyRuns) -> Section {
    let mut section = ABOUT.section();
    let mut answers = Table::new(
        "Answers to the same requests (published: the same, without figures)",
        "package | the robot's application | compared | answered by both | equal to the byte | \
         equal but for the order of boxes | largest distance of positions, m | cells of the map that differ, %",
    );
    let head = "asked | file | SHA-256 before | SHA-256 after";
    let mut files = Table::new("The robot's application, before and after its run", head);
    for (pair, measured) in &runs.0 {
        let Some(compared) = measured.require(&mut section, &pair.name()) else {
            continue;
        };
        for trace in compared.natives.iter().chain([&compared.outsourced]) {
            section.note_early_end(&pair.name(), trace);
        }
        let own = Difference::compare_pairs(&compared.natives);
        let natives = compared.natives.iter();
        let through = Difference::combine(natives.map(|native| Difference::compare(native, &compared.outsourced)));
        for (name, difference) in [("native runs", own), ("native and stub", through)] {
            answers.push([
                pair.package.clone(),
                pair.application().to_owned(),
                name.to_owned(),
                difference.both.to_string(),
                difference.equal.to_string(),
                or_dash(difference.boxes, |boxes| boxes.to_string()),
                or_dash(difference.distance, digits),
                or_dash(difference.map.map(|share| 100.0 * share), digits),
            ]);
        }
        section.findings.push(finding(pair, own, through));
        let late = count_late_answers(&compared.natives[0], &compared.outsourced);
        section.findings.extend((late > 0 && through.equal < through.both).then(|| {
            format!(
                "{}: {late} messages at the beginning were answered on the robot and not through the stub, which later \
                 answers build on.",
                pair.package
            )
        }));
        for file in &compared.application {
            files.push([&pair.package].into_iter().chain(file));
        }
        let changed = compared.application.iter().filter(|[_, before, after]| before != after);
        let changed: Vec<&str> = changed.map(|[file, ..]| file.as_str()).collect();
        section.findings.push(if changed.is_empty() {
            let (application, package) = (pair.application(), &pair.package);
            format!("Not one byte of the robot's application ({application}) differs between the set-ups of {package}.")
        } else {
            format!("The robot's application CHANGED while {} was compared: {}.", pair.package, changed.join(", "))
        });
    }
    section.tables.extend([answers, files]);
    section
}

/// Counts the requests at the beginning that were answered on the robot only.
fn count_late_answers(native: &Trace, outsourced: &Trace) -> usize {
    let answered = outsourced.requests.iter().find(|one| one.digest.is_some());
    let Some(first) = answered.map(|one| one.stamp) else {
        return 0;
    };
    let before = native.requests.iter();
    before.filter(|one| one.digest.is_some() && one.stamp + 1e-6 < first).count()
}

fn finding(pair: &ComparedPair, own: Difference, through: Difference) -> String {
    let Difference { both, equal, boxes, .. } = through;
    let words = if both == 0 {
        "nothing was answered both on the robot and through the stub".to_owned()
    } else if both == equal {
        format!("all {both} answers that both gave are the same through the stub, to the byte")
    } else if boxes == Some(both) {
        format!(
            "all {both} answers that both gave hold the same boxes through the stub, {equal} of them in the same order \
             (on the robot {} of {}): the package's threads find them in whatever order",
            own.equal, own.both
        )
    } else {
        let within = if through.is_within(own) { "within" } else { "NOT within" };
        format!(
            "{equal} of {both} answers through the stub are equal to the byte, which is {within} what runs on the \
             robot differ by ({} of {})",
            own.equal, own.both
        )
    };
    format!("{}: {words}.", pair.name())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::RequestSample;

    fn trace(answers: &[(u64, f64)]) -> Trace {
        let request = |(number, (digest, x)): (u32, &(u64, f64))| RequestSample {
            stamp: number.into(),
            digest: Some(*digest),
            pose: Some([*x, 0.0, 0.0]),
            ..RequestSample::default()
        };
        Trace { requests: (0..).zip(answers).map(request).collect(), ..Trace::default() }
    }

    fn difference(both: usize, equal: usize, distance: f64) -> Difference {
        Difference { both, equal, boxes: None, distance: Some(distance), map: None }
    }

    fn pair() -> ComparedPair {
        ComparedPair { package: "a".to_owned(), is_rosbag: true }
    }

    #[test]
    fn differences_are_counted_and_measured() {
        let one = trace(&[(1, 0.0), (2, 1.0), (3, 2.0)]);
        let other = trace(&[(1, 0.0), (5, 1.5), (3, 2.0)]);
        assert_eq!(Difference::compare(&one, &other), difference(3, 2, 0.5));
        assert_eq!(Difference::compare_pairs(&[one.clone(), other, one.clone()]), difference(9, 7, 0.5));
        // Answers are matched by their stamps.
        let mut fewer = one.clone();
        fewer.requests.remove(1);
        assert_eq!(Difference::compare(&one, &fewer), difference(2, 2, 0.0));
    }

    #[test]
    fn boxes_in_another_order_are_counted_apart() {
        let with_boxes = |answers: [(u64, u64); 3]| {
            let mut trace = trace(&answers.map(|(digest, _)| (digest, 0.0)));
            trace.requests.iter_mut().zip(answers).for_each(|(request, (_, boxes))| request.boxes = Some(boxes));
            trace
        };
        let (one, other) = (with_boxes([(1, 7), (2, 8), (3, 9)]), with_boxes([(1, 7), (5, 8), (6, 10)]));
        let found = Difference::compare(&one, &other);
        assert_eq!((found.both, found.equal, found.boxes), (3, 1, Some(2)));
        assert_eq!(Difference::combine([found, found].into_iter()).boxes, Some(4));
    }

    #[test]
    fn requests_that_only_the_robot_answered_at_first_are_counted() {
        let native = trace(&[(1, 0.0), (2, 1.0), (3, 2.0)]);
        let mut outsourced = native.clone();
        assert_eq!(count_late_answers(&native, &outsourced), 0);
        outsourced.requests.remove(0);
        outsourced.requests[0].digest = None;
        assert_eq!(count_late_answers(&native, &outsourced), 2);
    }

    #[test]
    fn cells_that_differ_are_a_share_of_all() {
        let map =
            |cells: &[i8]| MapGrid { width: 2, height: 2, resolution: 0.1, origin: [0.0, 0.0], cells: cells.to_vec() };
        let (one, other) = (map(&[0, 100, -1, 0]), map(&[0, 100, 0, 0]));
        assert_eq!(differing_cells((&one, &other)), 0.25);
        let elsewhere = MapGrid { origin: [1.0, 0.0], ..one.clone() };
        assert_eq!(differing_cells((&one, &elsewhere)), 1.0);
    }

    #[test]
    fn a_stub_that_answers_otherwise_is_told() {
        let alike = difference(3, 3, 0.0);
        assert!(finding(&pair(), alike, alike).contains("all 3"));
        assert!(finding(&pair(), alike, difference(3, 1, 1.0)).contains("NOT within"));
        let own = difference(3, 1, 1.0);
        assert!(finding(&pair(), own, difference(9, 3, 0.9)).contains("is within"));
        assert!(finding(&pair(), own, difference(3, 1, 1.1)).contains("NOT within"));
        assert!(finding(&pair(), own, Difference::default()).contains("nothing"));
        let boxes = |boxes: usize| Difference { boxes: Some(boxes), ..difference(3, 1, 0.0) };
        assert!(finding(&pair(), alike, boxes(3)).contains("hold the same boxes"));
        assert!(finding(&pair(), alike, boxes(2)).contains("NOT within"));
    }

    #[test]
    fn a_changed_application_is_told() {
        let told = |after: &str| {
            let compared = ComparedRuns {
                natives: vec![trace(&[(1, 0.0)]); 2],
                outsourced: trace(&[(1, 0.0)]),
                application: vec![["/play", "12", after].map(str::to_owned)],
            };
            section(&TransparencyRuns(vec![(pair(), Runs::from(compared))])).findings[1].clone()
        };
        assert!(told("12").contains("Not one byte"));
        assert!(told("13").contains("CHANGED"), "{}", told("13"));
    }
}
