//! The daemon's configuration and the node that all measurements use.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use bench_report::BenchDaemon;

/// A single servant, which is kept.
pub(crate) const CONFIG: &str =
    "[capacity]\ncpus = 64.0\nmemory = \"64G\"\n[servant]\nreserve_cpus = 0.1\ngrace = \"1h\"\n";

/// Returns the workspace of the node that all measurements use.
pub(crate) fn fixture_path() -> PathBuf {
    bench_report::root().join("tests/packages/rosbridge_fixture")
}

/// Publishes that node from this workspace, and other nodes with it.
pub(crate) fn push_meter(daemon: &BenchDaemon, workspace: &Path, others: &[&str]) -> Result<()> {
    eprintln!("pushing rosbridge_fixture from {}", workspace.display());
    let node = ["--name", "meter", "--node", "rosbridge_fixture/meter"];
    daemon.push(&[&[workspace.to_str().context("UTF-8")?], &node[..], others].concat())?;
    Ok(())
}
