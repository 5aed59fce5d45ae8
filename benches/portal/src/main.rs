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
mod node;
mod rates;
mod raw;
mod relay;
mod secure;
mod slow_reader;
mod suite;
mod trips;
mod value;
mod watch;

use std::path::PathBuf;

use anyhow::{Context, Result, bail, ensure};
use bench_report::{BenchReport, Target};
use bench_servant::Daemon;

use crate::node::MeterNode;
use crate::watch::MemoryWatch;

/// A single servant, which is kept.
const CONFIG: &str =
    "[capacity]\ncpus = 64.0\nmemory = \"64G\"\n[servant]\nreserve_cpus = 0.1\ngrace = \"1h\"\n";

/// Memory that the daemon may use, in megabytes.
const MEMORY: f64 = 60.0;

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words.as_slice() {
        ["relay", rest @ ..] => relay::run(rest),
        [] => measure(""),
        [only] => measure(only),
        _ => bail!(
            "it takes a part of a figure's name, or nothing; CLOUDROID_BENCH_FULL=1 measures longer"
        ),
    }
}

/// Publishes the node that all measurements use, and nothing else.
fn push_meter(daemon: &Daemon) -> Result<()> {
    eprintln!("pushing rosbridge_fixture");
    daemon.push(&[
        fixture_path().to_str().context("UTF-8")?,
        "--name",
        "meter",
        "--node",
        "rosbridge_fixture/meter",
    ])?;
    Ok(())
}

fn fixture_path() -> PathBuf {
    bench_report::root().join("tests/packages/rosbridge_fixture")
}

/// Publishes the node together with rosbridge_suite, or alone if that fails; returns whether rosbridge_suite is
/// available.
fn push_with_suite(report: &mut BenchReport, daemon: &Daemon) -> Result<bool> {
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
    let root = std::fs::metadata("/proc/self").is_ok_and(|about| {
        use std::os::unix::fs::MetadataExt;
        about.uid() == 0
    });
    ensure!(root, "servants are made by root: sudo make bench");
    let place = tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?;
    let daemon = Daemon::start(place, CONFIG, &[])?;
    let suite = push_with_suite(&mut report, &daemon)?;
    let node = MeterNode::find(&daemon)?;
    let watch = MemoryWatch::start(daemon.pid());
    trips::measure(&mut report, &daemon, &node, only, suite)?;
    rates::measure(&mut report, &daemon, &node, only)?;
    secure::measure(&mut report, &daemon, &node, only)?;
    // Last, because the node may still have messages to publish afterwards, which would be counted elsewhere.
    slow_reader::measure(&mut report, &daemon, &node, only)?;
    let memory = watch.stop()?;
    report
        .figure("memory of the daemon, at its peak", "MB", memory.rss)
        .require(Target::AtMost(MEMORY))
        .note(format!(
            "resident, during all this; {:.1} MB of it in proportion (PSS)",
            memory.pss
        ));
    report.finish()?;
    Ok(())
}
