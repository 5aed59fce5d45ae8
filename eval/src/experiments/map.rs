//! Experiment 7: a drive is played to a small robot at its own rate and, as in the publication, at a third of it: the
//! maps, their errors against a reference, and the number of processed scans. A simulated drive adds a true path.

mod picture;

use anyhow::{Result, anyhow};
use serde::{Deserialize, Serialize};

use crate::cells::{CachedResult, RunCache};
use crate::examples::{EvalFixtures, EvalPackage, ExecutionSite, InputRecording, LASER_SLAM, LASER_SLAM_SIMULATED};
use crate::place::{NetworkProfile, RobotHardware, RunCost};
use crate::plots::{self, Series};
use crate::recording::Recording;
use crate::robot::RequestPacing;
use crate::section::{AGAIN, Figure, MissingMeasurement, Section, Table};
use crate::statistics::trajectory_error;
use crate::trace::{MapGrid, Trace};
use crate::words::{digits, or_dash, percent};

/// Topic of the reference in the recording.
const REFERENCE: &str = "/ground_truth";
/// Rate of the publication.
const SLOWLY: f64 = 0.33;

/// Ratio of distances up to which they count as equal.
const ALIKE: f64 = 1.2;

/// A drive, and the reference for its errors.
struct Drive {
    /// Prefix of figure ids.
    id: &'static str,
    /// Package, with its recording.
    example: EvalPackage,
    /// Title in tables and captions.
    title: &'static str,
    /// Origin of the path on [`REFERENCE`].
    whose: &'static str,
    /// Short form for sentences and column heads.
    reference: &'static str,
    /// Rates at which the drive is played, and the names of the runs on the robot and through the stub.
    plays: &'static [(f64, &'static str, &'static str)],
}

/// The real drive has no independent ground truth.
const DRIVES: [Drive; 2] = [
    Drive {
        id: "real",
        example: LASER_SLAM,
        title: "a real drive",
        whose: "MRPT's own SLAM, afterwards",
        reference: "reference",
        plays: &[
            (1.0, "native, own rate", "stub, own rate"),
            (SLOWLY, "native, 0.33 of its rate", "stub, 0.33 of its rate"),
        ],
    },
    Drive {
        id: "simulated",
        example: LASER_SLAM_SIMULATED,
        title: "a simulated drive",
        whose: "the simulator's exact path",
        reference: "truth",
        plays: &[(1.0, "native, simulated drive", "stub, simulated drive")],
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

/// Results of all plays.
pub struct MapRuns {
    plays: Vec<(String, CachedResult<MapPlay>)>,
}

impl MapRuns {
    /// Returns the plays of one drive that were attempted.
    fn for_drive<'a>(&'a self, drive: &Drive) -> impl Iterator<Item = &'a (String, CachedResult<MapPlay>)> {
        let plays = drive.plays;
        self.plays.iter().filter(move |(name, _)| {
            plays.iter().any(|(_, native, stub)| [native, stub].iter().any(|one| *one == name))
        })
    }
}

/// Measures all drives; a quick evaluation plays the real drive at its own rate, at most `most` scans of it.
pub fn measure(cells: &RunCache, workshop: &EvalFixtures, most: Option<usize>) -> Result<MapRuns> {
    let mut plays = Vec::new();
    let drives = if most.is_some() { &DRIVES[..1] } else { &DRIVES };
    for drive in drives {
        // Created first, because both runs need it at the same time.
        if let Err(error) = workshop.recording(drive.example.input) {
            let why = format!("{error:#}");
            let names = drive.plays.iter().flat_map(|(_, native, stub)| [native, stub]);
            plays.extend(names.map(|name| ((*name).to_owned(), CachedResult::Missing(why.clone()))));
            continue;
        }
        let all = if most.is_some() { 1 } else { drive.plays.len() };
        for (speed, native, stub) in &drive.plays[..all] {
            // Both robots drive at the same time: each has its own share of the processor, and together with the cloud
            // they need less than two cores.
            let play = |name: &str, at: ExecutionSite| measure_play(cells, workshop, drive, (name, at), *speed, most);
            let both = std::thread::scope(|scope| {
                let beside = scope.spawn(|| play(stub, ExecutionSite::Outsourced));
                let native = play(native, ExecutionSite::Native);
                let stub = beside.join().unwrap_or_else(|_| Err(anyhow!("the stub's robot panicked")));
                [native, stub]
            });
            for (name, play) in [native, stub].into_iter().zip(both) {
                plays.push(((*name).to_owned(), play?));
            }
        }
    }
    Ok(MapRuns { plays })
}

fn measure_play(
    cells: &RunCache,
    workshop: &EvalFixtures,
    drive: &Drive,
    (name, at): (&str, ExecutionSite),
    speed: f64,
    most: Option<usize>,
) -> Result<CachedResult<MapPlay>> {
    cells.measure(&format!("map {name}"), &(RobotHardware::PI, speed, most), || {
        let input = drive.example.input;
        let truth = Recording::read(&workshop.recording(input)?)?.positions(REFERENCE);
        let robot = (RobotHardware::PI, NetworkProfile::Wifi);
        let (trace, cost) = workshop.run(&drive.example, at, robot, |plan| {
            plan.pace = RequestPacing::Recorded(speed);
            plan.most = most.unwrap_or(match input {
                InputRecording::Simulated => drive.example.requests,
                _ => usize::MAX,
            });
            plan.patience = 1200.0;
        })?;
        Ok(MapPlay { trace, cost, truth })
    })
}

/// Creates the section of the report.
pub fn section(runs: &MapRuns) -> Result<Section> {
    let mut section = Section::new(7, "map", "The map of a drive");
    section.published = "Fig. 8 of the publication: a real robot drives, and its map is made on the robot and in the \
        cloud; the recording was also played at 0.33 of its rate."
        .to_owned();
    section.differs = vec![
        format!("The reference of all errors of the real drive is the path by {}, of the same recording: there is no \
            independent ground truth of this drive, so that what both get wrong is not seen.", DRIVES[0].whose),
        format!("The simulated drive is there for an error against a true path: {}. It is no robot's, its scans and \
            odometry are a simulator's (MRPT's simul.rawlog, the first {} scans, 80 m that end close to where they \
            began), played once at its own rate.", DRIVES[1].whose, DRIVES[1].example.requests),
        "Paths are compared after one is turned and moved onto the other, as they begin nowhere in common (absolute \
         trajectory error).".to_owned(),
        "The robot is a recording of MRPT, played at its own rate to a robot of the class Pi, by Wi-Fi (5 ms each way, \
         more or less 4 ms, 40 Mbit/s, one packet in a hundred lost). The native robot and the stub's drive at the \
         same time, in places of their own.".to_owned(),
    ];
    for drive in &DRIVES {
        // A quick evaluation does not play every drive.
        if runs.for_drive(drive).next().is_none() {
            continue;
        }
        add_drive(&mut section, runs, drive)?;
        add_findings(&mut section, runs, drive);
    }
    Ok(section)
}

/// Adds a drive's table, paths and maps.
fn add_drive(section: &mut Section, runs: &MapRuns, drive: &Drive) -> Result<()> {
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
    for (name, play) in runs.for_drive(drive) {
        let Some(play) = play.require(section, name, AGAIN) else {
            continue;
        };
        let (trace, estimate) = (&play.trace, play.trace.trajectory());
        let error = trajectory_error(&estimate, &play.truth);
        let metres = |value| or_dash(value, digits);
        table.push([
            name.clone(),
            trace.requests.len().to_string(),
            trace.answered_count().to_string(),
            percent(Some(processed_share(trace))),
            metres(error.as_ref().map(|error| error.rmse)),
            metres(error.as_ref().map(|error| error.max)),
            match drive.example.input {
                InputRecording::Simulated => "none".to_owned(),
                _ => "drawn only".to_owned(),
            },
        ]);
        section.note_early_end(format!("{name}: to its end"), trace);
        if paths.is_empty() && !play.truth.is_empty() {
            let last = trace.requests.last().map_or(0.0, |last| last.stamp);
            let driven = play.truth.iter().filter(|(at, _, _)| *at <= last);
            paths.push(path_series(drive.whose, &driven.copied().collect::<Vec<_>>()));
        }
        paths.push(path_series(name, &estimate));
        maps.extend(trace.map.as_ref().map(|map| (name.as_str(), map)));
    }
    section.tables.push(table);
    section.add_drawing(
        format!("paths-{}", drive.id),
        format!("Where the robot was, by each: {}", drive.title),
        plots::map("laser_slam", "x, m", "y, m", &paths)?,
    );
    if !maps.is_empty() {
        let (names, grids): (Vec<&str>, Vec<&MapGrid>) = maps.into_iter().unzip();
        let caption = format!(
            "The maps of {}, two in a row: {}. All show the same place; the bars are {} m long.",
            drive.title,
            names.join("; "),
            picture::BAR
        );
        match picture::draw_maps(&grids) {
            Ok(drawn) => section.figures.push(Figure::png(format!("maps-{}", drive.id), caption, drawn)),
            Err(error) => section.missing.push(MissingMeasurement::new(
                format!("the maps of {}", drive.title),
                format!("{error:#}"),
                "look at what the node printed",
            )),
        }
    }
    Ok(())
}

fn add_findings(section: &mut Section, runs: &MapRuns, drive: &Drive) {
    let of = |name: &str| {
        let (_, play) = runs.plays.iter().find(|(one, _)| one == name)?;
        let play = play.value()?;
        let error = trajectory_error(&play.trace.trajectory(), &play.truth);
        Some((&play.trace, error.map(|error| error.rmse)))
    };
    let said = |error: Option<f64>| {
        error.map_or_else(
            || "without a path to compare".to_owned(),
            |error| format!("{} m from the {}, RMS", digits(error), drive.reference),
        )
    };
    for (speed, native, stub) in drive.plays {
        let (Some((alone, error)), Some((through, stubs_error))) = (of(native), of(stub)) else {
            continue;
        };
        let farther = error.zip(stubs_error).is_some_and(|(alone, stub)| stub > alone * ALIKE);
        let worse = if has_fewer_scans(through, alone) {
            "; fewer through the stub is worse than hoped: what the network loses and delays comes to more than what \
             its processor saves"
        } else if farther {
            "; the greater distance through the stub is worse than hoped, and not explained by the share: of one run \
             each, it may be the package's own difference between one choice of scans and another"
        } else {
            ""
        };
        let (error, stubs_error) = (said(error), said(stubs_error));
        let rate = match *speed {
            1.0 => "its own rate".to_owned(),
            speed => format!("{speed} of its own rate"),
        };
        let [alone, through] = [alone, through].map(|trace| percent(Some(processed_share(trace))));
        section.findings.push(format!(
            "Of {}, at {rate}, the robot works at {alone} of the scans by itself ({error}), and at {through} through \
             the stub ({stubs_error}){worse}.",
            drive.title
        ));
    }
}

/// Returns the fraction of scans that were processed.
fn processed_share(trace: &Trace) -> f64 {
    trace.answered_count() as f64 / trace.requests.len().max(1) as f64
}

/// Returns whether fewer scans were processed through the stub, by more than one scan and by more than one per cent.
fn has_fewer_scans(through: &Trace, alone: &Trace) -> bool {
    let all = alone.requests.len().max(through.requests.len()) as f64;
    all * (processed_share(alone) - processed_share(through)) > f64::max(1.5, all / 100.0)
}

fn path_series(name: &str, path: &[(f64, f64, f64)]) -> Series {
    Series { name: name.to_owned(), points: path.iter().map(|(_, x, y)| (*x, *y)).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::RequestSample;
    use crate::words::assert_tells;

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

    #[test]
    fn scans_that_were_not_worked_at_are_counted() {
        let half = play(&[Some([0.0, 0.0, 0.0]), None, Some([2.0, 0.0, 0.0]), None]);
        let runs = MapRuns { plays: vec![("native, own rate".to_owned(), CachedResult::Done(half))] };
        let section = section(&runs).expect("a section");
        assert_eq!(section.tables[0].rows[0][1..4], ["4", "2", "50.0 %"].map(str::to_owned));
    }

    #[test]
    fn a_stub_that_works_at_fewer_scans_is_told() {
        let here = Some([0.0, 0.0, 0.0]);
        let whole = play(&[here, Some([1.0, 0.0, 0.0]), here, here]);
        let half = play(&[here, None, here, None]);
        let [native, stub] = [DRIVES[0].plays[1].1, DRIVES[0].plays[1].2].map(str::to_owned);
        let runs = MapRuns { plays: vec![(native, CachedResult::Done(whole)), (stub, CachedResult::Done(half))] };
        let section = section(&runs).expect("a section");
        assert_eq!(section.findings.len(), 1);
        let told = &section.findings[0];
        for words in ["at 0.33", "100.0 % of the scans by itself (", "50.0 % through the stub (", "worse than hoped"] {
            assert_tells(told, words);
        }
    }

    #[test]
    fn one_scan_is_no_difference() {
        let of = |answered: usize, all: usize| {
            let mut poses = vec![Some([0.0, 0.0, 0.0]); answered];
            poses.resize(all, None);
            play(&poses).trace
        };
        assert!(!has_fewer_scans(&of(221, 222), &of(222, 222)));
        assert!(!has_fewer_scans(&of(3, 4), &of(4, 4)));
        assert!(!has_fewer_scans(&of(997, 1000), &of(1000, 1000)));
        assert!(has_fewer_scans(&of(219, 222), &of(222, 222)));
        assert!(!has_fewer_scans(&of(222, 222), &of(150, 222)));
        assert_eq!(percent(Some(processed_share(&of(221, 222)))), "99.5 %");
    }

    #[test]
    fn a_stub_that_is_farther_off_is_told() {
        let straight = play(&[Some([0.0, 0.0, 0.0]), Some([1.0, 0.0, 0.0])]);
        let stretched = play(&[Some([0.0, 0.0, 0.0]), Some([3.0, 0.0, 0.0])]);
        let (_, native, stub) = DRIVES[1].plays[0];
        let told = |native_run: &MapPlay, stub_run: &MapPlay| {
            let runs = [(native, native_run), (stub, stub_run)];
            let runs = runs.map(|(name, run)| (name.to_owned(), CachedResult::Done(run.clone())));
            let plays = runs.to_vec();
            section(&MapRuns { plays }).expect("a section").findings[0].clone()
        };
        assert!(told(&straight, &stretched).contains("worse than hoped"));
        assert!(!told(&stretched, &straight).contains("worse than hoped"));
    }

    #[test]
    fn an_error_against_a_true_path_is_told_as_such() {
        let whole = play(&[Some([0.0, 0.0, 0.0]), Some([1.0, 0.0, 0.0])]);
        let (_, native, stub) = DRIVES[1].plays[0];
        let runs =
            MapRuns { plays: [native, stub].map(|name| (name.to_owned(), CachedResult::Done(whole.clone()))).to_vec() };
        let section = section(&runs).expect("a section");
        // A drive that was not played does not appear.
        assert_eq!(section.tables.len(), 1);
        assert_eq!(section.tables[0].rows.len(), 2);
        let told = &section.findings[0];
        for words in ["a simulated drive, at its own rate,", "(0.00 m from the truth, RMS)"] {
            assert_tells(told, words);
        }
    }
}
