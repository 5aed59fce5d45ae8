//! Parts of the project's benchmarks that an experiment needs: runs the benchmark programs and reads their output.

use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};
use support::binaries;

use crate::cells::{CachedResult, RunCache};
use crate::deadline;
use crate::words::digits;

/// Maximum time for one part of a benchmark, which takes some minutes.
const LONGEST: Duration = Duration::from_secs(900);

/// Output of a benchmark: `bench_report::BenchReport`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct BenchOutput {
    /// Figures in the order in which they were measured.
    pub figures: Vec<Figure>,
    /// Measurements that could not be made.
    #[serde(default)]
    pub left_out: Vec<SkippedFigure>,
}

/// One measured number: `bench_report::Figure`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Figure {
    /// Name of the figure.
    pub figure: String,
    /// Unit.
    pub unit: String,
    /// Value.
    pub value: Option<f64>,
    /// Name of the peer or floor.
    pub peer: Option<String>,
    /// The peer's value, in the same unit.
    pub floor: Option<f64>,
    ratio: Option<f64>,
    to_reach: Option<String>,
    met: Option<bool>,
    note: Option<String>,
}

/// Something that could not be measured on this machine: `bench_report::SkippedMeasurement`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SkippedFigure {
    /// Name of the measurement.
    pub what: String,
    /// Reason.
    pub why: String,
}

impl BenchOutput {
    /// Returns a sentence for each target that was not met.
    pub fn unmet(&self) -> Vec<String> {
        let unmet = self
            .figures
            .iter()
            .filter(|figure| figure.met == Some(false));
        let sentence = |figure: &Figure| {
            format!(
                "{}: {} {}, which is not {}.",
                figure.figure,
                figure.value.map(digits).unwrap_or_default(),
                figure.unit,
                figure.to_reach.as_deref().unwrap_or_default()
            )
        };
        unmet.map(sentence).collect()
    }
}

/// Runs the part of a benchmark that `arguments` select, unless there is a stored result.
pub fn run_part(
    cells: &RunCache,
    name: &str,
    arguments: &[&str],
) -> Result<CachedResult<BenchOutput>> {
    let cell = [&["bench", name], arguments].concat().join(" ");
    cells.measure(&cell, &name, || {
        let program = binaries::path(&format!("bench-{name}"));
        ensure!(
            program.exists(),
            "{} is not built: make eval builds it",
            program.display()
        );
        let mut child = Command::new(&program).args(arguments).spawn()?;
        let status = deadline::wait_for_exit(&mut child, &program.display().to_string(), LONGEST)?;
        ensure!(
            status.success(),
            "{} ended with {status}",
            program.display()
        );
        let file = bench_report::root().join(format!("target/bench/{name}.json"));
        let text = std::fs::read(&file).with_context(|| file.display().to_string())?;
        Ok(serde_json::from_slice(&text)?)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_reached_is_a_finding() {
        let mut report = bench_report::BenchReport::new("codecs");
        report
            .figure("saved", "%", 50.0)
            .require(bench_report::Target::AtLeast(70.0));
        report
            .figure("fast", "MB/s", 50.0)
            .relative_to("zlib", 25.0);
        let text = serde_json::to_string(&report).expect("JSON");
        let written: BenchOutput = serde_json::from_str(&text).expect("what a benchmark writes");
        assert_eq!(written.unmet(), ["saved: 50.0 %, which is not ≥ 70."]);
    }
}
