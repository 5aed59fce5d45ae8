//! `make bench ONLY=portal`: throughput and latency of messages and calls through the daemon, between a client on
//! loopback and a roscpp node in a servant. Compared in turns: raw TCPROS to the same node; a process that copies the
//! bytes over the same hops; a process that converts them through a tree of values; rosbridge_suite, if its sources are
//! configured; and a second daemon with TLS, a robot's token and the policy. Before that, WebSocket framing alone,
//! compared with other libraries (the argument `framing of` runs only this part). Needs root. The program runs itself
//! as the relays (`relay PID HOW …`).

#![forbid(unsafe_code)]

mod contestants;
mod framing;
mod line;
mod meter;
mod node;
mod rates;
mod raw;
mod relay;
mod secure;
mod slow_reader;
mod suite;
mod tls;
mod trips;
mod value;
mod watch;

use anyhow::{Result, bail};
use bench_report::{BenchDaemon, BenchReport, Process, Target};

use crate::meter::{CONFIG, fixture_path, push_meter};
use crate::node::MeterNode;
use crate::watch::MemoryWatch;

/// Memory that the daemon may use, in megabytes.
const MEMORY: f64 = 60.0;

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words.as_slice() {
        ["relay", rest @ ..] => relay::run(rest),
        [] => measure(""),
        [only] => measure(only),
        _ => bail!("it takes a part of a figure's name, or nothing; CLOUDROID_BENCH_FULL=1 measures longer"),
    }
}

/// Publishes the node together with rosbridge_suite, or alone if that fails; returns whether rosbridge_suite is
/// available.
fn push_with_suite(report: &mut BenchReport, daemon: &BenchDaemon) -> Result<bool> {
    let Err(why) = suite::push_with_fixture(daemon, &fixture_path()) else {
        return Ok(true);
    };
    report.skip(suite::NAME, format!("{why:#}"));
    push_meter(daemon)?;
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
    let watch = MemoryWatch::start(Process::from_pid(daemon.pid()));
    trips::measure(&mut report, &daemon, &node, only, suite)?;
    rates::measure(&mut report, &daemon, &node, only)?;
    secure::measure(&mut report, &daemon, &node, only)?;
    // Last, because the node may still have messages to publish afterwards, which would be counted elsewhere.
    slow_reader::measure(&mut report, &daemon, &node, only)?;
    let memory = watch.stop()?;
    report
        .figure("memory of the daemon, at its peak", "MB", memory.resident)
        .require(Target::AtMost(MEMORY))
        .note(format!("resident, during all this; {:.1} MB of it in proportion (PSS)", memory.proportional));
    report.finish()?;
    Ok(())
}
