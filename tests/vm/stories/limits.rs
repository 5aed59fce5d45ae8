//! What the kernel enforces, and what is told of it.

use anyhow::{Context, ensure};
use serde_json::json;
use support::Told;

use crate::machine::{control, daemon};

pub fn limits_are_in_the_kernels_own_files() -> Told {
    let daemon = daemon()?;
    let mut robot = daemon.robot("small?robot=limited")?;
    robot.calls("/rosapi/get_time", json!({}))?;
    let servant = daemon.servant_of("small", "limited")?;
    let id = servant["id"].as_str().context("an id")?;
    ensure!(servant["cgroup_version"] == 2, "{servant:#}");
    ensure!(control(id, "cpu.max")? == "50000 100000");
    ensure!(control(id, "memory.max")? == (96 << 20).to_string());
    ensure!(control(id, "memory.swap.max")? == "0");
    ensure!(control(id, "pids.max")? == servant["enforced"]["pids"].to_string());
    Ok(())
}
