//! The node that all measurements use, and the configuration of its daemon.

use std::path::PathBuf;

use anyhow::{Context, Result};
use bench_report::BenchDaemon;

/// A single servant, which is kept.
pub(crate) const CONFIG: &str =
    "[capacity]\ncpus = 64.0\nmemory = \"64G\"\n[servant]\nreserve_cpus = 0.1\ngrace = \"1h\"\n";

/// Publishes the node that all measurements use, and nothing else.
pub(crate) fn push_meter(daemon: &BenchDaemon) -> Result<()> {
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

pub(crate) fn fixture_path() -> PathBuf {
    bench_report::root().join("tests/packages/rosbridge_fixture")
}
