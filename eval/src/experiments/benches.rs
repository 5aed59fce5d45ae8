//! Parts of the project's benchmarks that an experiment needs: runs the benchmark programs and reads their output.

use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use bench_report::BenchReport;
use support::binaries;

use crate::cells::{CachedResult, RunCache};
use crate::deadline;
use crate::words::digits;

/// Maximum time for one part of a benchmark, which takes some minutes.
const LONGEST: Duration = Duration::from_secs(900);

/// Returns a sentence for each target that a benchmark did not meet.
pub fn unmet_targets(report: &BenchReport) -> impl Iterator<Item = String> {
    let unmet = report.figures.iter().filter(|figure| figure.met == Some(false));
    unmet.map(|figure| {
        format!(
            "{}: {} {}, which is not {}.",
            figure.figure,
            digits(figure.value),
            figure.unit,
            figure.to_reach.as_deref().unwrap_or_default()
        )
    })
}

/// Runs the part of a benchmark that `arguments` select, unless there is a stored result.
pub fn run_part(cells: &RunCache, name: &str, arguments: &[&str]) -> Result<CachedResult<BenchReport>> {
    let cell = [&["bench", name], arguments].concat().join(" ");
    cells.measure(&cell, &name, || {
        let program = binaries::path(&format!("bench-{name}"));
        ensure!(program.exists(), "{} is not built: make eval builds it", program.display());
        let mut child = Command::new(&program).args(arguments).spawn()?;
        let status = deadline::wait_for_exit(&mut child, &program.display().to_string(), LONGEST)?;
        ensure!(status.success(), "{} ended with {status}", program.display());
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
        let mut report = BenchReport::new("codecs");
        report.figure("saved", "%", 50.0).require(bench_report::Target::AtLeast(70.0));
        report.figure("fast", "MB/s", 50.0).relative_to("zlib", 25.0);
        let text = serde_json::to_string(&report).expect("JSON");
        let written: BenchReport = serde_json::from_str(&text).expect("what a benchmark writes");
        let unmet: Vec<String> = unmet_targets(&written).collect();
        assert_eq!(unmet, ["saved: 50.0 %, which is not ≥ 70."]);
    }
}
