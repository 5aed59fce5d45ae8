//! Parts of the project's benchmarks that an experiment needs: their programs are run, and what they write is read.

use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};
use support::binaries;

use crate::cells::{Cells, Measured};
use crate::deadline;
use crate::words::digits;

/// For one part of a benchmark, which takes some minutes.
const LONGEST: Duration = Duration::from_secs(900);

/// What a benchmark writes: `bench_report::Report`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Written {
    /// In the order in which they were measured.
    pub figures: Vec<Figure>,
    /// What could not be measured.
    #[serde(default)]
    pub left_out: Vec<LeftOut>,
}

/// One measured number: `bench_report::Figure`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Figure {
    /// What was measured.
    pub figure: String,
    /// In what unit.
    pub unit: String,
    /// The number.
    pub value: Option<f64>,
    /// What it was measured beside.
    pub peer: Option<String>,
    /// The peer's number, in the same unit.
    pub floor: Option<f64>,
    ratio: Option<f64>,
    to_reach: Option<String>,
    met: Option<bool>,
    note: Option<String>,
}

/// Something that could not be measured on this machine: `bench_report::LeftOut`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct LeftOut {
    /// What it is.
    pub what: String,
    /// Why.
    pub why: String,
}

impl Written {
    /// Sentences about what was to be reached and was not.
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

/// Runs what `arguments` choose of a benchmark, unless that was done before.
pub fn part(cells: &Cells, name: &str, arguments: &[&str]) -> Result<Measured<Written>> {
    let cell = [&["bench", name], arguments].concat().join(" ");
    cells.measure(&cell, &name, || {
        let program = binaries::path(&format!("bench-{name}"));
        ensure!(
            program.exists(),
            "{} is not built: make eval builds it",
            program.display()
        );
        let mut child = Command::new(&program).args(arguments).spawn()?;
        let status = deadline::ends(&mut child, &program.display().to_string(), LONGEST)?;
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
        let mut report = bench_report::Report::new("codecs");
        report
            .figure("saved", "%", 50.0)
            .reach(bench_report::Target::AtLeast(70.0));
        report.figure("fast", "MB/s", 50.0).beside("zlib", 25.0);
        let text = serde_json::to_string(&report).expect("JSON");
        let written: Written = serde_json::from_str(&text).expect("what a benchmark writes");
        assert_eq!(written.unmet(), ["saved: 50.0 %, which is not ≥ 70."]);
    }
}
