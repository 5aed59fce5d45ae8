//! Latency of messages and calls: round trips, one at a time.

use std::time::{Duration, Instant};

use anyhow::Result;
use bench_report::{BenchDaemon, BenchReport, Target, is_full_run};

use crate::contestants::{ClientPath, Encoding, PathTarget};
use crate::node::MeterNode;
use crate::relay::RelayHops;

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
        let found = measure_in_turns(&course, ways, what)?;
        for (at, name) in [(0, "p50"), (1, "p99")] {
            let micros = |way: usize| found[way][at].as_secs_f64() * 1e6;
            for (index, way) in ways.iter().enumerate().skip(1) {
                let figure = report.figure(format!("{what}, {name}"), "µs", micros(0));
                figure.relative_to(way.to_string(), micros(index));
                if *way == ClientPath::Bytes && targets[at].is_finite() {
                    figure.require(Target::RatioAtMost(targets[at]));
                }
            }
        }
    }
    Ok(())
}

/// Returns p50 and p99 of one turn.
pub(crate) fn measure_turn(course: &PathTarget<'_>, way: ClientPath) -> Result<[Duration; 2]> {
    let mut open = course.open(way)?;
    let mut times = Vec::with_capacity(TRIPS);
    for _ in 0..TRIPS {
        let begun = Instant::now();
        open.line.send(&open.message)?;
        open.line.receive_messages()?;
        times.push(begun.elapsed());
    }
    course.close(open)?;
    let counted = &mut times[TRIPS / 10..];
    counted.sort_unstable();
    Ok([50, 99].map(|part| counted[counted.len() * part / 100]))
}

/// Returns the best p50 and the best p99 of each path's turns.
fn measure_in_turns(course: &PathTarget<'_>, ways: &[ClientPath], what: &str) -> Result<Vec<[Duration; 2]>> {
    let rounds = if is_full_run() { 30 } else { 10 };
    let mut best = vec![[Duration::MAX; 2]; ways.len()];
    for round in 1..=rounds {
        eprintln!("{what}: round {round} of {rounds}");
        for (way, best) in ways.iter().zip(&mut best) {
            for (best, found) in best.iter_mut().zip(measure_turn(course, *way)?) {
                *best = (*best).min(found);
            }
        }
    }
    Ok(best)
}
