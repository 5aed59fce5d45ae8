//! Robots of this process, and the services that they ask: what experiments 9 and 10 share. A service computes for a known time of a
//! core at each call; each robot is a WebSocket connection of its own, with a servant of its own, as any robot's.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use support::binaries;
use support::daemon::{Daemon, Setup};
use support::robot::Robot;

use crate::attempts;

/// Below the checkout.
const PACKAGE: &str = "eval/packages/worker_cpp";
/// Of its node.
const EXECUTABLE: &str = "worker";
/// What both daemons have: servants that start beside others that work may take longer than by default.
const CONFIG: &str = "[servant]\nstart = \"2m\"\n";

/// A service of a node that computes for so long at each call of `/work`, on one core.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Service {
    /// Its name.
    pub name: &'static str,
    /// Of a core, for each call.
    pub milliseconds: u32,
}

/// Calls are short.
pub const SHORT: Service = Service {
    name: "short_work",
    milliseconds: 8,
};
/// Calls are as long as those of a detector.
pub const LONG: Service = Service {
    name: "long_work",
    milliseconds: 50,
};
/// One call lasts longer than any measurement: whoever makes it takes a core for as long as it can get one.
pub const ENDLESS: Service = Service {
    name: "endless_work",
    milliseconds: 3_600_000,
};

/// Whether cores are moved to robots that stated what they accept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Controller {
    /// As the daemon does by default.
    On,
    /// Limits stay as they were asked for.
    Off,
}

impl Controller {
    /// As tables name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::On => "on",
            Self::Off => "off",
        }
    }
}

/// A daemon for crowds, started when it is first needed: what is published stays when it is started with another configuration.
pub struct Yard {
    setup: Setup,
    open: Option<(Controller, Daemon)>,
}

impl Yard {
    /// With its state below `place`.
    pub fn new(place: &Path) -> Self {
        Self {
            setup: Setup::new(&place.join("yard")).config(CONFIG),
            open: None,
        }
    }

    /// The daemon with this configuration, where nobody is served.
    pub fn cleared(&mut self, controller: Controller) -> Result<&Daemon> {
        let daemon = self.open(controller)?;
        let nobody = |all: &Value| all.as_array().is_some_and(Vec::is_empty).then_some(());
        if nobody(&daemon.api("/api/v1/servants")?).is_none() {
            daemon.deployer().types(&["stop", "--all"])?.succeeded()?;
            daemon.awaits("/api/v1/servants", "the end of all servants", nobody)?;
        }
        Ok(daemon)
    }

    /// The daemon with this configuration, with whoever is served there.
    pub fn open(&mut self, controller: Controller) -> Result<&Daemon> {
        if self.open.as_ref().is_none_or(|open| open.0 != controller) {
            if let Some((_, before)) = self.open.take() {
                before.ends()?;
            }
            let lines = format!("[capacity]\ncontroller = \"{}\"\n", controller.name());
            let daemon = self.setup.clone().config(&lines).start()?;
            self.open = Some((controller, daemon));
        }
        let open = self.open.as_ref().context("it was just started")?;
        Ok(&open.1)
    }
}

/// Publishes a service, unless that was done before or has failed before.
pub fn publishes(daemon: &Daemon, service: Service) -> Result<()> {
    let services = daemon.deployer().asks(&["services"])?;
    let known = |all: &Vec<Value>| all.iter().any(|one| one["name"] == service.name);
    if services.as_array().is_some_and(known) {
        return Ok(());
    }
    attempts::once(service.name, || pushes(daemon, service))
}

fn pushes(daemon: &Daemon, service: Service) -> Result<()> {
    let package = binaries::checkout().join(PACKAGE);
    let package = package.to_str().context("a path of UTF-8")?;
    let milliseconds = format!("milliseconds={}", service.milliseconds);
    let push = [
        "push",
        package,
        "--name",
        service.name,
        "--node",
        EXECUTABLE,
    ];
    let push = [&push[..], &["--param", &milliseconds]].concat();
    daemon.deployer().types(&push)?.succeeded()?;
    Ok(())
}

/// A robot that has a servant. `states` is the rest of its query, such as `&cpus=0.5`.
pub fn joins(daemon: &Daemon, service: Service, name: &str, states: &str) -> Result<Robot> {
    let mut robot = daemon.robot(&format!("{}?robot={name}{states}", service.name))?;
    robot.calls("/rosapi/get_time", json!({}))?;
    Ok(robot)
}

/// One call: the seconds until its answer.
pub fn call(robot: &mut Robot) -> Result<f64> {
    let asked = Instant::now();
    let answer = robot.calls("/work", json!({}))?;
    let took = asked.elapsed().as_secs_f64();
    ensure!(answer["result"] == true, "a call failed: {answer}");
    Ok(took)
}

/// Begins a call whose answer is not waited for.
pub fn begins(robot: &mut Robot) -> Result<()> {
    robot.says(json!({"op": "call_service", "service": "/work", "args": {}}))
}

/// One call after the other, each after a pause, until `to`: the seconds that those took which were made after `from`.
pub fn calls(
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
        let took = call(robot)?;
        if asked >= from {
            times.push(took);
        }
    }
}

/// Seconds of processor time that the servants of a service used so far, and the bytes that they have now.
pub fn usage(daemon: &Daemon, service: Service) -> Result<(f64, f64)> {
    let mut sum = (0.0, 0.0);
    for servant in daemon.servants_of(service.name)? {
        let number = |key: &str| servant["usage"][key].as_f64();
        sum.0 += number("cpu_usec").context("a servant's processor time")? / 1e6;
        sum.1 += number("memory").context("a servant's memory")?;
    }
    Ok(sum)
}

/// Cores of this machine.
pub fn cores() -> f64 {
    std::thread::available_parallelism().map_or(1.0, |cores| cores.get() as f64)
}
