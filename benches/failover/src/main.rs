//! `make bench ONLY=failover`: a 30 Hz camera, a node that leaves out what it cannot take, commands and a goal of
//! minutes through good, slow, lossy and cut links ([`camera`]). Needs root; `CLOUDROID_BENCH_RUN` selects runs by a
//! part of their name, `CLOUDROID_BENCH_LOG=1` prints what the stubs say. The answers to one request after another
//! while the network is degraded are experiment 6 of the evaluation.
//!
//! The robot uses this machine's network; the server is in a network namespace behind a cable that can be degraded (see
//! `support::cable`). Daemon, servant, stub and originals are the real programs.

#![forbid(unsafe_code)]

mod camera;

use anyhow::Result;
use bench_report::{BenchDaemon, BenchReport};
use support::cable::Cable;

fn main() -> Result<()> {
    let daemon = BenchDaemon::start("")?;
    let cable = Cable::new(&daemon.address)?;
    eprintln!("the network is degraded by {}", cable.mechanism());
    let mut report = BenchReport::new("failover");
    let measured = camera::measure(&mut report, &daemon, &cable);
    report.finish()?;
    measured
}
