//! A daemon with services that use a core for a while at each call, and robots that call them.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Result;
use serde_json::json;
use support::daemon::{Daemon, Setup};
use support::robot::Robot;

/// The package that is pushed.
const PACKAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/worker_py");
/// Milliseconds of a core for each call.
pub(crate) const WORK: f64 = 50.0;

/// A daemon with this configuration.
pub(crate) fn daemon(place: &Path, config: &str) -> Result<Daemon> {
    Setup::new(&place.join("home")).config(config).start()
}

/// Publishes it under this name, with more arguments of the push.
pub(crate) fn push(daemon: &Daemon, name: &str, arguments: &[&str]) -> Result<()> {
    eprintln!("pushing {name}: base and dependencies are made now, if they are not cached");
    let milliseconds = format!("milliseconds={WORK}");
    let words = [
        "push",
        PACKAGE,
        "--name",
        name,
        "--node",
        "worker.py",
        "--param",
        &milliseconds,
    ];
    let words = [&words, arguments].concat();
    daemon.deployer().types(&words)?.succeeded()?;
    Ok(())
}

/// A robot whose servant is ready.
pub(crate) fn robot(daemon: &Daemon, path: &str) -> Result<Robot> {
    let mut robot = daemon.robot(path)?;
    robot.calls("/rosapi/get_time", json!({}))?;
    Ok(robot)
}

/// Calls for so long, and pauses after each answer; milliseconds of each call.
pub(crate) fn calls(robot: &mut Robot, lasts: Duration, pause: Duration) -> Result<Vec<f64>> {
    let (began, mut times) = (Instant::now(), Vec::new());
    while began.elapsed() < lasts {
        let asked = Instant::now();
        robot.calls("/work", json!({}))?;
        times.push(asked.elapsed().as_secs_f64() * 1000.0);
        std::thread::sleep(pause);
    }
    Ok(times)
}

/// A place for a daemon.
pub(crate) fn place() -> Result<tempfile::TempDir> {
    Ok(tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?)
}

/// The middle one.
pub(crate) fn median(times: &[f64]) -> f64 {
    bench_report::quantile(times, 0.5).unwrap_or(f64::NAN)
}

/// Cores of this machine.
pub(crate) fn cores() -> f64 {
    std::thread::available_parallelism().map_or(1.0, |cores| cores.get() as f64)
}
