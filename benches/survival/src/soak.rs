//! Mixed load of twenty robots for an arbitrary time: nothing fails, and in its last quarter the daemon neither uses
//! more resources nor answers later than in its second.

mod load;

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bench_report::{BenchReport, Target};
use support::daemon::Daemon;

use crate::greeters;
use crate::milliseconds::quantile;
use crate::resources::Resources;
use load::{MixedLoad, Tally};

/// Default duration.
const USUALLY: Duration = Duration::from_secs(180);
/// Sampling interval of the daemon's process.
const LOOK: Duration = Duration::from_secs(1);

/// Returns the duration `CLOUDROID_BENCH_SOAK`, such as `90s`, `30m` or `1h`.
pub(crate) fn duration() -> Result<Duration> {
    match std::env::var("CLOUDROID_BENCH_SOAK") {
        Ok(text) => {
            parse(&text).with_context(|| format!("CLOUDROID_BENCH_SOAK={text:?}: write a number with s, m or h"))
        }
        Err(_) => Ok(USUALLY),
    }
}

fn parse(text: &str) -> Option<Duration> {
    let seconds = match text.chars().last()? {
        's' => 1,
        'm' => 60,
        'h' => 3600,
        _ => return None,
    };
    let number: u64 = text[..text.len() - 1].parse().ok()?;
    Some(Duration::from_secs(number * seconds))
}

/// Runs twenty robots against one daemon for `time`.
pub(crate) fn measure(report: &mut BenchReport, daemon: &Daemon, time: Duration) -> Result<()> {
    eprintln!("20 robots for {time:?}");
    let load = MixedLoad::new(daemon);
    let mut looks = Vec::new();
    std::thread::scope(|scope| -> Result<()> {
        load.start(scope);
        let looked = sample_resources(daemon.pid(), time, &mut looks);
        load.end();
        looked
    })?;
    greeters::stop_all(daemon)?;
    report_soak(report, &load.into_tally()?, &looks, time);
    Ok(())
}

/// Samples the process periodically.
fn sample_resources(pid: i32, time: Duration, looks: &mut Vec<(Instant, Resources)>) -> Result<()> {
    let began = Instant::now();
    let mut told = began;
    while began.elapsed() < time {
        let now = Resources::read(pid)?;
        looks.push((Instant::now(), now));
        if told.elapsed() >= time / 12 {
            told = Instant::now();
            eprintln!("after {:.0} s: {now:?}", began.elapsed().as_secs_f64());
        }
        std::thread::sleep(LOOK);
    }
    Ok(())
}

fn report_soak(report: &mut BenchReport, tally: &Tally, looks: &[(Instant, Resources)], time: Duration) {
    let first = tally.failures.first().map_or("none", String::as_str);
    report
        .figure(
            format!("{:.0} s of work by 20 robots, what failed", time.as_secs_f64()),
            "",
            tally.failures.len() as f64,
        )
        .require(Target::AtMost(0.0))
        .note(format!("of {}; {first}", tally.done));
    // Allocations that are made once happen in the first quarter.
    let began = looks.first().map_or_else(Instant::now, |(at, _)| *at);
    let is_in = |number: u32, at: Instant| {
        let since = at.saturating_duration_since(began);
        (time / 4 * (number - 1)..time / 4 * number).contains(&since)
    };
    let held_in = |number: u32| {
        let some = looks.iter().filter(|(at, _)| is_in(number, *at));
        Resources::median(&some.map(|(_, look)| *look).collect::<Vec<_>>())
    };
    let second = ("in its second quarter", held_in(2));
    held_in(4).add_figures(report, "that, in its last quarter", second);
    let calls_in = |number: u32| -> Vec<Duration> {
        let some = tally.calls.iter().filter(|call| is_in(number, call.made));
        some.map(|call| call.took).collect()
    };
    let (second, last) = (calls_in(2), calls_in(4));
    let title = "a call in its last quarter, p99";
    report
        .figure(title, "ms", quantile(&last, 0.99))
        .relative_to("in its second quarter", quantile(&second, 0.99))
        .note(format!("p50 {:.2} ms beside {:.2} ms", quantile(&last, 0.5), quantile(&second, 0.5)));
}
