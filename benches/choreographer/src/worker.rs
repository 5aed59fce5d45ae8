//! A daemon with services that keep a core busy for a while at each call, and robots that call them.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Result;
use serde_json::json;
use support::daemon::{Daemon, DaemonSetup};
use support::robot::Robot;

/// Package that is pushed.
const PACKAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/worker_py");
/// Core time of each call, in milliseconds.
pub(crate) const WORK: f64 = 50.0;

/// Starts a daemon with this configuration.
pub(crate) fn start_daemon(place: &Path, config: &str) -> Result<Daemon> {
    DaemonSetup::new(&place.join("home")).config(config).start()
}

/// Publishes the worker as a service `name`; `arguments` are further arguments of the push.
pub(crate) fn push_worker(daemon: &Daemon, name: &str, arguments: &[&str]) -> Result<()> {
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
    daemon.deployer().run(&words)?.expect_success()?;
    Ok(())
}

/// Connects a robot and waits until its servant is ready.
pub(crate) fn connect_robot(daemon: &Daemon, path: &str) -> Result<Robot> {
    let mut robot = daemon.robot(path)?;
    robot.call("/rosapi/get_time", json!({}))?;
    Ok(robot)
}

/// Calls for `lasts`, with a pause after each answer; returns the duration of each call in milliseconds.
pub(crate) fn time_calls(robot: &mut Robot, lasts: Duration, pause: Duration) -> Result<Vec<f64>> {
    let (began, mut times) = (Instant::now(), Vec::new());
    while began.elapsed() < lasts {
        let asked = Instant::now();
        robot.call("/work", json!({}))?;
        times.push(asked.elapsed().as_secs_f64() * 1000.0);
        std::thread::sleep(pause);
    }
    Ok(times)
}

/// Creates a temporary directory for a daemon.
pub(crate) fn temporary_directory() -> Result<tempfile::TempDir> {
    Ok(tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?)
}

/// Median; NaN for an empty slice.
pub(crate) fn median(times: &[f64]) -> f64 {
    bench_report::quantile(times, 0.5).unwrap_or(f64::NAN)
}

/// Number of cores of this machine.
pub(crate) fn cores() -> f64 {
    std::thread::available_parallelism().map_or(1.0, |cores| cores.get() as f64)
}
