//! Resources that an idle stub uses.

use std::time::Duration;

use anyhow::{Context, Result};
use bench_report::{BenchReport, Target};
use support::site::NodeProcess;

/// Returns the proportional set size (PSS) in megabytes.
pub fn pss(pid: u32) -> Result<f64> {
    let path = format!("/proc/{pid}/smaps_rollup");
    let text = std::fs::read_to_string(&path).context(path)?;
    let line = text.lines().find_map(|line| line.strip_prefix("Pss:"));
    let kilobytes: f64 = line
        .and_then(|rest| rest.split_whitespace().next())
        .context("Pss")?
        .parse()?;
    Ok(kilobytes * 1024.0 / 1e6)
}

/// Returns the processor time of all threads so far, in nanoseconds; `schedstat` has the exact value, not ticks.
fn processor_time(pid: u32) -> Result<u64> {
    let mut sum = 0;
    for task in std::fs::read_dir(format!("/proc/{pid}/task"))? {
        let text = std::fs::read_to_string(task?.path().join("schedstat"))?;
        let spent = text.split_whitespace().next().context("schedstat")?;
        sum += spent.parse::<u64>()?;
    }
    Ok(sum)
}

/// Measures a connected stub without any requests.
pub fn measure(report: &mut BenchReport, stub: &NodeProcess) -> Result<()> {
    let time = Duration::from_secs(if crate::is_full_run() { 60 } else { 15 });
    // Work that ends with the last subscriber has finished after this.
    std::thread::sleep(Duration::from_secs(2));
    let before = processor_time(stub.pid())?;
    std::thread::sleep(time);
    let spent = processor_time(stub.pid())? - before;
    let share = spent as f64 / time.as_nanos() as f64 * 100.0;
    report
        .figure("processor, linked and idle", "% of a core", share)
        .require(Target::AtMost(0.1))
        .note(format!("over {} s", time.as_secs()));
    Ok(())
}
