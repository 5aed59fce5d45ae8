//! How long a message or a call is under way: one at a time, there and back.

use std::time::{Duration, Instant};

use anyhow::Result;
use bench_report::{Report, Target};
use bench_servant::{Daemon, full};

use crate::contestants::{Course, Encoding, Way};
use crate::node::Node;
use crate::relay::Hops;

/// Per turn; the first tenth does not count.
const TRIPS: usize = 3000;

/// A String through the node and back; a call. Also by rosbridge_suite, if the `suite` is there.
pub(crate) fn measure(
    report: &mut Report,
    daemon: &Daemon,
    node: &Node,
    only: &str,
    suite: bool,
) -> Result<()> {
    let string = Hops {
        inward: Some("/meter/ping"),
        outward: Some("/meter/pong"),
        ..Hops::default()
    };
    let call = Hops {
        service: Some("/meter/add"),
        ..Hops::default()
    };
    let daemons = Way::Daemon(Encoding::Json);
    let mut all = vec![daemons, Way::Bytes, Way::Values, Way::Direct];
    all.extend(suite.then_some(Way::Suite));
    // Trees of values for calls would be a service stack of their own.
    let calling = [daemons, Way::Bytes, Way::Direct];
    for (what, hops, ways, targets) in [
        ("String there and back", string, &all[..], [1.3, 2.0]),
        ("service call", call, &calling[..], [1.5, f64::NAN]),
    ] {
        if !what.contains(only) {
            continue;
        }
        let course = Course { daemon, node, hops };
        let found = race(&course, ways, what)?;
        for (at, name) in [(0, "p50"), (1, "p99")] {
            let micros = |way: usize| found[way][at].as_secs_f64() * 1e6;
            for (index, way) in ways.iter().enumerate().skip(1) {
                let figure = report.figure(format!("{what}, {name}"), "µs", micros(0));
                figure.beside(way.to_string(), micros(index));
                if *way == Way::Bytes && targets[at].is_finite() {
                    figure.reach(Target::RatioAtMost(targets[at]));
                }
            }
        }
    }
    Ok(())
}

/// p50 and p99 of one turn.
pub(crate) fn turn(course: &Course<'_>, way: Way) -> Result<[Duration; 2]> {
    let mut open = course.open(way)?;
    let mut times = Vec::with_capacity(TRIPS);
    for _ in 0..TRIPS {
        let begun = Instant::now();
        open.line.send(&open.message)?;
        open.line.receive()?;
        times.push(begun.elapsed());
    }
    course.close(open)?;
    let counted = &mut times[TRIPS / 10..];
    counted.sort_unstable();
    Ok([50, 99].map(|part| counted[counted.len() * part / 100]))
}

/// The best p50 and the best p99 of each way's turns.
fn race(course: &Course<'_>, ways: &[Way], what: &str) -> Result<Vec<[Duration; 2]>> {
    let rounds = if full() { 30 } else { 10 };
    let mut best = vec![[Duration::MAX; 2]; ways.len()];
    for round in 1..=rounds {
        eprintln!("{what}: round {round} of {rounds}");
        for (way, best) in ways.iter().zip(&mut best) {
            for (best, found) in best.iter_mut().zip(turn(course, *way)?) {
                *best = (*best).min(found);
            }
        }
    }
    Ok(best)
}
