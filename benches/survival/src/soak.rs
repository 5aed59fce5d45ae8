//! Mixed load of twenty robots, half of them with ROS 2, for an arbitrary time: nothing fails, and in its last quarter
//! the daemon neither uses more resources nor answers later than in its second.

mod load;

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bench_report::{BenchReport, Target, median};
use support::daemon::Daemon;

use crate::greeters;
use crate::milliseconds::quantile;
use crate::resources::Resources;
use load::{BOTH, CallSample, MixedLoad, Tally};

/// Default duration.
const USUALLY: Duration = Duration::from_secs(180);
/// Sampling interval of the daemon's process.
const LOOK: Duration = Duration::from_secs(1);
/// Number of parts for each of which the p99 of calls is taken: the minutes of an hour.
const PARTS: u32 = 60;
/// Ratio up to which two of these count as equal.
const FLAT: f64 = 1.1;

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
    load::publish_twin(daemon)?;
    eprintln!("20 robots for {time:?}");
    let load = MixedLoad::new(daemon);
    let mut looks = Vec::new();
    std::thread::scope(|scope| -> Result<()> {
        load.start(scope);
        let looked = sample_resources(daemon, time, &mut looks);
        load.end();
        looked
    })?;
    greeters::stop_all(daemon)?;
    report_soak(report, &load.into_tally()?, &looks, time);
    Ok(())
}

/// Samples the daemon's process periodically.
fn sample_resources(daemon: &Daemon, time: Duration, looks: &mut Vec<(Instant, Resources)>) -> Result<()> {
    let began = Instant::now();
    let mut told = began;
    while began.elapsed() < time {
        let now = Resources::read(daemon)?;
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
    for ros in BOTH {
        let calls: Vec<&CallSample> = tally.calls.iter().filter(|call| call.ros == ros).collect();
        report_calls(report, &format!("a call of a robot of ROS {}", ros.number()), &calls, (began, time));
    }
}

/// Reports the p99 of calls in the last quarter beside that in the second: the median of its parts.
fn report_calls(report: &mut BenchReport, what: &str, calls: &[&CallSample], (began, time): (Instant, Duration)) {
    let part = time / PARTS;
    let p99_in = |number: u32| {
        let is_in = |call: &&&CallSample| {
            let since = call.made.saturating_duration_since(began);
            (part * number..part * (number + 1)).contains(&since)
        };
        let took: Vec<Duration> = calls.iter().filter(is_in).map(|call| call.took).collect();
        quantile(&took, 0.99)
    };
    let parts: Vec<f64> = (0..PARTS).map(p99_in).collect();
    let quarter = parts.len() / 4;
    let middle = |number: usize| median(&parts[quarter * (number - 1)..quarter * number]).unwrap_or(f64::NAN);
    let worst = parts[quarter..].iter().copied().fold(f64::NAN, f64::max);
    report
        .figure(format!("{what} in its last quarter, p99 of {:.0} s each", part.as_secs_f64()), "ms", middle(4))
        .relative_to("in its second quarter", middle(2))
        .require(Target::RatioAtMost(FLAT))
        .note(format!("of {} calls; at most {worst:.1} ms after the first quarter", calls.len()));
}
