//! Experiment 7: a drive is played at its own rate to a small robot, and at a third of it as in the publication: the maps, how far they are
//! from the truth, and how many scans were worked at.

use anyhow::{Result, anyhow};
use serde::{Deserialize, Serialize};

use crate::cells::{Cells, Measured};
use crate::examples::{LASER_SLAM, Where, Workshop};
use crate::place::{Class, Cost, Network, Place};
use crate::plots::{self, Series};
use crate::recording::Recording;
use crate::robot::Pace;
use crate::section::{Figure, Missing, Section, Table};
use crate::statistics::trajectory_error;
use crate::trace::{Grid, Trace};
use crate::words::digits;

/// Where the truth is, in the recording.
const TRUTH: &str = "/ground_truth";
/// As in the publication.
const SLOWLY: f64 = 0.33;

/// One play of the drive.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Play {
    trace: Trace,
    cost: Cost,
    truth: Vec<(f64, f64, f64)>,
}

/// All of them.
pub struct Runs {
    plays: Vec<(String, Measured<Play>)>,
}

/// Measures them; at most so many scans, or the whole drive.
pub fn measure(cells: &Cells, workshop: &Workshop, most: Option<usize>) -> Result<Runs> {
    let mut plays = Vec::new();
    for (speed, native, stub) in [
        (1.0, "native, own rate", "stub, own rate"),
        (SLOWLY, "native, 0.33 of its rate", "stub, 0.33 of its rate"),
    ] {
        // What both need is made before both need it.
        if let Err(error) = workshop.recording(LASER_SLAM.input) {
            let why = format!("{error:#}");
            plays.extend(
                [native, stub].map(|name| (name.to_owned(), Measured::Missing(why.clone()))),
            );
            continue;
        }
        // The two robots drive at the same time: each has its own part of the processor, and together with the cloud they need less than
        // two cores.
        let play = |name: &str, at: Where| one(cells, workshop, name, at, speed, most);
        let both = std::thread::scope(|scope| {
            let beside = scope.spawn(|| play(stub, Where::Outsourced));
            let native = play(native, Where::Native);
            let stub = beside
                .join()
                .unwrap_or_else(|_| Err(anyhow!("the stub's robot panicked")));
            [native, stub]
        });
        for (name, play) in [native, stub].into_iter().zip(both) {
            plays.push((name.to_owned(), play?));
        }
    }
    Ok(Runs { plays })
}

fn one(
    cells: &Cells,
    workshop: &Workshop,
    name: &str,
    at: Where,
    speed: f64,
    most: Option<usize>,
) -> Result<Measured<Play>> {
    cells.measure(&format!("map {name}"), &(Class::PI, speed, most), || {
        let directory = workshop.directory()?;
        let mut plan = workshop.plan(&LASER_SLAM, at, directory.path())?;
        plan.pace = Pace::Recorded(speed);
        plan.most = most.unwrap_or(usize::MAX);
        plan.patience = 1200.0;
        let truth = Recording::read(&plan.recording)?.positions(TRUTH);
        let place = Place::new(&workshop.daemon.address, Class::PI, Network::Wifi)?;
        let (trace, cost) = place.runs(&plan, directory.path())?;
        Ok(Play { trace, cost, truth })
    })
}

/// What the report says.
pub fn section(runs: &Runs) -> Result<Section> {
    let mut section = Section::new(7, "map", "The map of a drive");
    section.published = "Fig. 8 of the publication: a real robot drives, and its map is made on the robot and in the cloud; the recording was also played at 0.33 of its rate.".to_owned();
    section.differs = vec!["The robot is a recording of MRPT, played at its own rate to a robot of the class Pi, by Wi-Fi (5 ms each way, more or less 4 ms, 40 Mbit/s, one packet in a hundred lost). The native robot and the stub's drive at the same time, in places of their own.".to_owned()];
    let mut table = Table::new(
        "laser_slam on a robot of the class Pi",
        [
            "where and how fast",
            "scans",
            "worked at",
            "share",
            "error, RMS in m",
            "error, most in m",
        ],
    );
    let mut paths = Vec::new();
    for (name, play) in &runs.plays {
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
            format!(
                "{:.0} %",
                100.0 * trace.answered() as f64 / trace.requests.len().max(1) as f64
            ),
            metres(error.as_ref().map(|error| error.rmse)),
            metres(error.as_ref().map(|error| error.max)),
        ]);
        if paths.is_empty() && !play.truth.is_empty() {
            paths.push(series("truth", &play.truth));
        }
        paths.push(series(name, &estimate));
        if let Some(map) = &trace.map {
            let id: String = name
                .chars()
                .map(|one| {
                    if one.is_ascii_alphanumeric() {
                        one
                    } else {
                        '-'
                    }
                })
                .collect();
            let caption = format!("The map: {name}");
            let figure = Figure::png(format!("map-{id}"), caption, picture(map)?);
            section.figures.push(figure);
        }
    }
    section.tables.push(table);
    section.drawing(
        "paths",
        "Where the robot was, by each",
        plots::map("laser_slam", "x, m", "y, m", &paths)?,
    );
    findings(&mut section, runs);
    Ok(section)
}

fn findings(section: &mut Section, runs: &Runs) {
    let share = |name: &str| {
        let (_, play) = runs.plays.iter().find(|(one, _)| one == name)?;
        let trace = &play.done()?.trace;
        Some(100.0 * trace.answered() as f64 / trace.requests.len().max(1) as f64)
    };
    if let (Some(native), Some(stub)) = (share("native, own rate"), share("stub, own rate")) {
        section.findings.push(format!(
            "At the drive's own rate the robot works at {native:.0} % of the scans by itself, and at {stub:.0} % through the stub."
        ));
    }
}

fn series(name: &str, path: &[(f64, f64, f64)]) -> Series {
    Series {
        name: name.to_owned(),
        points: path.iter().map(|(_, x, y)| (*x, *y)).collect(),
    }
}

/// What is known of a map, cropped: free white, occupied black, unknown grey; north up.
fn picture(map: &Grid) -> Result<Vec<u8>> {
    let known = |x: usize, y: usize| map.cells[y * map.width + x] >= 0;
    let rows: Vec<usize> = (0..map.height)
        .filter(|y| (0..map.width).any(|x| known(x, *y)))
        .collect();
    let columns: Vec<usize> = (0..map.width)
        .filter(|x| (0..map.height).any(|y| known(*x, y)))
        .collect();
    let span = |all: &[usize]| {
        (
            all.first().copied().unwrap_or(0),
            all.last().map_or(1, |last| last + 1),
        )
    };
    let ((left, right), (bottom, top)) = (span(&columns), span(&rows));
    let mut pixels = Vec::new();
    for y in (bottom..top).rev() {
        for x in left..right {
            pixels.push(match map.cells.get(y * map.width + x) {
                Some(cell @ 0..=100) => 255 - (f64::from(*cell) * 2.55).round() as u8,
                _ => 205,
            });
        }
    }
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, (right - left) as u32, (top - bottom) as u32);
    encoder.set_color(png::ColorType::Grayscale);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&pixels)?;
    writer.finish()?;
    Ok(file)
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
            ["4", "2", "50 %"].map(str::to_owned)
        );
    }

    #[test]
    fn a_map_is_drawn_north_up_without_what_is_unknown() {
        let map = Grid {
            width: 3,
            height: 3,
            resolution: 1.0,
            origin: [0.0, 0.0],
            cells: vec![-1, -1, -1, -1, 0, 100, -1, 100, -1],
        };
        let file = picture(&map).expect("a picture");
        let mut reader = png::Decoder::new(std::io::Cursor::new(file))
            .read_info()
            .expect("a PNG");
        let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
        let frame = reader.next_frame(&mut pixels).expect("pixels");
        assert_eq!((frame.width, frame.height), (2, 2));
        assert_eq!(pixels[..4], [0, 205, 255, 0]);
    }
}
