//! Many servants at once: what each costs while it idles, and whether the next one starts as fast as the first.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bench_report::{Report, Target};
use bench_servant::{Daemon, full};

use crate::cost::{Overhead, memory, processor};
use crate::image::Image;
use crate::robot::Robot;
use crate::starts::{median, robot, times};

/// Starts per side when the first and the last are compared.
const STARTS: usize = 7;
/// What one servant may cost, in megabytes.
const MEMORY: f64 = 4.0;
/// What all idle processes of ours may use, in percent of a core.
const IDLE: f64 = 0.1;

/// From one servant to many and back.
pub(crate) fn measure(report: &mut Report, daemon: &Daemon, image: &Image) -> Result<()> {
    let (crowd, watch) = if full() { (100, 60) } else { (30, 35) };
    let starts = |what: &str| -> Result<Vec<Duration>> {
        eprintln!("{STARTS} starts {what}");
        (0..STARTS).map(|_| robot(daemon, image)).collect()
    };
    let mut first = starts("on an idle host")?;
    for count in [1, 20] {
        grow(daemon, image, count)?;
        footprint(report, daemon, count)?;
    }
    if crowd > 20 {
        grow(daemon, image, crowd)?;
    }
    together(report, daemon, crowd, Duration::from_secs(watch))?;
    let last = starts(&format!("beside {crowd} servants"))?;
    daemon.stop_servants()?;
    // Again: a machine that others use has changed meanwhile.
    first.extend(starts("on an idle host")?);
    report
        .figure(
            format!("start of servant {}", crowd + 1),
            "ms",
            median(&times("last", last)),
        )
        .beside(
            "the first, before and after",
            median(&times("first", first)),
        )
        .reach(Target::RatioAtMost(1.5))
        .note(format!("medians of {STARTS} and {}", 2 * STARTS));
    Ok(())
}

/// Until there are `count`: each asked for by a robot of its own, which then leaves.
fn grow(daemon: &Daemon, image: &Image, count: usize) -> Result<()> {
    eprintln!("{count} servants");
    for number in daemon.servants()?.len()..count {
        let path = format!("{}?robot=r{number}", image.service);
        let mut robot = Robot::connect(&daemon.address, &path)?;
        robot
            .nodes()
            .with_context(|| format!("the servant of {path}"))?;
        robot.leave()?;
    }
    settle();
    Ok(())
}

/// Lets what was started come to rest.
fn settle() {
    std::thread::sleep(Duration::from_secs(3));
}

/// Shim and init, of each.
fn footprint(report: &mut Report, daemon: &Daemon, count: usize) -> Result<()> {
    let all = Overhead::all(daemon)?;
    let costs = all
        .iter()
        .map(|one| one.memory())
        .collect::<Result<Vec<_>>>()?;
    let mean = costs.iter().sum::<f64>() / costs.len() as f64;
    let inits = all
        .iter()
        .map(|one| memory(one.init))
        .collect::<Result<Vec<_>>>()?;
    let init = inits.iter().sum::<f64>() / inits.len() as f64;
    report
        .figure(format!("shim + init, each of {count} idle"), "MB", mean)
        .reach(Target::AtMost(MEMORY))
        .note(format!(
            "PSS; most {:.2}, init {init:.2}",
            costs.iter().copied().fold(0.0, f64::max)
        ));
    Ok(())
}

/// Everything of ours: memory per servant, and the processor while nothing happens.
fn together(report: &mut Report, daemon: &Daemon, count: usize, watch: Duration) -> Result<()> {
    let all = Overhead::all(daemon)?;
    let of_daemon = memory(daemon.pid())?;
    let of_servants = all.iter().map(|one| one.memory()).sum::<Result<f64>>()?;
    report
        .figure(
            format!("daemon, shims, inits, per servant of {count}"),
            "MB",
            (of_daemon + of_servants) / count as f64,
        )
        .reach(Target::AtMost(MEMORY))
        .note(format!("PSS; the daemon {of_daemon:.1}"));
    let sum = |pick: fn(&Overhead) -> i32| {
        all.iter()
            .map(|one| processor(pick(one)))
            .sum::<Result<Duration>>()
    };
    let used = || -> Result<[Duration; 3]> {
        Ok([
            processor(daemon.pid())?,
            sum(|one| one.shim)?,
            sum(|one| one.init)?,
        ])
    };
    eprintln!("idle for {} s", watch.as_secs());
    let (before, begun) = (used()?, Instant::now());
    std::thread::sleep(watch);
    let (after, lasted) = (used()?, begun.elapsed());
    let share =
        |index: usize| (after[index] - before[index]).as_secs_f64() / lasted.as_secs_f64() * 100.0;
    let [daemon, shims, inits] = [share(0), share(1), share(2)];
    report
        .figure(
            format!("idle processor, all of ours, {count} servants"),
            "%",
            daemon + shims + inits,
        )
        .reach(Target::AtMost(IDLE))
        .note(format!(
            "of a core over {} s; daemon {daemon:.3}, shims {shims:.3}, inits {inits:.3}",
            watch.as_secs()
        ));
    Ok(())
}
