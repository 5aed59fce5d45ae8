//! Resources that an idle stub uses.

use std::time::Duration;

use anyhow::Result;
use bench_report::{BenchReport, Process, Target, is_full_run};
use support::site::NodeProcess;

/// Measures a connected stub without any requests.
pub fn measure(report: &mut BenchReport, stub: &NodeProcess) -> Result<()> {
    let time = Duration::from_secs(if is_full_run() { 60 } else { 15 });
    // Work that ends with the last subscriber has finished after this.
    std::thread::sleep(Duration::from_secs(2));
    let process = Process::from_pid(stub.pid());
    let before = process.live_thread_time("")?;
    std::thread::sleep(time);
    let spent = process.live_thread_time("")? - before;
    let share = spent.as_secs_f64() / time.as_secs_f64() * 100.0;
    report
        .figure("processor, linked and idle", "% of a core", share)
        .require(Target::AtMost(0.1))
        .note(format!("over {} s", time.as_secs()));
    Ok(())
}
