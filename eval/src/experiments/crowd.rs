//! Robots in this process and the services that they call, shared by experiments 9 and 10. A service computes for a
//! known core time per call; each robot is a WebSocket connection with a servant of its own, as any robot.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use support::binaries;
use support::daemon::{Daemon, DaemonSetup};
use support::robot::Robot;

use crate::examples::publish_once;

/// Directory below the checkout.
const PACKAGE: &str = "eval/packages/worker_cpp";
/// Executable of its node.
const EXECUTABLE: &str = "worker";
/// Configuration of all daemons: a servant that starts next to busy ones may take longer than by default.
const CONFIG: &str = "[servant]\nstart = \"2m\"\n";

/// A service whose node computes on one core for a fixed time at each call of `/work`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WorkerService {
    pub name: &'static str,
    /// Core time per call, in milliseconds.
    pub milliseconds: u32,
}

/// A service with short calls.
pub const SHORT: WorkerService = WorkerService { name: "short_work", milliseconds: 8 };
/// A service whose calls are as long as a detector's.
pub const LONG: WorkerService = WorkerService { name: "long_work", milliseconds: 50 };
/// A service whose call lasts longer than any measurement: its robot uses all the core time that it can get.
pub const ENDLESS: WorkerService = WorkerService { name: "endless_work", milliseconds: 3_600_000 };

/// True if cores are moved to robots that stated which response time they accept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Controller {
    On,
    Off,
}

impl Controller {
    pub fn name(self) -> &'static str {
        match self {
            Self::On => "on",
            Self::Off => "off",
        }
    }
}

/// A daemon for many robots, started on first use; its services remain published when it is restarted with another
/// configuration.
pub struct CrowdDaemon {
    setup: DaemonSetup,
    open: Option<(Controller, Daemon)>,
}

impl CrowdDaemon {
    /// Keeps its state below `place`.
    pub fn new(place: &Path) -> Self {
        Self { setup: DaemonSetup::new(&place.join("yard")).config(CONFIG), open: None }
    }

    /// Returns the daemon with this configuration and without servants.
    pub fn without_servants(&mut self, controller: Controller) -> Result<&Daemon> {
        let daemon = self.open(controller)?;
        let nobody = |all: &Value| all.as_array().is_some_and(Vec::is_empty).then_some(());
        if nobody(&daemon.api("/api/v1/servants")?).is_none() {
            daemon.deployer().run(&["stop", "--all"])?.expect_success()?;
            daemon.wait_for("/api/v1/servants", "the end of all servants", nobody)?;
        }
        Ok(daemon)
    }

    /// Returns the daemon with this configuration, with the servants it has.
    pub fn open(&mut self, controller: Controller) -> Result<&Daemon> {
        if self.open.as_ref().is_none_or(|open| open.0 != controller) {
            if let Some((_, before)) = self.open.take() {
                before.stop()?;
            }
            let lines = format!("[capacity]\ncontroller = \"{}\"\n", controller.name());
            let daemon = self.setup.clone().config(&lines).start()?;
            self.open = Some((controller, daemon));
        }
        let open = self.open.as_ref().context("it was just started")?;
        Ok(&open.1)
    }
}

/// Publishes a service, unless it has been published, or has failed, before.
pub fn publish(daemon: &Daemon, service: WorkerService) -> Result<()> {
    publish_once(daemon, service.name, || {
        let package = binaries::checkout().join(PACKAGE);
        let package = package.to_str().context("a path of UTF-8")?;
        let milliseconds = format!("milliseconds={}", service.milliseconds);
        let push = ["push", package, "--name", service.name, "--node", EXECUTABLE, "--param", &milliseconds];
        daemon.deployer().run(&push)?.expect_success()?;
        Ok(())
    })
}

/// Connects a robot and waits for its servant. `states` is appended to its query, such as `&cpus=0.5`.
pub fn join(daemon: &Daemon, service: WorkerService, name: &str, states: &str) -> Result<Robot> {
    let mut robot = daemon.robot(&format!("{}?robot={name}{states}", service.name))?;
    robot.call("/rosapi/get_time", json!({}))?;
    Ok(robot)
}

/// Makes one call; returns its duration in seconds.
pub fn time_call(robot: &mut Robot) -> Result<f64> {
    let asked = Instant::now();
    let answer = robot.call("/work", json!({}))?;
    let took = asked.elapsed().as_secs_f64();
    ensure!(answer["result"] == true, "a call failed: {answer}");
    Ok(took)
}

pub fn begin_call(robot: &mut Robot) -> Result<()> {
    robot.send(json!({"op": "call_service", "service": "/work", "args": {}}))
}

/// Makes one call after the other, each after a pause, until `to`; returns the durations in seconds of those started
/// after `from`.
pub fn time_calls(
    robot: &mut Robot,
    (from, to): (Instant, Instant),
    mut pause: impl FnMut() -> f64,
) -> Result<Vec<f64>> {
    let mut times = Vec::new();
    loop {
        let next = Instant::now() + Duration::from_secs_f64(pause());
        if next >= to {
            return Ok(times);
        }
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
        let asked = Instant::now();
        let took = time_call(robot)?;
        if asked >= from {
            times.push(took);
        }
    }
}

/// Returns the processor time in seconds that the servants of a service have used so far, and their current memory in
/// bytes.
pub fn usage(daemon: &Daemon, service: WorkerService) -> Result<(f64, f64)> {
    let mut sum = (0.0, 0.0);
    for servant in daemon.servants_of(service.name)? {
        let number = |key: &str| servant["usage"][key].as_f64();
        sum.0 += number("cpu_usec").context("a servant's processor time")? / 1e6;
        sum.1 += number("memory").context("a servant's memory")?;
    }
    Ok(sum)
}

pub fn cores() -> f64 {
    std::thread::available_parallelism().map_or(1.0, |cores| cores.get() as f64)
}
