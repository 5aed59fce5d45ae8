//! Selection of what a benchmark measures.

use anyhow::{Result, bail, ensure};

use crate::BenchReport;

/// A part of a benchmark: its name, and the function that measures it.
pub type Part = (&'static str, fn(&mut BenchReport) -> Result<()>);

/// Returns whether longer measurements are requested (`CLOUDROID_BENCH_FULL=1`).
pub fn is_full_run() -> bool {
    std::env::var_os("CLOUDROID_BENCH_FULL").is_some_and(|value| !value.is_empty() && value != "0")
}

/// Measures the parts that the program's arguments name, or all, and writes the report `name`; fails if a part did.
pub fn run_parts(name: &str, parts: &[Part]) -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    for word in &words {
        if !parts.iter().any(|(part, _)| part == word) {
            let known: Vec<&str> = parts.iter().map(|(part, _)| *part).collect();
            bail!("no part is called {word}: there are {}", known.join(", "));
        }
    }
    let mut report = BenchReport::new(name);
    let mut failed = Vec::new();
    for (part, measure) in parts {
        if !words.is_empty() && !words.iter().any(|word| word == part) {
            continue;
        }
        eprintln!("{part}");
        if let Err(why) = measure(&mut report) {
            report.skip(format!("what {part} has not come to"), format!("{why:#}"));
            failed.push(*part);
        }
    }
    report.finish()?;
    ensure!(failed.is_empty(), "not measured to the end: {failed:?}");
    Ok(())
}
