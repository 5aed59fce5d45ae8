//! Experiment 7: a drive is played to a small robot at its own rate and, as in the publication, at a third of it: the
//! maps, their errors against a reference, and the number of processed scans. A simulated drive adds a true path.

mod picture;

use anyhow::{Result, anyhow};
use serde::{Deserialize, Serialize};

use crate::cells::{RunCache, Runs};
use crate::examples::{EvalFixtures, EvalPackage, ExecutionSite, InputRecording, LASER_SLAM, LASER_SLAM_SIMULATED};
use crate::place::{NetworkProfile, RobotHardware, RunCost};
use crate::plots::{self, Series};
use crate::recording::Recording;
use crate::robot::RequestPacing;
use crate::section::{About, Figure, Section, Table};
use crate::statistics::{TrajectoryError, trajectory_error};
use crate::trace::{MapGrid, Trace};
use crate::words::{count, digits, percent, spread};

/// Topic of the reference in the recording.
const REFERENCE: &str = "/ground_truth";

/// The experiment.
pub const ABOUT: About = About {
    number: 7,
    id: "map",
    title: "The map of a drive",
    published: "Fig. 8 of the publication: a real robot drives, and its map is made on the robot and in the cloud; the \
        recording was also played at 0.33 of its rate.",
    differs: &[
        "The real drive is a recording of MRPT; its reference is the path by MRPT's own SLAM, afterwards, so that what \
         both get wrong is not seen. The simulated one (MRPT's simul.rawlog, its first 760 scans, 80 m) has a true \
         path.",
        "Paths are compared after one is turned and moved onto the other (absolute trajectory error).",
        "The robot is of the class Pi, by Wi-Fi (5 ms each way, more or less 4 ms, 40 Mbit/s, one packet in a hundred \
         lost). The native robot and the stub's drive at the same time, in places of their own.",
    ],
};

/// A drive, and the reference for its errors.
struct Drive {
    id: &'static str,
    example: EvalPackage,
    title: &'static str,
    /// Origin of the path on [`REFERENCE`].
    whose: &'static str,
    /// Name of that path in column heads, and published figures.
    reference: &'static str,
    published: &'static str,
    /// Rates at which the drive is played, and the names of the runs on the robot and through the stub.
    plays: &'static [(f64, [&'static str; 2])],
}

/// The real drive has no independent ground truth.
const DRIVES: [Drive; 2] = [
    Drive {
        id: "real",
        example: LASER_SLAM,
        title: "a real drive",
        whose: "MRPT's own SLAM, afterwards",
        reference: "reference",
        published: "drawn only",
        plays: &[
            (1.0, ["native, own rate", "stub, own rate"]),
            (0.33, ["native, 0.33 of its rate", "stub, 0.33 of its rate"]),
        ],
    },
    Drive {
        id: "simulated",
        example: LASER_SLAM_SIMULATED,
        title: "a simulated drive",
        whose: "the simulator's exact path",
        reference: "truth",
        published: "none",
        plays: &[(1.0, ["native, simulated drive", "stub, simulated drive"])],
    },
];

/// One play of a drive.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct MapPlay {
    trace: Trace,
    cost: RunCost,
    /// Path of the drive's reference: seconds of the recording, x and y in metres.
    truth: Vec<(f64, f64, f64)>,
}

impl MapPlay {
    fn error(&self) -> Option<TrajectoryError> {
        trajectory_error(&self.trace.trajectory(), &self.truth)
    }
}

/// Results of all plays, by name.
pub struct MapRuns(Vec<(&'static str, Runs<MapPlay>)>);

impl MapRuns {
    fn find(&self, name: &str) -> Option<&Runs<MapPlay>> {
        self.0.iter().find(|(one, _)| *one == name).map(|(_, runs)| runs)
    }

    /// Returns the plays of one drive that were attempted.
    fn plays_of(&self, drive: &Drive) -> impl Iterator<Item = (&'static str, &Runs<MapPlay>)> {
        let names = drive.plays.iter().flat_map(|(_, names)| *names);
        names.filter_map(move |name| Some((name, self.find(name)?)))
    }
}

/// Measures all drives; a quick evaluation plays the real drive at its own rate, at most `most` scans of it.
pub fn measure(cells: &RunCache, workshop: &EvalFixtures, most: Option<usize>) -> Result<MapRuns> {
    let mut plays = Vec::new();
    let drives = if most.is_some() { &DRIVES[..1] } else { &DRIVES };
    for drive in drives {
        let rates = if most.is_some() { &drive.plays[..1] } else { drive.plays };
        // Created first, because both runs need it at the same time.
        if let Err(error) = workshop.recording(drive.example.input) {
            let names = rates.iter().flat_map(|(_, names)| *names);
            plays.extend(names.map(|name| (name, Runs::from_failure(format!("{error:#}")))));
            continue;
        }
        for (speed, names) in rates {
            let of = (RobotHardware::PI, speed, most);
            let play = |name: &str, at: ExecutionSite| {
                cells.repeat(&format!("map {name}"), &of, || play_drive(workshop, drive, at, *speed, most))
            };
            // Both robots drive at the same time: each has its own share of the processor, and together with the cloud
            // they need less than two cores.
            let both = std::thread::scope(|scope| {
                let beside = scope.spawn(|| play(names[1], ExecutionSite::Outsourced));
                let native = play(names[0], ExecutionSite::Native);
                [native, beside.join().unwrap_or_else(|_| Err(anyhow!("the stub's robot panicked")))]
            });
            for (name, play) in names.iter().zip(both) {
                plays.push((*name, play?));
            }
        }
    }
    Ok(MapRuns(plays))
}

fn play_drive(
    workshop: &EvalFixtures,
    drive: &Drive,
    at: ExecutionSite,
    speed: f64,
    most: Option<usize>,
) -> Result<MapPlay> {
    let input = drive.example.input;
    let truth = Recording::read(&workshop.recording(input)?)?.positions(REFERENCE);
    let all = if input == InputRecording::Simulated { drive.example.requests } else { usize::MAX };
    let (trace, cost) = workshop.run(&drive.example, at, (RobotHardware::PI, NetworkProfile::Wifi), |plan| {
        plan.pace = RequestPacing::Recorded(speed);
        plan.most = most.unwrap_or(all);
        plan.give_up = 10.0;
        plan.patience = 1200.0;
    })?;
    Ok(MapPlay { trace, cost, truth })
}

/// Creates the section of the report. A drive that was not played does not appear.
pub fn section(runs: &MapRuns) -> Section {
    let mut section = ABOUT.section();
    for drive in DRIVES.iter().filter(|drive| runs.plays_of(drive).next().is_some()) {
        add_drive(&mut section, runs, drive);
        add_findings(&mut section, runs, drive);
    }
    section
}

fn add_drive(section: &mut Section, runs: &MapRuns, drive: &Drive) {
    let mut table = Table::new(
        format!("laser_slam on a robot of the class Pi: {}", drive.title),
        &format!(
            "where and how fast | scans | worked at | share | distance from the {0}, RMS, m | \
             distance from the {0}, most, m | published (Fig. 8)",
            drive.reference
        ),
    );
    let mut paths = Vec::new();
    let mut maps: Vec<(&str, &MapGrid)> = Vec::new();
    for (name, plays) in runs.plays_of(drive) {
        let Some(first) = plays.require(section, name) else {
            continue;
        };
        table.push([
            name.to_owned(),
            count(plays.figure(|play| Some(play.trace.requests.len() as f64))),
            count(plays.figure(|play| Some(play.trace.answered_count() as f64))),
            percent(plays.figure(processed_share)),
            spread(plays.figure(|play| Some(play.error()?.rmse)), digits),
            spread(plays.figure(|play| Some(play.error()?.max)), digits),
            drive.published.to_owned(),
        ]);
        plays.done.iter().for_each(|play| section.note_early_end(name, &play.trace));
        if paths.is_empty() && !first.truth.is_empty() {
            let last = first.trace.requests.last().map_or(0.0, |last| last.stamp);
            let driven = first.truth.iter().filter(|(at, _, _)| *at <= last);
            paths.push(path_series(drive.whose, driven));
        }
        paths.push(path_series(name, &first.trace.trajectory()));
        maps.extend(first.trace.map.as_ref().map(|map| (name, map)));
    }
    section.tables.push(table);
    section.add_drawing(
        format!("paths-{}", drive.id),
        format!("Where the robot was, by the first run of each: {}", drive.title),
        plots::map("laser_slam", "x, m", "y, m", &paths),
    );
    if maps.is_empty() {
        return;
    }
    let (names, grids): (Vec<&str>, Vec<&MapGrid>) = maps.into_iter().unzip();
    let title = format!("The maps of {}", drive.title);
    match picture::draw_maps(&grids) {
        Ok(drawn) => {
            let (names, bar) = (names.join("; "), picture::BAR);
            let caption =
                format!("{title}, two in a row: {names}. All show the same place; the bars are {bar} m long.");
            section.figures.push(Figure::png(format!("maps-{}", drive.id), caption, drawn));
        }
        Err(error) => section.add_missing(title, format!("{error:#}"), "look at what the node printed"),
    }
}

fn add_findings(section: &mut Section, runs: &MapRuns, drive: &Drive) {
    for (speed, [native, stub]) in drive.plays {
        let (Some(native), Some(stub)) = (runs.find(native), runs.find(stub)) else {
            continue;
        };
        let [alone, through] = [native, stub].map(|plays| plays.figure(processed_share));
        let [error, stubs_error] = [native, stub].map(|plays| plays.figure(|play| Some(play.error()?.rmse)));
        let is_farther = stubs_error.zip(error).is_some_and(|(stub, alone)| stub.is_above(alone));
        let worse = if native.compare(stub, count_fewer_scans).is_some_and(|fewer| fewer.median > 0.0) {
            "; fewer through the stub is worse than hoped: what the network loses and delays comes to more than what \
             its processor saves"
        } else if is_farther {
            "; the greater distance through the stub is worse than hoped"
        } else {
            ""
        };
        let [alone, through] = [alone, through].map(percent);
        let [error, stubs_error] = [error, stubs_error].map(|error| spread(error, digits));
        section.findings.push(format!(
            "Of {}, at {speed} of its own rate, the robot works at {alone} of the scans by itself ({error} m from the \
             {reference}, RMS), and at {through} through the stub ({stubs_error} m){worse}.",
            drive.title,
            reference = drive.reference
        ));
    }
}

/// Returns the fraction of scans that were processed.
fn processed_share(play: &MapPlay) -> Option<f64> {
    Some(play.trace.answered_count() as f64 / play.trace.requests.len().max(1) as f64)
}

/// Returns how many scans fewer were processed through the stub; 0 unless more than one, and more than one per cent.
fn count_fewer_scans(alone: &MapPlay, through: &MapPlay) -> Option<f64> {
    let all = alone.trace.requests.len().max(through.trace.requests.len()) as f64;
    let fewer = all * (processed_share(alone)? - processed_share(through)?);
    Some(if fewer > f64::max(1.5, all / 100.0) { fewer } else { 0.0 })
}

fn path_series<'a>(name: &str, path: impl IntoIterator<Item = &'a (f64, f64, f64)>) -> Series {
    Series::new(name, path.into_iter().map(|(_, x, y)| (*x, *y)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::RequestSample;
    use crate::words::assert_tells;

    const HERE: Option<[f64; 3]> = Some([0.0, 0.0, 0.0]);

    fn play(poses: &[Option<[f64; 3]>]) -> MapPlay {
        let request = |(number, pose): (u32, &Option<[f64; 3]>)| RequestSample {
            stamp: number.into(),
            response: pose.map(|_| 0.1),
            pose: *pose,
            ..RequestSample::default()
        };
        MapPlay {
            trace: Trace { requests: (0..).zip(poses).map(request).collect(), ..Trace::default() },
            cost: RunCost::default(),
            truth: (0..4).map(|at| (f64::from(at), f64::from(at), 0.0)).collect(),
        }
    }

    /// Returns the section of a drive that was played natively and through the stub.
    fn section_of(names: [&'static str; 2], plays: [&MapPlay; 2]) -> Section {
        let plays = names.into_iter().zip(plays.map(|play| Runs::from(play.clone())));
        section(&MapRuns(plays.collect()))
    }

    #[test]
    fn scans_that_were_not_worked_at_are_counted_and_told() {
        let whole = play(&[HERE, Some([1.0, 0.0, 0.0]), HERE, HERE]);
        let half = play(&[HERE, None, HERE, None]);
        let section = section_of(DRIVES[0].plays[1].1, [&whole, &half]);
        assert_eq!(section.tables[0].rows[1][1..4], ["4", "2", "50.0 %"]);
        assert_eq!(section.findings.len(), 1);
        for words in ["at 0.33", "100.0 % of the scans by itself (", "50.0 % through the stub (", "worse than hoped"] {
            assert_tells(&section.findings[0], words);
        }
    }

    #[test]
    fn one_scan_is_no_difference() {
        let of = |answered: usize, all: usize| {
            let mut poses = vec![HERE; answered];
            poses.resize(all, None);
            play(&poses)
        };
        let fewer = |through: (usize, usize), alone: (usize, usize)| {
            count_fewer_scans(&of(alone.0, alone.1), &of(through.0, through.1)).expect("scans") > 0.0
        };
        assert!(!fewer((221, 222), (222, 222)) && !fewer((3, 4), (4, 4)) && !fewer((997, 1000), (1000, 1000)));
        assert!(fewer((219, 222), (222, 222)) && !fewer((222, 222), (150, 222)));
    }

    #[test]
    fn errors_are_told_by_their_reference() {
        let straight = play(&[HERE, Some([1.0, 0.0, 0.0])]);
        let stretched = play(&[HERE, Some([3.0, 0.0, 0.0])]);
        let told = |plays| section_of(DRIVES[1].plays[0].1, plays).findings[0].clone();
        assert_tells(&told([&straight, &stretched]), "a simulated drive, at 1 of its own rate,");
        assert_tells(&told([&straight, &stretched]), "(0.00 m from the truth, RMS)");
        assert_tells(&told([&straight, &stretched]), "worse than hoped");
        assert!(!told([&stretched, &straight]).contains("worse than hoped"));
        // A drive that was not played does not appear.
        assert_eq!(section_of(DRIVES[1].plays[0].1, [&straight, &straight]).tables.len(), 1);
    }
}
