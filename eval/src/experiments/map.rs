//! Experiment 7: a drive is played at its own rate to a small robot, and at a third of it as in the publication: the maps, how far they are
//! from a reference, and how many scans were worked at. A simulated drive beside it has a true path.

mod picture;

use anyhow::{Result, anyhow};
use serde::{Deserialize, Serialize};

use crate::cells::{Cells, Measured};
use crate::examples::{Example, Input, LASER_SLAM, LASER_SLAM_SIMULATED, Where, Workshop};
use crate::place::{Class, Cost, Network, Place};
use crate::plots::{self, Series};
use crate::recording::Recording;
use crate::robot::Pace;
use crate::section::{Figure, Missing, Section, Table};
use crate::statistics::trajectory_error;
use crate::trace::{Grid, Trace};
use crate::words::{digits, percent};

/// Where the reference is, in the recording.
const REFERENCE: &str = "/ground_truth";
/// As in the publication.
const SLOWLY: f64 = 0.33;

/// Distances that are not this many times as great count as alike.
const ALIKE: f64 = 1.2;

/// A drive, and what its errors are measured by.
struct Drive {
    /// Of figures.
    id: &'static str,
    /// With its recording.
    example: Example,
    /// In tables and captions.
    title: &'static str,
    /// What is at [`REFERENCE`].
    whose: &'static str,
    /// Short, in sentences and heads of columns.
    reference: &'static str,
    /// How fast it is played, and what the runs on the robot and through the stub are called.
    plays: &'static [(f64, &'static str, &'static str)],
}

/// There is no independent ground truth of the real one.
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

/// One play of the drive.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Play {
    trace: Trace,
    cost: Cost,
    /// Seconds of the recording, x and y in metres, by the drive's reference.
    truth: Vec<(f64, f64, f64)>,
}

/// All of them.
pub struct Runs {
    plays: Vec<(String, Measured<Play>)>,
}

impl Runs {
    /// Those of one drive, as far as they were tried.
    fn of<'a>(&'a self, drive: &Drive) -> impl Iterator<Item = &'a (String, Measured<Play>)> {
        let plays = drive.plays;
        self.plays.iter().filter(move |(name, _)| {
            plays
                .iter()
                .any(|(_, native, stub)| [native, stub].iter().any(|one| *one == name))
        })
    }
}

/// Measures them; a quick evaluation the real drive at its own rate, at most so many scans of it.
pub fn measure(cells: &Cells, workshop: &Workshop, most: Option<usize>) -> Result<Runs> {
    let mut plays = Vec::new();
    let drives = if most.is_some() {
        &DRIVES[..1]
    } else {
        &DRIVES
    };
    for drive in drives {
        // What both need is made before both need it.
        if let Err(error) = workshop.recording(drive.example.input) {
            let why = format!("{error:#}");
            let names = drive
                .plays
                .iter()
                .flat_map(|(_, native, stub)| [native, stub]);
            plays.extend(names.map(|name| ((*name).to_owned(), Measured::Missing(why.clone()))));
            continue;
        }
        let all = if most.is_some() { 1 } else { drive.plays.len() };
        for (speed, native, stub) in &drive.plays[..all] {
            // The two robots drive at the same time: each has its own part of the processor, and together with the cloud they need less
            // than two cores.
            let play =
                |name: &str, at: Where| one(cells, workshop, drive, (name, at), *speed, most);
            let both = std::thread::scope(|scope| {
                let beside = scope.spawn(|| play(stub, Where::Outsourced));
                let native = play(native, Where::Native);
                let stub = beside
                    .join()
                    .unwrap_or_else(|_| Err(anyhow!("the stub's robot panicked")));
                [native, stub]
            });
            for (name, play) in [native, stub].into_iter().zip(both) {
                plays.push(((*name).to_owned(), play?));
            }
        }
    }
    Ok(Runs { plays })
}

fn one(
    cells: &Cells,
    workshop: &Workshop,
    drive: &Drive,
    (name, at): (&str, Where),
    speed: f64,
    most: Option<usize>,
) -> Result<Measured<Play>> {
    cells.measure(&format!("map {name}"), &(Class::PI, speed, most), || {
        let directory = workshop.directory()?;
        let mut plan = workshop.plan(&drive.example, at, directory.path())?;
        plan.pace = Pace::Recorded(speed);
        plan.most = most.unwrap_or(match drive.example.input {
            Input::Simulated => drive.example.requests,
            _ => usize::MAX,
        });
        plan.patience = 1200.0;
        let truth = Recording::read(&plan.recording)?.positions(REFERENCE);
        let place = Place::new(&workshop.daemon.address, Class::PI, Network::Wifi)?;
        let (trace, cost) = place.runs(&plan, directory.path())?;
        Ok(Play { trace, cost, truth })
    })
}

/// What the report says.
pub fn section(runs: &Runs) -> Result<Section> {
    let mut section = Section::new(7, "map", "The map of a drive");
    section.published = "Fig. 8 of the publication: a real robot drives, and its map is made on the robot and in the cloud; the recording was also played at 0.33 of its rate.".to_owned();
    section.differs = vec![
        format!("The reference of all errors of the real drive is the path by {}, of the same recording: there is no independent ground truth of this drive, so that what both get wrong is not seen.", DRIVES[0].whose),
        format!("The simulated drive is there for an error against a true path: {}. It is no robot's, its scans and odometry are a simulator's (MRPT's simul.rawlog, the first {} scans, 80 m that end close to where they began), played once at its own rate.", DRIVES[1].whose, DRIVES[1].example.requests),
        "Paths are compared after one is turned and moved onto the other, as they begin nowhere in common (absolute trajectory error).".to_owned(),
        "The robot is a recording of MRPT, played at its own rate to a robot of the class Pi, by Wi-Fi (5 ms each way, more or less 4 ms, 40 Mbit/s, one packet in a hundred lost). The native robot and the stub's drive at the same time, in places of their own.".to_owned(),
    ];
    for drive in &DRIVES {
        // A quick evaluation does not play every drive.
        if runs.of(drive).next().is_none() {
            continue;
        }
        told(&mut section, runs, drive)?;
        findings(&mut section, runs, drive);
    }
    Ok(section)
}

/// A drive's table, its paths and its maps.
fn told(section: &mut Section, runs: &Runs, drive: &Drive) -> Result<()> {
    let mut table = Table::new(
        format!("laser_slam on a robot of the class Pi: {}", drive.title),
        [
            "where and how fast".to_owned(),
            "scans".to_owned(),
            "worked at".to_owned(),
            "share".to_owned(),
            format!("distance from the {}, RMS, m", drive.reference),
            format!("distance from the {}, most, m", drive.reference),
            "published (Fig. 8)".to_owned(),
        ],
    );
    let mut paths = Vec::new();
    let mut maps: Vec<(&str, &Grid)> = Vec::new();
    for (name, play) in runs.of(drive) {
        let play = match play {
            Measured::Done(play) => play,
            Measured::Missing(why) => {
                section.missing.push(Missing {
                    what: name.clone(),
                    why: why.clone(),
                    next: "run make eval again: what was measured stays".to_owned(),
                });
                continue;
            }
        };
        let (trace, estimate) = (&play.trace, play.trace.trajectory());
        let error = trajectory_error(&estimate, &play.truth);
        let metres = |value: Option<f64>| value.map_or_else(|| "–".to_owned(), digits);
        table.push([
            name.clone(),
            trace.requests.len().to_string(),
            trace.answered().to_string(),
            percent(Some(share(trace))),
            metres(error.as_ref().map(|error| error.rmse)),
            metres(error.as_ref().map(|error| error.max)),
            match drive.example.input {
                Input::Simulated => "none".to_owned(),
                _ => "drawn only".to_owned(),
            },
        ]);
        if let Some(why) = &trace.node_ended {
            section.missing.push(Missing::new(
                format!("{name}: to its end"),
                why,
                "look at what the node printed",
            ));
        }
        if paths.is_empty() && !play.truth.is_empty() {
            let last = trace.requests.last().map_or(0.0, |last| last.stamp);
            let driven = play.truth.iter().filter(|(at, _, _)| *at <= last);
            paths.push(series(drive.whose, &driven.copied().collect::<Vec<_>>()));
        }
        paths.push(series(name, &estimate));
        maps.extend(trace.map.as_ref().map(|map| (name.as_str(), map)));
    }
    section.tables.push(table);
    section.drawing(
        format!("paths-{}", drive.id),
        format!("Where the robot was, by each: {}", drive.title),
        plots::map("laser_slam", "x, m", "y, m", &paths)?,
    );
    if !maps.is_empty() {
        let (names, grids): (Vec<&str>, Vec<&Grid>) = maps.into_iter().unzip();
        let caption = format!(
            "The maps of {}, two in a row: {}. All show the same place; the bars are {} m long.",
            drive.title,
            names.join("; "),
            picture::BAR
        );
        match picture::maps(&grids) {
            Ok(drawn) => {
                section
                    .figures
                    .push(Figure::png(format!("maps-{}", drive.id), caption, drawn))
            }
            Err(error) => section.missing.push(Missing::new(
                format!("the maps of {}", drive.title),
                format!("{error:#}"),
                "look at what the node printed",
            )),
        }
    }
    Ok(())
}

fn findings(section: &mut Section, runs: &Runs, drive: &Drive) {
    let of = |name: &str| {
        let (_, play) = runs.plays.iter().find(|(one, _)| one == name)?;
        let play = play.done()?;
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
        let farther = error
            .zip(stubs_error)
            .is_some_and(|(alone, stub)| stub > alone * ALIKE);
        let worse = if fewer(through, alone) {
            "; fewer through the stub is worse than hoped: what the network loses and delays comes to more than what its processor saves"
        } else if farther {
            "; the greater distance through the stub is worse than hoped, and not explained by the share: of one run each, it may be the package's own difference between one choice of scans and another"
        } else {
            ""
        };
        let (error, stubs_error) = (said(error), said(stubs_error));
        let rate = match *speed {
            1.0 => "its own rate".to_owned(),
            speed => format!("{speed} of its own rate"),
        };
        let [alone, through] = [alone, through].map(|trace| percent(Some(share(trace))));
        section.findings.push(format!(
            "Of {}, at {rate}, the robot works at {alone} of the scans by itself ({error}), and at {through} through the stub ({stubs_error}){worse}.",
            drive.title
        ));
    }
}

/// The share of scans that were worked at.
fn share(trace: &Trace) -> f64 {
    trace.answered() as f64 / trace.requests.len().max(1) as f64
}

/// Whether fewer scans were worked at through the stub, by more than one and more than one in a hundred.
fn fewer(through: &Trace, alone: &Trace) -> bool {
    let all = alone.requests.len().max(through.requests.len()) as f64;
    all * (share(alone) - share(through)) > f64::max(1.5, all / 100.0)
}

fn series(name: &str, path: &[(f64, f64, f64)]) -> Series {
    Series {
        name: name.to_owned(),
        points: path.iter().map(|(_, x, y)| (*x, *y)).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::Request;

    fn play(poses: &[Option<[f64; 3]>]) -> Play {
        let request = |(number, pose): (u32, &Option<[f64; 3]>)| Request {
            stamp: number.into(),
            response: pose.map(|_| 0.1),
            pose: *pose,
            ..Request::default()
        };
        Play {
            trace: Trace {
                requests: (0..).zip(poses).map(request).collect(),
                ..Trace::default()
            },
            cost: Cost::default(),
            truth: (0..4)
                .map(|at| (f64::from(at), f64::from(at), 0.0))
                .collect(),
        }
    }

    #[test]
    fn scans_that_were_not_worked_at_are_counted() {
        let half = play(&[Some([0.0, 0.0, 0.0]), None, Some([2.0, 0.0, 0.0]), None]);
        let runs = Runs {
            plays: vec![("native, own rate".to_owned(), Measured::Done(half))],
        };
        let section = section(&runs).expect("a section");
        assert_eq!(
            section.tables[0].rows[0][1..4],
            ["4", "2", "50.0 %"].map(str::to_owned)
        );
    }

    #[test]
    fn a_stub_that_works_at_fewer_scans_is_told() {
        let here = Some([0.0, 0.0, 0.0]);
        let whole = play(&[here, Some([1.0, 0.0, 0.0]), here, here]);
        let half = play(&[here, None, here, None]);
        let [native, stub] = [DRIVES[0].plays[1].1, DRIVES[0].plays[1].2].map(str::to_owned);
        let runs = Runs {
            plays: vec![
                (native, Measured::Done(whole)),
                (stub, Measured::Done(half)),
            ],
        };
        let section = section(&runs).expect("a section");
        assert_eq!(section.findings.len(), 1);
        let told = &section.findings[0];
        for words in [
            "at 0.33",
            "100.0 % of the scans by itself (",
            "50.0 % through the stub (",
            "worse than hoped",
        ] {
            assert!(told.contains(words), "{words}: {told}");
        }
    }

    #[test]
    fn one_scan_is_no_difference() {
        let of = |answered: usize, all: usize| {
            let mut poses = vec![Some([0.0, 0.0, 0.0]); answered];
            poses.resize(all, None);
            play(&poses).trace
        };
        assert!(!fewer(&of(221, 222), &of(222, 222)));
        assert!(!fewer(&of(3, 4), &of(4, 4)));
        assert!(!fewer(&of(997, 1000), &of(1000, 1000)));
        assert!(fewer(&of(219, 222), &of(222, 222)));
        assert!(!fewer(&of(222, 222), &of(150, 222)));
        assert_eq!(percent(Some(share(&of(221, 222)))), "99.5 %");
    }

    #[test]
    fn a_stub_that_is_farther_off_is_told() {
        let straight = play(&[Some([0.0, 0.0, 0.0]), Some([1.0, 0.0, 0.0])]);
        let stretched = play(&[Some([0.0, 0.0, 0.0]), Some([3.0, 0.0, 0.0])]);
        let (_, native, stub) = DRIVES[1].plays[0];
        let told = |native_run: &Play, stub_run: &Play| {
            let runs = [(native, native_run), (stub, stub_run)];
            let runs = runs.map(|(name, run)| (name.to_owned(), Measured::Done(run.clone())));
            let plays = runs.to_vec();
            section(&Runs { plays }).expect("a section").findings[0].clone()
        };
        assert!(told(&straight, &stretched).contains("worse than hoped"));
        assert!(!told(&stretched, &straight).contains("worse than hoped"));
    }

    #[test]
    fn an_error_against_a_true_path_is_told_as_such() {
        let whole = play(&[Some([0.0, 0.0, 0.0]), Some([1.0, 0.0, 0.0])]);
        let (_, native, stub) = DRIVES[1].plays[0];
        let runs = Runs {
            plays: [native, stub]
                .map(|name| (name.to_owned(), Measured::Done(whole.clone())))
                .to_vec(),
        };
        let section = section(&runs).expect("a section");
        // Nothing is told of a drive that was not played.
        assert_eq!(section.tables.len(), 1);
        assert_eq!(section.tables[0].rows.len(), 2);
        let told = &section.findings[0];
        for words in [
            "a simulated drive, at its own rate,",
            "(0.00 m from the truth, RMS)",
        ] {
            assert!(told.contains(words), "{words}: {told}");
        }
    }
}
