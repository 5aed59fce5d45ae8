//! `make bench ONLY=portal`: how fast messages and calls pass the daemon, between a client on loopback and a roscpp node
//! in a servant. Beside it, in turns: the same node by raw TCPROS; a process that moves the bytes over the same hops;
//! one that converts them by way of a tree of values; rosbridge_suite, where its sources are named; and another daemon that speaks TLS and holds a robot to its token and
//! the policy. Before that, WebSocket framing alone, beside other libraries of it
//! (`make bench ONLY=portal`; the words `framing of` as an argument run that part alone). Needs root. The program calls itself for the relays
//! (`relay PID HOW …`).

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
use bench_report::{Report, Target};
use bench_servant::Daemon;

use crate::node::Node;
use crate::watch::Watch;

/// One servant, which stays.
const CONFIG: &str =
    "[capacity]\ncpus = 64.0\nmemory = \"64G\"\n[servant]\nreserve_cpus = 0.1\ngrace = \"1h\"\n";

/// What the daemon may need, in megabytes.
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

/// Publishes the node that everything is measured with, and nothing else.
fn push(daemon: &Daemon) -> Result<()> {
    eprintln!("pushing rosbridge_fixture");
    daemon.push(&[
        fixture().to_str().context("UTF-8")?,
        "--name",
        "meter",
        "--node",
        "rosbridge_fixture/meter",
    ])?;
    Ok(())
}

fn fixture() -> PathBuf {
    bench_report::root().join("tests/packages/rosbridge_fixture")
}

/// Publishes it with rosbridge_suite beside it, or alone; whether that is there.
fn push_with_suite(report: &mut Report, daemon: &Daemon) -> Result<bool> {
    let Err(why) = suite::push(daemon, &fixture()) else {
        return Ok(true);
    };
    report.left_out(suite::NAME, format!("{why:#}"));
    push(daemon)?;
    Ok(false)
}

/// All figures whose names contain `only`.
fn measure(only: &str) -> Result<()> {
    let mut report = Report::new("portal");
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
    let node = Node::find(&daemon)?;
    let watch = Watch::over(daemon.pid());
    trips::measure(&mut report, &daemon, &node, only, suite)?;
    rates::measure(&mut report, &daemon, &node, only)?;
    secure::measure(&mut report, &daemon, &node, only)?;
    // The node may still owe messages afterwards, which nobody counts.
    slow_reader::measure(&mut report, &daemon, &node, only)?;
    let memory = watch.end()?;
    report
        .figure("memory of the daemon, at its peak", "MB", memory.rss)
        .reach(Target::AtMost(MEMORY))
        .note(format!(
            "resident, during all this; {:.1} MB of it in proportion (PSS)",
            memory.pss
        ));
    report.finish()?;
    Ok(())
}
