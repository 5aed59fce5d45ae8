//! `make bench ONLY=portal`: throughput and latency between a client and a roscpp node in a servant, beside raw TCPROS,
//! a byte relay, a tree of values and rosbridge_suite; with TLS and the policy; and WebSocket framing alone. An
//! argument is part of the names of the figures to measure. Needs root.

#![forbid(unsafe_code)]

mod contestants;
mod framing;
mod line;
mod node;
mod rates;
mod raw;
mod relay;
mod secure;
mod setup;
mod slow_reader;
mod suite;
mod tls;
mod trips;
mod turns;
mod value;

use anyhow::{Result, bail};
use bench_report::{BenchDaemon, BenchReport, Process, Target};

use crate::node::MeterNode;
use crate::setup::{CONFIG, fixture_path, push_meter};

/// Memory that the daemon may use, in megabytes.
const MEMORY: f64 = 60.0;

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words.as_slice() {
        // Nothing is printed: its streams are connections.
        ["relay", rest @ ..] => std::process::exit(relay::run(rest).is_err().into()),
        [] => measure(""),
        [only] => measure(only),
        _ => bail!("it takes a part of a figure's name, or nothing; CLOUDROID_BENCH_FULL=1 measures longer"),
    }
}

/// Publishes the node with rosbridge_suite, or alone if that fails; returns whether rosbridge_suite is available.
fn push_with_suite(report: &mut BenchReport, daemon: &BenchDaemon) -> Result<bool> {
    let Err(why) = suite::push_with_fixture(daemon) else {
        return Ok(true);
    };
    report.skip(suite::NAME, format!("{why:#}"));
    push_meter(daemon, &fixture_path(), &[])?;
    Ok(false)
}

/// Measures all figures whose names contain `only`.
fn measure(only: &str) -> Result<()> {
    let mut report = BenchReport::new("portal");
    framing::measure(&mut report, only)?;
    if only.starts_with("framing") {
        report.finish()?;
        return Ok(());
    }
    let daemon = BenchDaemon::start(CONFIG)?;
    let suite = push_with_suite(&mut report, &daemon)?;
    let node = MeterNode::find(&daemon)?;
    let process = Process::from_pid(daemon.pid());
    process.reset_peak()?;
    trips::measure(&mut report, &daemon, &node, only, suite)?;
    rates::measure(&mut report, &daemon, &node, only)?;
    secure::measure(&mut report, &daemon, &node, only)?;
    // Last, because the node may still have messages to publish afterwards, which would be counted elsewhere.
    slow_reader::measure(&mut report, &daemon, &node, only)?;
    let figure = report.figure("memory of the daemon, at its peak", "MB", process.peak()?);
    figure.require(Target::AtMost(MEMORY)).note("resident, during all this");
    report.finish()?;
    Ok(())
}
