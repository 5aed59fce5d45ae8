//! The service under test: a node that counts how many names it has greeted, which shows whether it is still the same
//! process.

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use serde_json::{Value, json};
use servant::launch::{self, RuntimeRecord};
use support::daemon::{Daemon, DaemonSetup};
use support::robot::Robot;
use support::{leftovers, procfs};

/// Name of the service and of its package.
pub(crate) const SERVICE: &str = "greeter_cpp";

/// Servants start on demand and are kept until they are stopped. Silent connections are closed after [`SILENCE`], which
/// the benchmarks wait for.
const CONFIG: &str = "keep_servants = true\n\
    [capacity]\ncpus = 4096.0\nmemory = \"4096G\"\n\
    [servant]\nwarm_pool = 0\ngrace = \"1h\"\n\
    [portal]\nping = \"2s\"\nidle = \"10s\"\n";
/// Value of `idle` in the configuration.
pub(crate) const SILENCE: Duration = Duration::from_secs(10);

/// Prepares a home in which the service is published; the daemon is stopped again.
pub(crate) fn publish(home: &Path) -> Result<DaemonSetup> {
    // The same address for all daemons of this home, because robots keep using it.
    let address = TcpListener::bind("127.0.0.1:0")?.local_addr()?;
    let setup = DaemonSetup::new(home).config(CONFIG).listen(&address.to_string());
    let daemon = setup.start()?;
    eprintln!("pushing {SERVICE}");
    daemon.deployer().push(SERVICE, &["--node", "greeter"])?.expect_success()?;
    daemon.stop()?;
    Ok(setup)
}

/// Starts a daemon; returns it with the time until it answered.
pub(crate) fn start(setup: &DaemonSetup) -> Result<(Daemon, Duration)> {
    let began = Instant::now();
    Ok((setup.start()?, began.elapsed()))
}

/// URL path of a robot's servant.
pub(crate) fn robot_path(robot: &str) -> String {
    format!("{SERVICE}?robot={robot}")
}

/// Calls the node; returns how many names it has greeted.
pub(crate) fn greeting_count(robot: &mut Robot) -> Result<u64> {
    let answer = robot.call("/greeter/count", json!({"reset": false}))?;
    answer["values"]["count"].as_u64().with_context(|| answer.to_string())
}

/// Publishes a name until the node's count has grown; returns the count.
pub(crate) fn greet(robot: &mut Robot) -> Result<u64> {
    let before = greeting_count(robot)?;
    robot.send(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    robot.wait_for_subscriber("/greeter/name")?;
    support::wait_until("a greeter that counts on", || {
        robot.send(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "x"}}))?;
        let now = greeting_count(robot)?;
        Ok((now > before).then_some(now).ok_or_else(|| now.to_string()))
    })
}

/// Reconnects, as a robot does, until its node answers; returns how many names were greeted.
pub(crate) fn ask_until_answered(daemon: &Daemon, robot: &str) -> Result<u64> {
    let url = daemon.url(&robot_path(robot));
    support::wait_until(&format!("an answer for {robot}"), || {
        let answer = Robot::connect(&url).and_then(|mut robot| greeting_count(&mut robot));
        Ok(answer.map_err(|error| format!("{error:#}")))
    })
}

/// Properties that a servant keeps when a daemon takes it over.
#[derive(Debug, PartialEq)]
pub(crate) struct ServantIdentity {
    id: Value,
    pids: Value,
}

/// Returns the servants of these robots with their process ids.
pub(crate) fn servant_identities(daemon: &Daemon, robots: &[String]) -> Result<Vec<ServantIdentity>> {
    let all = daemon.servants_of(SERVICE)?;
    let of = |robot: &String| {
        let servant = all.iter().find(|servant| servant["robot"] == **robot);
        let servant = servant.with_context(|| format!("{robot} has no servant"))?;
        Ok(ServantIdentity { id: servant["id"].clone(), pids: servant["pids"].clone() })
    };
    robots.iter().map(of).collect()
}

/// Counts the servants of `before` that differ in `after`; all of them if `after` is an error.
pub(crate) fn count_lost(before: &[ServantIdentity], after: &Result<Vec<ServantIdentity>>) -> usize {
    let Ok(after) = after else {
        return before.len();
    };
    let pairs = before.iter().zip(after);
    pairs.filter(|(before, after)| before != after).count()
}

/// The processes of a servant.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ServantProcesses {
    /// The parent of the others, which outlives the daemon.
    pub(crate) shim: i32,
    /// PID 1 of the container.
    pub(crate) init: i32,
    /// The only node.
    pub(crate) node: i32,
}

impl ServantProcesses {
    /// Returns the processes of the servant of `robot`.
    pub(crate) fn for_robot(daemon: &Daemon, robot: &str) -> Result<Self> {
        let servant = daemon.servant_of(SERVICE, robot)?;
        let id = servant["id"].as_str().context("an id")?;
        let place: PathBuf = daemon.home.join("servants").join(id).join(launch::RUNTIME);
        let runtime: RuntimeRecord = launch::read_record(&place)?.context("a running servant")?;
        let node = i32::try_from(servant["pids"][0].as_i64().context("a node")?)?;
        let parent = procfs::status(node).and_then(|status| status.get("PPid")?.parse().ok());
        Ok(Self { shim: runtime.shim.pid, init: parent.context("the node's parent")?, node })
    }
}

/// Stops all servants.
pub(crate) fn stop_all(daemon: &Daemon) -> Result<()> {
    daemon.deployer().run(&["stop", "--all"])?.expect_success()?;
    support::wait_until("the end of all servants", || {
        let left = daemon.api("/api/v1/servants")?;
        let is_empty = left.as_array().is_some_and(Vec::is_empty);
        Ok(is_empty.then_some(()).ok_or_else(|| format!("{left:#}")))
    })
}

/// Stops servants that have outlived their daemon after a failure.
pub(crate) fn end_leftovers(home: &Path) -> Result<()> {
    if leftovers::find_leftovers(home).is_empty() {
        return Ok(());
    }
    let daemon = DaemonSetup::new(home).config(CONFIG).start()?;
    stop_all(&daemon)?;
    daemon.stop()?;
    Ok(())
}
