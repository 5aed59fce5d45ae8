//! What every bench reports: a figure, the floor or peer it was measured beside in the same run, and what was to be
//! reached.
//!
//! ```text
//! use bench_report::{Race, Report, Target};
//!
//! # fn ours() {} fn theirs() {}
//! let mut report = Report::new("queue");
//! let mut race = Race::new(20);
//! race.add("ours", ours);
//! race.add("theirs", theirs);
//! let times = race.run();
//! report
//!     .figure("hand-over", "µs", times[0].best_micros())
//!     .beside("theirs", times[1].best_micros())
//!     .reach(Target::RatioAtMost(1.0));
//! report.finish().unwrap();
//! ```
//! Absolute numbers belong to the machine they were measured on, so its description is part of the report, and
//! targets are best given as ratios.

#![forbid(unsafe_code)]

mod machine;
mod race;
mod table;

pub use machine::Machine;
pub use race::{Race, Times, children_time, quantile, thread_time};

use serde::Serialize;
use std::io;
use std::path::PathBuf;

/// What a figure has to reach.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Target {
    /// The value itself.
    AtLeast(f64),
    /// The value itself.
    AtMost(f64),
    /// The value divided by the floor's.
    RatioAtLeast(f64),
    /// The value divided by the floor's.
    RatioAtMost(f64),
    /// More than the floor.
    AboveFloor,
    /// Less than the floor.
    BelowFloor,
}

impl Target {
    fn met(self, value: f64, floor: Option<f64>) -> bool {
        let floor = floor.unwrap_or(f64::NAN);
        match self {
            Self::AtLeast(bound) => value >= bound,
            Self::AtMost(bound) => value <= bound,
            Self::RatioAtLeast(bound) => value / floor >= bound,
            Self::RatioAtMost(bound) => value / floor <= bound,
            Self::AboveFloor => value > floor,
            Self::BelowFloor => value < floor,
        }
    }

    fn describe(self) -> String {
        match self {
            Self::AtLeast(bound) => format!("≥ {bound}"),
            Self::AtMost(bound) => format!("≤ {bound}"),
            Self::RatioAtLeast(bound) => format!("≥ {bound}x"),
            Self::RatioAtMost(bound) => format!("≤ {bound}x"),
            Self::AboveFloor => "> floor".to_owned(),
            Self::BelowFloor => "< floor".to_owned(),
        }
    }
}

/// One measured number.
#[derive(Clone, Debug, Serialize)]
pub struct Figure {
    /// What was measured.
    pub figure: String,
    /// In what unit.
    pub unit: String,
    /// The number.
    pub value: f64,
    /// What it was measured beside.
    pub peer: Option<String>,
    /// The peer's number, in the same unit.
    pub floor: Option<f64>,
    /// `value / floor`
    pub ratio: Option<f64>,
    /// What was to be reached.
    pub to_reach: Option<String>,
    /// Whether it was.
    pub met: Option<bool>,
    /// What one must know to read the number.
    pub note: Option<String>,
}

impl Figure {
    /// Names the peer or floor measured in the same run, and its number.
    pub fn beside(&mut self, peer: impl Into<String>, floor: f64) -> &mut Self {
        self.peer = Some(peer.into());
        self.floor = Some(floor);
        self.ratio = (floor != 0.0).then(|| self.value / floor);
        self
    }

    /// Says what is to be reached; call it after [`Figure::beside`].
    pub fn reach(&mut self, target: Target) -> &mut Self {
        self.to_reach = Some(target.describe());
        self.met = Some(target.met(self.value, self.floor));
        self
    }

    /// Adds what one must know to read the number.
    pub fn note(&mut self, note: impl Into<String>) -> &mut Self {
        self.note = Some(note.into());
        self
    }
}

/// All figures of one bench.
#[derive(Debug, Serialize)]
pub struct Report {
    /// The bench's name, and its file's.
    pub bench: String,
    /// Where it ran.
    pub machine: Machine,
    /// In the order they were measured.
    pub figures: Vec<Figure>,
    /// What was to be measured and was not.
    pub left_out: Vec<LeftOut>,
}

/// Something that could not be measured on this machine.
#[derive(Clone, Debug, Serialize)]
pub struct LeftOut {
    /// What it is.
    pub what: String,
    /// Why.
    pub why: String,
}

impl Report {
    /// A report that will be written to `target/bench/NAME.json`.
    pub fn new(name: &str) -> Self {
        Self {
            bench: name.to_owned(),
            machine: Machine::describe(),
            figures: Vec::new(),
            left_out: Vec::new(),
        }
    }

    /// Adds a figure.
    pub fn figure(&mut self, name: impl Into<String>, unit: &str, value: f64) -> &mut Figure {
        self.figures.push(Figure {
            figure: name.into(),
            unit: unit.to_owned(),
            value,
            peer: None,
            floor: None,
            ratio: None,
            to_reach: None,
            met: None,
            note: None,
        });
        let last = self.figures.len() - 1;
        &mut self.figures[last]
    }

    /// Names what could not be measured, and why.
    pub fn left_out(&mut self, what: impl Into<String>, why: impl Into<String>) {
        let (what, why) = (what.into(), why.into());
        eprintln!("{what} is left out: {why}");
        self.left_out.push(LeftOut { what, why });
    }

    /// Whether every figure that had something to reach reached it.
    pub fn all_met(&self) -> bool {
        self.figures.iter().all(|figure| figure.met != Some(false))
    }

    /// Prints the table and writes the file; returns where.
    pub fn finish(&self) -> io::Result<PathBuf> {
        print!("{}", table::render(self));
        let directory = root().join("target/bench");
        std::fs::create_dir_all(&directory)?;
        let path = directory.join(format!("{}.json", self.bench));
        let mut text = serde_json::to_string_pretty(self)?;
        text.push('\n');
        std::fs::write(&path, text)?;
        println!("written to {}", path.display());
        Ok(path)
    }
}

/// The repository: the nearest directory upwards that holds a `Cargo.lock`, else the current one.
pub fn root() -> PathBuf {
    let here = std::env::current_dir().unwrap_or_default();
    here.ancestors()
        .find(|path| path.join("Cargo.lock").exists())
        .unwrap_or(&here)
        .to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_figure_knows_whether_it_was_met() {
        let mut report = Report::new("test");
        report
            .figure("speed", "MB/s", 30.0)
            .beside("peer", 100.0)
            .reach(Target::RatioAtLeast(0.3));
        report
            .figure("size", "B", 120.0)
            .beside("peer", 100.0)
            .reach(Target::RatioAtMost(1.2));
        report
            .figure("saved", "%", 50.0)
            .reach(Target::AtMost(40.0));
        assert_eq!(
            report
                .figures
                .iter()
                .map(|figure| figure.met)
                .collect::<Vec<_>>(),
            [Some(true), Some(true), Some(false)]
        );
        assert_eq!(report.figures[0].ratio, Some(0.3));
        assert!(!report.all_met());
    }

    #[test]
    fn a_target_without_its_floor_is_not_met() {
        let mut report = Report::new("test");
        report
            .figure("speed", "MB/s", 30.0)
            .reach(Target::RatioAtLeast(0.3));
        assert!(!report.all_met());
    }

    #[test]
    fn the_table_shows_every_figure() {
        let mut report = Report::new("test");
        report
            .figure("speed", "MB/s", 30.0)
            .beside("peer", 100.0)
            .reach(Target::AboveFloor)
            .note("cold");
        let table = table::render(&report);
        assert!(
            table.contains("speed") && table.contains("NOT MET") && table.contains("cold"),
            "{table}"
        );
    }

    #[test]
    fn what_is_left_out_is_in_table_and_file() {
        let mut report = Report::new("test");
        report.left_out("a peer", "it is not installed");
        assert!(table::render(&report).contains("a peer is left out: it is not installed"));
        let text = serde_json::to_string(&report).expect("JSON");
        assert!(
            text.contains(r#""left_out":[{"what":"a peer","why":"it is not installed"}]"#),
            "{text}"
        );
    }
}
