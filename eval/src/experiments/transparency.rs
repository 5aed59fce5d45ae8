//! Experiment 1: packages give the same answers on the robot and through the stub, and the robot's application is not
//! modified.

use std::collections::BTreeMap;

use anyhow::Result;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::application;
use crate::cells::{CachedResult, RunCache};
use crate::examples::{ALL, DISPARITY, EvalFixtures, EvalPackage, ExecutionSite, LASER_SLAM, Origin, PEOPLE};
use crate::place::{NetworkProfile, RobotHardware};
use crate::robot::RequestPacing;
use crate::section::{AGAIN, Section, Table};
use crate::trace::{MapGrid, Trace};
use crate::words::{digits, or_dash};

/// A fast robot, because answers are compared and not times.
const FAST: RobotHardware = RobotHardware { cores: 1.0, memory: 4 << 30 };
/// Number of runs on the robot, which show the variation of a package between its own runs; and that of a quick
/// evaluation.
const NATIVES: [usize; 2] = [3, 2];
/// Seconds of the drive that `rosbag play` plays; and those of a quick evaluation.
const PLAYED: [f64; 2] = [20.0, 4.0];

/// Runs of one package: several on the robot and one through the stub.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ComparedRuns {
    natives: Vec<Trace>,
    outsourced: Trace,
    /// Files of the robot's application, with their SHA-256 before and after.
    application: Vec<(String, String, String)>,
}

/// Results by package and application.
pub struct TransparencyRuns {
    compared: Vec<(ComparedPair, CachedResult<ComparedRuns>)>,
}

/// A package, and the application that uses it.
#[derive(Debug, Clone, PartialEq)]
struct ComparedPair {
    package: String,
    application: RobotApplication,
}

/// Application of the robot.
#[derive(Debug, Clone, Copy, PartialEq)]
enum RobotApplication {
    /// The node of this evaluation.
    Own,
    /// `rosbag play` and `rosbag record` of Debian.
    Rosbag,
}

impl RobotApplication {
    fn name(self) -> &'static str {
        match self {
            Self::Own => "the evaluation's node",
            Self::Rosbag => "rosbag",
        }
    }

    /// Returns its files with their SHA-256.
    fn checksums(self) -> Result<Vec<(String, String)>> {
        match self {
            Self::Rosbag => application::checksums(),
            Self::Own => {
                let program = std::fs::read("/proc/self/exe")?;
                let sum = format!("{:x}", Sha256::digest(program));
                Ok(vec![("eval".to_owned(), sum)])
            }
        }
    }
}

/// Measures all packages; a quick evaluation measures two, with at most `most` requests each.
pub fn measure(cells: &RunCache, workshop: &EvalFixtures, most: Option<usize>) -> Result<TransparencyRuns> {
    let mut compared = Vec::new();
    // One package of each origin shows that everything works.
    let own = match most {
        Some(_) => vec![LASER_SLAM, DISPARITY],
        None => [&ALL[..], &[PEOPLE, DISPARITY]].concat(),
    };
    let own = own.into_iter().map(|example| (example, RobotApplication::Own));
    for (example, application) in own.chain([(LASER_SLAM, RobotApplication::Rosbag)]) {
        let pair = ComparedPair { package: package_title(&example), application };
        let name = format!("transparency {} {}", example.name, application.name());
        let requests = most.unwrap_or(example.requests).min(example.requests);
        let seconds = PLAYED[usize::from(most.is_some())];
        let times = NATIVES[usize::from(most.is_some())];
        let measured = cells.measure(&name, &(requests, seconds, times), || {
            workshop.publish(&example)?;
            let before = application.checksums()?;
            let run = |at: ExecutionSite| -> Result<Trace> {
                let robot = (FAST, NetworkProfile::Lan);
                let ran = workshop.run(&example, at, robot, |plan| {
                    plan.most = requests;
                    if application == RobotApplication::Rosbag {
                        plan.pace = RequestPacing::Played(seconds);
                    }
                });
                Ok(ran?.0)
            };
            let natives = (0..times).map(|_| run(ExecutionSite::Native));
            let natives = natives.collect::<Result<_>>()?;
            let outsourced = run(ExecutionSite::Outsourced)?;
            let after = application.checksums()?.into_iter();
            let application = before.into_iter().zip(after);
            Ok(ComparedRuns {
                natives,
                outsourced,
                application: application.map(|((file, before), (_, after))| (file, before, after)).collect(),
            })
        })?;
        compared.push((pair, measured));
    }
    Ok(TransparencyRuns { compared })
}

/// Returns a package's name in the report.
fn package_title(example: &EvalPackage) -> String {
    match example.origin {
        Origin::Checkout => example.name.to_owned(),
        Origin::Debian => format!("{}/{} of Debian", example.name, example.executable),
    }
}

/// Differences between runs.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Difference {
    /// Requests that both runs answered.
    both: usize,
    /// Answers among them that are equal byte by byte.
    equal: usize,
    /// Answers among them with equal boxes in any order, for answers that are lists of boxes; `None` for other answers.
    boxes: Option<usize>,
    /// Largest distance between positions, in metres.
    distance: Option<f64>,
    /// Largest fraction of a map's cells that differ.
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

    /// Combines several comparisons.
    fn combine(all: impl Iterator<Item = Self>) -> Self {
        all.fold(Self::default(), |sum, one| Self {
            both: sum.both + one.both,
            equal: sum.equal + one.equal,
            boxes: match (sum.boxes, one.boxes) {
                (Some(sum), Some(one)) => Some(sum + one),
                (sum, one) => sum.or(one),
            },
            distance: largest(sum.distance, one.distance),
            map: largest(sum.map, one.map),
        })
    }

    /// Compares all pairs of runs.
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
    match (one, other) {
        (Some(one), Some(other)) => Some(one.max(other)),
        (one, other) => one.or(other),
    }
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

/// Creates the section of the report.
pub fn section(runs: &TransparencyRuns) -> Section {
    let mut section = Section::new(1, "transparency", "Unmodified packages answer the same");
    section.published = "The publication's packages and robot applications were not modified; their results are said \
        to be the same."
        .to_owned();
    let done = runs.compared.iter().filter_map(|(_, compared)| compared.value());
    let times = done.map(|compared| compared.natives.len()).max().unwrap_or(0);
    section.differs =
        vec![
        format!("Each package is asked the same requests {times} times on the robot, and through the stub: what the \
            runs on the robot differ by is the package's own difference from run to run."),
        "Two packages are Debian's own, as they are installed from there: people_detect of opencv_apps looks for \
         pedestrians in a video of opencv-doc and answers with boxes, stereo_image_proc looks for disparities in a \
         window that moves over a photographed plant of opencv-doc (Middlebury's Aloe). The others are those of \
         examples/, compiled when they are pushed.".to_owned(),
        "The robot's application is once the evaluation's own node, and once rosbag play and rosbag record as Debian \
         packages them, which play the drive at its own rate and write the answers down; the same files run in both \
         set-ups.".to_owned(),
        "The order of messages of different topics is not kept by the stub's link (small ones go in turns), as ROS \
         does not keep it: each topic has a connection of its own. A node that takes whatever odometry came last \
         answers differently from run to run; these take that which was stamped with the scan's time.".to_owned(),
    ];
    let mut answers = Table::new(
        "Answers to the same requests",
        "package | the robot's application | compared | answered by both | equal to the byte | \
         equal but for the order of boxes | largest distance of positions, m | cells of the map that differ, %",
    );
    let mut files = Table::new(
        "The robot's application, before and after its run",
        "asked | file | SHA-256 before | SHA-256 after",
    );
    for (pair, measured) in &runs.compared {
        let name = format!("{}, asked by {}", pair.package, pair.application.name());
        let Some(compared) = measured.require(&mut section, &name, AGAIN) else {
            continue;
        };
        for trace in compared.natives.iter().chain([&compared.outsourced]) {
            section.note_early_end(format!("{name}: a run to its end"), trace);
        }
        let own = Difference::compare_pairs(&compared.natives);
        let natives = compared.natives.iter();
        let through = Difference::combine(natives.map(|native| Difference::compare(native, &compared.outsourced)));
        let published = "published: the same, without figures".to_owned();
        for (name, difference) in [("native runs", own), ("native and stub", through)] {
            let said = |value| or_dash(value, digits);
            answers.push([
                pair.package.clone(),
                pair.application.name().to_owned(),
                name.to_owned(),
                difference.both.to_string(),
                difference.equal.to_string(),
                or_dash(difference.boxes, |boxes| boxes.to_string()),
                said(difference.distance),
                said(difference.map.map(|share| 100.0 * share)),
            ]);
        }
        answers.rows.last_mut().into_iter().for_each(|row| {
            row[2] = format!("{} ({published})", row[2]);
        });
        section.findings.push(finding(pair, own, through));
        let late = count_late_answers(&compared.natives[0], &compared.outsourced);
        section.findings.extend((late > 0 && through.equal < through.both).then(|| {
            format!(
                "{}: messages at the beginning that were answered on the robot and not through the stub: {late}. A \
                 package whose answers build on those before begins elsewhere then, and its later answers differ, too.",
                pair.package
            )
        }));
        for (file, before, after) in &compared.application {
            files.push([pair.package.clone(), file.clone(), before.clone(), after.clone()]);
        }
        let changed = compared.application.iter();
        let changed: Vec<&str> =
            changed.filter(|(_, before, after)| before != after).map(|(file, _, _)| file.as_str()).collect();
        section.findings.push(if changed.is_empty() {
            format!(
                "Not one byte of the robot's application ({}) differs between the set-ups of {}.",
                pair.application.name(),
                pair.package
            )
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
    let name = format!("{}, asked by {}", pair.package, pair.application.name());
    if through.both == 0 {
        return format!("{name}: nothing was answered both on the robot and through the stub.");
    }
    if through.both == through.equal {
        return format!(
            "{name}: all {} answers that both gave, in comparisons with each run on the robot, are the same through \
             the stub, to the byte.",
            through.both
        );
    }
    if through.boxes == Some(through.both) {
        return format!(
            "{name}: all {} answers that both gave, in comparisons with each run on the robot, hold the same boxes \
             through the stub. {} of them are equal to the byte; the others have the boxes in another order, as some \
             runs on the robot have ({} of {} equal to the byte): the package's threads find them in whatever order.",
            through.both, through.equal, own.equal, own.both
        );
    }
    let words = if through.is_within(own) { "within" } else { "NOT within" };
    format!(
        "{name}: {} of {} answers through the stub are equal to the byte, which is {words} what runs on the robot \
         differ by ({} of {}).",
        through.equal, through.both, own.equal, own.both
    )
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
        ComparedPair { package: "a".to_owned(), application: RobotApplication::Rosbag }
    }

    #[test]
    fn differences_are_counted_and_measured() {
        let one = trace(&[(1, 0.0), (2, 1.0), (3, 2.0)]);
        let other = trace(&[(1, 0.0), (5, 1.5), (3, 2.0)]);
        assert_eq!(Difference::compare(&one, &other), difference(3, 2, 0.5));
        let all = Difference::compare_pairs(&[one.clone(), other, one]);
        assert_eq!(all, difference(9, 7, 0.5));
    }

    #[test]
    fn boxes_in_another_order_are_counted_apart() {
        let mut one = trace(&[(1, 0.0), (2, 0.0), (3, 0.0)]);
        for (request, boxes) in one.requests.iter_mut().zip([7, 8, 9]) {
            request.boxes = Some(boxes);
        }
        let mut other = one.clone();
        other.requests[1].digest = Some(5);
        other.requests[2].digest = Some(6);
        other.requests[2].boxes = Some(10);
        let found = Difference::compare(&one, &other);
        assert_eq!((found.both, found.equal, found.boxes), (3, 1, Some(2)));
        let sum = Difference::combine([found, found].into_iter());
        assert_eq!(sum.boxes, Some(4));
    }

    #[test]
    fn answers_are_compared_by_their_stamps() {
        let one = trace(&[(1, 0.0), (2, 1.0), (3, 2.0)]);
        let mut other = one.clone();
        other.requests.remove(1);
        assert_eq!(Difference::compare(&one, &other), difference(2, 2, 0.0));
    }

    #[test]
    fn requests_that_only_the_robot_answered_at_first_are_counted() {
        let native = trace(&[(1, 0.0), (2, 1.0), (3, 2.0)]);
        let mut outsourced = native.clone();
        assert_eq!(count_late_answers(&native, &outsourced), 0);
        outsourced.requests.remove(0);
        assert_eq!(count_late_answers(&native, &outsourced), 1);
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
        let compared = |after: &str| ComparedRuns {
            natives: vec![trace(&[(1, 0.0)]); 2],
            outsourced: trace(&[(1, 0.0)]),
            application: vec![("/play".to_owned(), "12".to_owned(), after.to_owned())],
        };
        let told = |after: &str| {
            let compared = vec![(pair(), CachedResult::Done(compared(after)))];
            section(&TransparencyRuns { compared }).findings[1].clone()
        };
        assert!(told("12").contains("Not one byte"));
        assert!(told("13").contains("CHANGED"), "{}", told("13"));
    }
}
