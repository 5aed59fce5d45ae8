//! Many servants at once: cost of each while idle, and whether the next one starts as fast as the first.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bench_report::{BenchDaemon, BenchReport, Process, Target, is_full_run, quantile_seconds};

use crate::cost::{ServantOverhead, processor_time};
use crate::image::ServiceImage;
use crate::starts::{list_nodes, time_robot_start};

/// Number of starts on either side of the comparison.
const STARTS: usize = 7;
/// Limit for the memory of a servant's own processes, in megabytes.
const MEMORY: f64 = 4.0;
/// Limit for the processor time of all our idle processes, in percent of a core.
const IDLE: f64 = 0.1;

/// Measures from one servant to many and back.
pub(crate) fn measure(report: &mut BenchReport, daemon: &BenchDaemon, image: &ServiceImage) -> Result<()> {
    let (crowd, watch) = if is_full_run() { (100, 60) } else { (30, 35) };
    let starts = |what: &str| -> Result<Vec<Duration>> {
        eprintln!("{STARTS} starts {what}");
        (0..STARTS).map(|_| time_robot_start(daemon, image)).collect()
    };
    let mut first = starts("on an idle host")?;
    for count in [1, 20] {
        start_servants(daemon, image, count)?;
        report_overhead(report, daemon, count)?;
    }
    if crowd > 20 {
        start_servants(daemon, image, crowd)?;
    }
    report_total(report, daemon, crowd, Duration::from_secs(watch))?;
    let last = starts(&format!("beside {crowd} servants"))?;
    daemon.stop_servants()?;
    // Once more, because the load on a shared machine may have changed meanwhile.
    first.extend(starts("on an idle host")?);
    let figure = report.figure(format!("start of servant {}", crowd + 1), "ms", quantile_seconds(&last, 0.5) * 1e3);
    figure.relative_to("the first, before and after", quantile_seconds(&first, 0.5) * 1e3);
    figure.require(Target::RatioAtMost(1.5)).note(format!("medians of {STARTS} and {}", 2 * STARTS));
    Ok(())
}

/// Starts servants until there are `count`: each for a robot of its own, which then leaves.
fn start_servants(daemon: &BenchDaemon, image: &ServiceImage, count: usize) -> Result<()> {
    eprintln!("{count} servants");
    for number in daemon.servants()?.len()..count {
        let path = format!("{}?robot=r{number}", image.service);
        let mut robot = daemon.robot(&path)?;
        list_nodes(&mut robot).with_context(|| format!("the servant of {path}"))?;
        robot.leave()?;
    }
    settle();
    Ok(())
}

/// Waits until newly started processes have settled.
fn settle() {
    std::thread::sleep(Duration::from_secs(3));
}

/// Reports the memory of shim and init per servant.
fn report_overhead(report: &mut BenchReport, daemon: &BenchDaemon, count: usize) -> Result<()> {
    let all = ServantOverhead::for_all_servants(daemon)?;
    let costs = all.iter().map(|one| one.memory()).collect::<Result<Vec<_>>>()?;
    let mean = costs.iter().sum::<f64>() / costs.len() as f64;
    let inits = all.iter().map(|one| Process::from_pid(one.init).proportional()).collect::<Result<Vec<_>>>()?;
    let init = inits.iter().sum::<f64>() / inits.len() as f64;
    let figure = report.figure(format!("shim + init, each of {count} idle"), "MB", mean);
    figure.require(Target::AtMost(MEMORY));
    figure.note(format!("PSS; most {:.2}, init {init:.2}", costs.iter().copied().fold(0.0, f64::max)));
    Ok(())
}

/// Reports our processes together: memory per servant, and processor time while idle.
fn report_total(report: &mut BenchReport, daemon: &BenchDaemon, count: usize, watch: Duration) -> Result<()> {
    let all = ServantOverhead::for_all_servants(daemon)?;
    let of_daemon = Process::from_pid(daemon.pid()).proportional()?;
    let of_servants = all.iter().map(|one| one.memory()).sum::<Result<f64>>()?;
    let figure = report.figure(
        format!("daemon, shims, inits, per servant of {count}"),
        "MB",
        (of_daemon + of_servants) / count as f64,
    );
    figure.require(Target::AtMost(MEMORY)).note(format!("PSS; the daemon {of_daemon:.1}"));
    let sum =
        |pick: fn(&ServantOverhead) -> i32| all.iter().map(|one| processor_time(pick(one))).sum::<Result<Duration>>();
    let used =
        || -> Result<[Duration; 3]> { Ok([processor_time(daemon.pid())?, sum(|one| one.shim)?, sum(|one| one.init)?]) };
    eprintln!("idle for {} s", watch.as_secs());
    let (before, begun) = (used()?, Instant::now());
    std::thread::sleep(watch);
    let (after, lasted) = (used()?, begun.elapsed());
    let share = |index: usize| (after[index] - before[index]).as_secs_f64() / lasted.as_secs_f64() * 100.0;
    let [daemon, shims, inits] = [share(0), share(1), share(2)];
    let figure = report.figure(format!("idle processor, all of ours, {count} servants"), "%", daemon + shims + inits);
    figure.require(Target::AtMost(IDLE));
    figure
        .note(format!("of a core over {} s; daemon {daemon:.3}, shims {shims:.3}, inits {inits:.3}", watch.as_secs()));
    Ok(())
}
