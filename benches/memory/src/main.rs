//! `make bench ONLY=memory`: what robots and nodes make the daemon and a servant's shim hold or do. The attacks are those that
//! the first release was measured with; its figures stand beside. Needs root.

#![forbid(unsafe_code)]

mod inside;
mod outside;
mod process;

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{Report, Target};
use serde_json::json;
use servant::launch::{self, Runtime};
use servant::netns::NetNs;
use support::daemon::{Daemon, Setup};
use support::robot::Robot;

use process::Process;

/// Megabytes (10⁶) of the default budget of a client, of a servant and of a shim.
const LIMIT: f64 = 268.0;
/// How long the shim's processor time is counted.
const DRIVEN: Duration = Duration::from_secs(5);

/// A servant, as its attackers see it.
pub(crate) struct Victim {
    /// Where its nodes live.
    pub(crate) network: NetNs,
    /// The process that runs its Master.
    pub(crate) shim: Process,
}

impl Victim {
    /// The servant of this robot, which has been started.
    fn of(daemon: &Daemon, service: &str, robot: &str) -> Result<Self> {
        let servant = daemon.servant_of(service, robot)?;
        let id = servant["id"].as_str().context("an id")?;
        let path = daemon.home.join("servants").join(id).join(launch::RUNTIME);
        let runtime: Runtime = launch::read(&path)?.context("a running servant")?;
        let node = servant["pids"][0].as_i64().context("a node")?;
        Ok(Self {
            network: NetNs::from_pid(i32::try_from(node)?)?,
            shim: Process(runtime.shim.pid),
        })
    }
}

/// Attacks, and prints what the process took at most.
fn attack(
    report: &mut Report,
    name: &str,
    process: Process,
    (peer, floor): (&str, f64),
    attack: impl FnOnce() -> Result<String>,
) -> Result<()> {
    let before = process.resident()?;
    process.forget_peak()?;
    let said = attack().with_context(|| name.to_owned())?;
    process.settles()?;
    let peak = process.peak()?;
    eprintln!("{name}: {peak:.0} MB, {before:.0} MB before; {said}");
    report
        .figure(name, "MB", peak)
        .beside(peer, floor)
        // Resident memory is more than what is counted: small buffers, copies, what the allocator keeps. How much each is of it was
        // not looked into; 1.4 times the limit was seen.
        .reach(Target::AtMost((before + 1.5 * LIMIT).round()))
        .note(format!("{before:.0} MB before; {said}"));
    Ok(())
}

fn main() -> Result<()> {
    let place = tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?;
    let daemon = Setup::new(&place.path().join("home"))
        .config("[servant]\nwarm_pool = 0\n")
        .start()?;
    let node = ["--node", "adder.py"];
    let deployer = daemon.deployer();
    deployer.pushes("adder_py", &node)?.succeeded()?;
    let small = ["--node", "adder.py", "--name", "small", "--cpus", "0.1"];
    deployer.pushes("adder_py", &small)?.succeeded()?;

    let mut polite = daemon.robot("adder_py?robot=polite")?;
    let mut answered = || -> Result<()> {
        let answer = polite.calls("/add_two", json!({"a": 1, "b": 1}))?;
        ensure!(answer["values"]["sum"] == 2, "{answer}");
        Ok(())
    };
    let mut robot = daemon.robot("adder_py?robot=victim")?;
    robot.calls("/add_two", json!({"a": 1, "b": 1}))?;
    let victim = Victim::of(&daemon, "adder_py", "victim")?;
    let whole = Process(daemon.pid());
    let mut report = Report::new("memory");
    let first = |megabytes| ("first release", megabytes);

    let name = "shim: 60 MB of parameters and 30 unread getParam(\"/\")";
    let mut other = daemon.robot("adder_py?robot=other")?;
    other.calls("/add_two", json!({"a": 1, "b": 1}))?;
    let other = Victim::of(&daemon, "adder_py", "other")?;
    attack(&mut report, name, other.shim, first(3300.0), || {
        inside::parameters(&other.network)
    })?;
    answered()?;
    let name = "daemon: 8 unfinished TCPROS frames of 250 MB";
    attack(&mut report, name, whole, first(2100.0), || {
        inside::frames(&victim.network, &mut robot)
    })?;
    answered()?;
    let name = "daemon: 20 unfinished WebSocket messages of 63 MB";
    attack(&mut report, name, whole, first(1300.0), || {
        outside::messages(&daemon)
    })?;
    answered()?;
    let name = "daemon: 4 unfinished bodies of trials of 330 MB";
    attack(&mut report, name, whole, first(1300.0), || {
        outside::trials(&daemon)
    })?;
    answered()?;
    let name = "daemon: a message of 60 MB that is 300 MB as JSON";
    let limit = ("limit of a servant", LIMIT);
    attack(&mut report, name, whole, limit, || outside::json(&daemon))?;
    answered()?;
    let name = "daemon: 20 connections of a robot that do not read";
    let limit = ("limit of a client", LIMIT);
    attack(&mut report, name, whole, limit, || outside::unread(&daemon))?;
    answered()?;

    let mut robot: Robot = daemon.robot("small?robot=small")?;
    robot.calls("/add_two", json!({"a": 1, "b": 1}))?;
    let small = Victim::of(&daemon, "small", "small")?;
    let (began, before) = (Instant::now(), small.shim.processor()?);
    inside::drive(&small.network, DRIVEN)?;
    let cores = (small.shim.processor()? - before).as_secs_f64() / began.elapsed().as_secs_f64();
    report
        .figure(
            "shim of a servant with 0.1 cores, asked all the time",
            "cores",
            cores,
        )
        .beside("first release", 0.41)
        .reach(Target::AtMost(0.12))
        .note(format!("over {DRIVEN:?}, from 4 connections"));
    daemon.deployer().types(&["stop", "--all"])?.succeeded()?;
    daemon.ends()?;
    report.finish()?;
    Ok(())
}
