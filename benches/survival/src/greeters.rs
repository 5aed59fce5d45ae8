//! The service that all this is done to: a node that counts whom it has greeted, and so tells whether it is still the same one.

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use serde_json::{Value, json};
use servant::launch::{self, Runtime};
use support::daemon::{Daemon, Setup};
use support::robot::Robot;
use support::{leftovers, procfs};

/// Its name, and its package's.
pub(crate) const SERVICE: &str = "greeter_cpp";

/// Servants start when they are asked for, and stay until they are ended. Connections that say nothing are let go after
/// [`SILENCE`], which is waited for.
const CONFIG: &str = "keep_servants = true\n\
    [capacity]\ncpus = 4096.0\nmemory = \"4096G\"\n\
    [servant]\nwarm_pool = 0\ngrace = \"1h\"\n\
    [portal]\nping = \"2s\"\nidle = \"10s\"\n";
/// What `idle` is in it.
pub(crate) const SILENCE: Duration = Duration::from_secs(10);

/// Prepares a home with the service in it, and starts nothing.
pub(crate) fn publish(home: &Path) -> Result<Setup> {
    // The same address for all daemons of this home, as robots know it.
    let address = TcpListener::bind("127.0.0.1:0")?.local_addr()?;
    let setup = Setup::new(home).config(CONFIG).listen(&address.to_string());
    let daemon = setup.start()?;
    eprintln!("pushing {SERVICE}");
    daemon
        .deployer()
        .pushes(SERVICE, &["--node", "greeter"])?
        .succeeded()?;
    daemon.ends()?;
    Ok(setup)
}

/// Starts a daemon, and says how long it took until it answered.
pub(crate) fn start(setup: &Setup) -> Result<(Daemon, Duration)> {
    let began = Instant::now();
    Ok((setup.start()?, began.elapsed()))
}

/// Where a robot reaches its servant.
pub(crate) fn path(robot: &str) -> String {
    format!("{SERVICE}?robot={robot}")
}

/// Asks how many were greeted.
pub(crate) fn count(robot: &mut Robot) -> Result<u64> {
    let answer = robot.calls("/greeter/count", json!({"reset": false}))?;
    answer["values"]["count"]
        .as_u64()
        .with_context(|| answer.to_string())
}

/// Says whom to greet until the node has counted on, and how far.
pub(crate) fn greet(robot: &mut Robot) -> Result<u64> {
    let before = count(robot)?;
    robot.says(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    robot.awaits_subscriber("/greeter/name")?;
    support::until("a greeter that counts on", || {
        robot.says(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "x"}}))?;
        let now = count(robot)?;
        Ok((now > before).then_some(now).ok_or_else(|| now.to_string()))
    })
}

/// Connects again and again, as a robot does, until its node answers; returns how many were greeted.
pub(crate) fn ask_again(daemon: &Daemon, robot: &str) -> Result<u64> {
    let url = daemon.url(&path(robot));
    support::until(&format!("an answer for {robot}"), || {
        let answer = Robot::connect(&url).and_then(|mut robot| count(&mut robot));
        Ok(answer.map_err(|error| format!("{error:#}")))
    })
}

/// What must be the same of a servant that was found again.
#[derive(Debug, PartialEq)]
pub(crate) struct Identity {
    id: Value,
    pids: Value,
}

/// Who serves these robots, and as which processes.
pub(crate) fn identities(daemon: &Daemon, robots: &[String]) -> Result<Vec<Identity>> {
    let all = daemon.servants_of(SERVICE)?;
    let of = |robot: &String| {
        let servant = all.iter().find(|servant| servant["robot"] == **robot);
        let servant = servant.with_context(|| format!("{robot} has no servant"))?;
        Ok(Identity {
            id: servant["id"].clone(),
            pids: servant["pids"].clone(),
        })
    };
    robots.iter().map(of).collect()
}

/// Counts those of `before` that are not the same in `after`: all of them where that cannot be told.
pub(crate) fn count_lost(before: &[Identity], after: &Result<Vec<Identity>>) -> usize {
    let Ok(after) = after else {
        return before.len();
    };
    let pairs = before.iter().zip(after);
    pairs.filter(|(before, after)| before != after).count()
}

/// The processes of a servant.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Processes {
    /// The parent of all, which outlives the daemon.
    pub(crate) shim: i32,
    /// PID 1 of the container.
    pub(crate) init: i32,
    /// Its only node.
    pub(crate) node: i32,
}

impl Processes {
    /// Those of this robot's servant.
    pub(crate) fn of(daemon: &Daemon, robot: &str) -> Result<Self> {
        let servant = daemon.servant_of(SERVICE, robot)?;
        let id = servant["id"].as_str().context("an id")?;
        let place: PathBuf = daemon.home.join("servants").join(id).join(launch::RUNTIME);
        let runtime: Runtime = launch::read(&place)?.context("a running servant")?;
        let node = i32::try_from(servant["pids"][0].as_i64().context("a node")?)?;
        let parent = procfs::status(node).and_then(|status| status.get("PPid")?.parse().ok());
        Ok(Self {
            shim: runtime.shim.pid,
            init: parent.context("the node's parent")?,
            node,
        })
    }
}

/// Ends all servants.
pub(crate) fn stop_all(daemon: &Daemon) -> Result<()> {
    daemon.deployer().types(&["stop", "--all"])?.succeeded()?;
    support::until("the end of all servants", || {
        let left = daemon.api("/api/v1/servants")?;
        let is_empty = left.as_array().is_some_and(Vec::is_empty);
        Ok(is_empty.then_some(()).ok_or_else(|| format!("{left:#}")))
    })
}

/// Ends servants that have outlived their daemon, where something failed.
pub(crate) fn end_left(home: &Path) -> Result<()> {
    if leftovers::of(home).is_empty() {
        return Ok(());
    }
    let daemon = Setup::new(home).config(CONFIG).start()?;
    stop_all(&daemon)?;
    daemon.ends()?;
    Ok(())
}
