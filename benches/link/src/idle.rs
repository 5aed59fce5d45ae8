//! What a stub takes while nothing happens.

use std::time::Duration;

use anyhow::{Context, Result};
use bench_report::{Report, Target};
use support::site::Running;

/// Its share of memory in megabytes (PSS).
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

/// Processor time so far, of all its threads, in nanoseconds: `schedstat` tells it exactly, not in ticks.
fn processor_time(pid: u32) -> Result<u64> {
    let mut sum = 0;
    for task in std::fs::read_dir(format!("/proc/{pid}/task"))? {
        let text = std::fs::read_to_string(task?.path().join("schedstat"))?;
        let spent = text.split_whitespace().next().context("schedstat")?;
        sum += spent.parse::<u64>()?;
    }
    Ok(sum)
}

/// Linked, and nobody asks anything.
pub fn measure(report: &mut Report, stub: &Running) -> Result<()> {
    let time = Duration::from_secs(if crate::full() { 60 } else { 15 });
    // What ends with the last subscriber is over by then.
    std::thread::sleep(Duration::from_secs(2));
    let before = processor_time(stub.pid())?;
    std::thread::sleep(time);
    let spent = processor_time(stub.pid())? - before;
    let share = spent as f64 / time.as_nanos() as f64 * 100.0;
    report
        .figure("processor, linked and idle", "% of a core", share)
        .reach(Target::AtMost(0.1))
        .note(format!("over {} s", time.as_secs()));
    Ok(())
}
