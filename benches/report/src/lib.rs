//! Common parts of all benchmarks: figures beside a floor or peer of the same run, statistics, processes, a daemon.
//! Targets are best given as ratios, since absolute numbers are specific to a machine.

#![forbid(unsafe_code)]

#[cfg(feature = "daemon")]
mod daemon;
mod machine;
mod parts;
mod process;
mod psnr;
#[cfg(feature = "daemon")]
mod push;
mod race;
mod space;
mod statistics;
mod table;

#[cfg(feature = "daemon")]
pub use daemon::{BenchDaemon, create_directory};
pub use machine::MachineDescription;
pub use parts::{Part, is_full_run, run_parts};
pub use process::{Process, children_processor_time, first_child};
pub use psnr::Psnr;
#[cfg(feature = "daemon")]
pub use push::TimedPush;
pub use race::{Race, Times, thread_processor_time};
pub use space::write_install_space;
pub use statistics::{median, quantile, quantile_of_sorted, quantile_seconds, sort_values};
pub use table::format_number;

use serde::{Deserialize, Deserializer, Serialize};
use std::io;
use std::path::PathBuf;

/// A requirement for a figure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Target {
    /// The value is at least this.
    AtLeast(f64),
    /// The value is at most this.
    AtMost(f64),
    /// The value divided by the floor is at least this.
    RatioAtLeast(f64),
    /// The value divided by the floor is at most this.
    RatioAtMost(f64),
    /// The value is greater than the floor.
    AboveFloor,
    /// The value is less than the floor.
    BelowFloor,
}

impl Target {
    /// Returns the target in words, and whether it was met.
    fn judge(self, value: f64, floor: Option<f64>) -> (String, bool) {
        let floor = floor.unwrap_or(f64::NAN);
        match self {
            Self::AtLeast(bound) => (format!("≥ {bound}"), value >= bound),
            Self::AtMost(bound) => (format!("≤ {bound}"), value <= bound),
            Self::RatioAtLeast(bound) => (format!("≥ {bound}x"), value / floor >= bound),
            Self::RatioAtMost(bound) => (format!("≤ {bound}x"), value / floor <= bound),
            Self::AboveFloor => ("> floor".to_owned(), value > floor),
            Self::BelowFloor => ("< floor".to_owned(), value < floor),
        }
    }
}

/// One measured number.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Figure {
    /// Name of the figure.
    pub figure: String,
    /// Unit.
    pub unit: String,
    /// Value; what is not a number is `null` in JSON.
    #[serde(deserialize_with = "read_number")]
    pub value: f64,
    /// Name of the peer or floor.
    pub peer: Option<String>,
    /// The peer's value, in the same unit.
    pub floor: Option<f64>,
    /// `value / floor`
    pub ratio: Option<f64>,
    /// Target, in words.
    pub to_reach: Option<String>,
    /// True if the target was met; `None` without a target.
    pub met: Option<bool>,
    /// Remark that is needed to interpret the number.
    pub note: Option<String>,
}

fn read_number<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(from)?.unwrap_or(f64::NAN))
}

impl Figure {
    /// Sets the peer or floor that was measured in the same run, and its value.
    pub fn relative_to(&mut self, peer: impl Into<String>, floor: f64) -> &mut Self {
        self.peer = Some(peer.into());
        self.floor = Some(floor);
        self.ratio = (floor != 0.0).then(|| self.value / floor);
        self
    }

    /// Sets the target; call it after [`Figure::relative_to`].
    pub fn require(&mut self, target: Target) -> &mut Self {
        let (to_reach, met) = target.judge(self.value, self.floor);
        (self.to_reach, self.met) = (Some(to_reach), Some(met));
        self
    }

    /// Adds a remark that is needed to interpret the number.
    pub fn note(&mut self, note: impl Into<String>) -> &mut Self {
        self.note = Some(note.into());
        self
    }
}

/// All figures of one benchmark.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct BenchReport {
    /// Name of the benchmark and of its file.
    pub bench: String,
    /// Machine on which it ran.
    pub machine: MachineDescription,
    /// Figures in the order in which they were measured.
    pub figures: Vec<Figure>,
    /// Measurements that could not be made.
    pub left_out: Vec<SkippedMeasurement>,
}

/// Something that could not be measured on this machine.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SkippedMeasurement {
    /// Name of the measurement.
    pub what: String,
    /// Reason.
    pub why: String,
}

impl BenchReport {
    /// Creates a report that will be written to `target/bench/NAME.json`.
    pub fn new(name: &str) -> Self {
        Self {
            bench: name.to_owned(),
            machine: MachineDescription::describe(),
            figures: Vec::new(),
            left_out: Vec::new(),
        }
    }

    /// Adds a figure.
    pub fn figure(&mut self, name: impl Into<String>, unit: &str, value: f64) -> &mut Figure {
        self.figures.push(Figure { figure: name.into(), unit: unit.to_owned(), value, ..Figure::default() });
        let last = self.figures.len() - 1;
        &mut self.figures[last]
    }

    /// Records what could not be measured, and why.
    pub fn skip(&mut self, what: impl Into<String>, why: impl Into<String>) {
        let (what, why) = (what.into(), why.into());
        eprintln!("{what} is left out: {why}");
        self.left_out.push(SkippedMeasurement { what, why });
    }

    /// Prints the table and writes the file; returns its path.
    pub fn finish(&self) -> io::Result<PathBuf> {
        print!("{}", table::render(self));
        let directory = root().join("target/bench");
        std::fs::create_dir_all(&directory)?;
        let path = directory.join(format!("{}.json", self.bench));
        std::fs::write(&path, serde_json::to_string_pretty(self)? + "\n")?;
        println!("written to {}", path.display());
        Ok(path)
    }
}

/// Returns the repository: the nearest ancestor directory with a `Cargo.lock`, or else the current directory.
pub fn root() -> PathBuf {
    let here = std::env::current_dir().unwrap_or_default();
    here.ancestors().find(|path| path.join("Cargo.lock").exists()).unwrap_or(&here).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_figure_knows_whether_it_was_met() {
        let mut report = BenchReport::new("test");
        report.figure("speed", "MB/s", 30.0).relative_to("peer", 100.0).require(Target::RatioAtLeast(0.3));
        report.figure("size", "B", 120.0).relative_to("peer", 100.0).require(Target::RatioAtMost(1.2));
        report.figure("saved", "%", 50.0).require(Target::AtMost(40.0));
        report.figure("a ratio without its floor", "MB/s", 30.0).require(Target::RatioAtLeast(0.3));
        let met: Vec<_> = report.figures.iter().map(|figure| figure.met).collect();
        assert_eq!(met, [Some(true), Some(true), Some(false), Some(false)]);
        assert_eq!(report.figures[0].ratio, Some(0.3));
    }

    #[test]
    fn figures_and_what_is_left_out_are_in_table_and_file() {
        let mut report = BenchReport::new("test");
        report.figure("speed", "MB/s", 30.0).relative_to("peer", 100.0).require(Target::AboveFloor).note("cold");
        report.skip("a peer", "it is not installed");
        let table = table::render(&report);
        for words in ["speed", "NOT MET", "cold", "a peer is left out: it is not installed"] {
            assert!(table.contains(words), "{table}");
        }
        let text = serde_json::to_string(&report).expect("JSON");
        assert!(text.contains(r#""left_out":[{"what":"a peer","why":"it is not installed"}]"#), "{text}");
    }
}
