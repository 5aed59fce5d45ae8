//! Latency of messages and calls: round trips, one at a time.

use std::time::Instant;

use anyhow::Result;
use bench_report::{BenchDaemon, BenchReport, Target, is_full_run, quantile_seconds};

use crate::contestants::{ClientPath, Encoding, PathTarget};
use crate::node::MeterNode;
use crate::relay::RelayHops;
use crate::turns::take_turns;

/// Round trips per turn; the first tenth is not counted.
const TRIPS: usize = 3000;

/// Measures a String through the node and back, and a call; also through rosbridge_suite, if `suite` is set.
pub(crate) fn measure(
    report: &mut BenchReport,
    daemon: &BenchDaemon,
    node: &MeterNode,
    only: &str,
    suite: bool,
) -> Result<()> {
    let string = RelayHops { inward: Some("/meter/ping"), outward: Some("/meter/pong"), ..RelayHops::default() };
    let call = RelayHops { service: Some("/meter/add"), ..RelayHops::default() };
    let daemons = ClientPath::Daemon(Encoding::Json);
    let mut all = vec![daemons, ClientPath::Bytes, ClientPath::Values, ClientPath::Direct];
    all.extend(suite.then_some(ClientPath::Suite));
    // Calls through trees of values would need a service implementation of their own.
    let calling = [daemons, ClientPath::Bytes, ClientPath::Direct];
    for (what, hops, ways, targets) in
        [("String there and back", string, &all[..], [1.3, 2.0]), ("service call", call, &calling[..], [1.5, f64::NAN])]
    {
        if !what.contains(only) {
            continue;
        }
        let course = PathTarget { daemon, node, hops };
        let mut best: Vec<_> = ways.iter().map(|way| (*way, [f64::INFINITY; 2])).collect();
        take_turns(what, if is_full_run() { 30 } else { 10 }, &mut best, |(way, best)| {
            *best = lower_of(*best, measure_turn(&course, *way)?);
            Ok(())
        })?;
        let (_, ours) = best[0];
        for (at, name) in [(0, "p50"), (1, "p99")] {
            for (way, theirs) in &best[1..] {
                let figure = report.figure(format!("{what}, {name}"), "µs", ours[at]);
                figure.relative_to(way.to_string(), theirs[at]);
                if *way == ClientPath::Bytes && targets[at].is_finite() {
                    figure.require(Target::RatioAtMost(targets[at]));
                }
            }
        }
    }
    Ok(())
}

/// Returns the lower of both medians, and of both late quantiles.
pub(crate) fn lower_of(one: [f64; 2], other: [f64; 2]) -> [f64; 2] {
    [one[0].min(other[0]), one[1].min(other[1])]
}

/// Returns p50 and p99 of one turn in microseconds.
pub(crate) fn measure_turn(course: &PathTarget<'_>, way: ClientPath) -> Result<[f64; 2]> {
    let mut open = course.open(way)?;
    let mut times = Vec::with_capacity(TRIPS);
    for _ in 0..TRIPS {
        let begun = Instant::now();
        open.line.send(&open.message)?;
        open.line.receive_messages()?;
        times.push(begun.elapsed());
    }
    course.close(open)?;
    Ok([0.5, 0.99].map(|share| quantile_seconds(&times[TRIPS / 10..], share) * 1e6))
}
