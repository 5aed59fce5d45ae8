//! `kill -9` of the daemon, and of a servant's shim, init and node: whether working robots recover, and the longest
//! time that takes.

use std::fmt;
use std::time::Instant;

use anyhow::Result;
use bench_report::{BenchReport, Target};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::json;
use support::daemon::{Daemon, DaemonSetup};
use support::procfs;

use crate::greeters::{self, ServantProcesses};
use crate::milliseconds::{median, worst};

/// Starts of a daemon that has no servants to take over.
const STARTS_ALONE: usize = 5;
/// Maximum time in milliseconds until a daemon that was killed answers again, whatever it has to adopt and to clean.
const LONGEST_ABSENCE: f64 = 5_000.0;

/// Kills daemons under load and starts new ones in their place.
pub(crate) fn kill_daemons(report: &mut BenchReport, setup: &DaemonSetup, rounds: u32) -> Result<()> {
    let mut alone = Vec::new();
    for _ in 0..STARTS_ALONE {
        let (daemon, took) = greeters::start(setup)?;
        alone.push(took);
        daemon.kill()?;
    }
    let robots = ["r1", "r2", "r3"].map(str::to_owned);
    let mut daemon = setup.start()?;
    for robot in &robots {
        greeters::greet(&mut daemon.robot(&greeters::robot_path(robot))?)?;
    }
    let before = greeters::servant_identities(&daemon, &robots)?;
    let (mut recovered, mut lost, mut forgotten, mut found) = (0, 0, 0, Vec::new());
    for round in 0..rounds {
        // One of the robots has a call in progress at that moment.
        let at_work = &robots[round as usize % robots.len()];
        let mut robot = daemon.robot(&greeters::robot_path(at_work))?;
        let counted = greeters::greet(&mut robot)?;
        robot.send(json!({"op": "call_service", "service": "/greeter/count", "args": {}}))?;
        daemon.kill()?;
        let (next, took) = greeters::start(setup)?;
        daemon = next;
        found.push(took);
        let after = greeters::servant_identities(&daemon, &robots);
        let lost_now = greeters::count_lost(&before, &after);
        lost += lost_now;
        // The node may have received more than the robot got answers for.
        let is_forgotten = greeters::ask_until_answered(&daemon, at_work)? < counted;
        forgotten += u32::from(is_forgotten);
        if lost_now == 0 && !is_forgotten {
            recovered += 1;
        } else {
            eprintln!("round {round}: {before:?} became {after:?}; forgotten: {is_forgotten}");
        }
        // A servant that was lost once would differ from the reference in every later round and be counted again.
        if lost > 0 {
            break;
        }
    }
    greeters::stop_all(&daemon)?;
    daemon.stop()?;
    report_recovered(report, "the daemon", recovered, rounds)
        .note(format!("{lost} servants of {} lost, {forgotten} nodes that had forgotten what they knew", robots.len()));
    let title = "until a daemon with servants to find answers";
    report.figure(title, "ms", median(&found)).relative_to("with none", median(&alone)).note("medians");
    report
        .figure("the same, the worst", "ms", worst(&found))
        .relative_to("with none, the worst", worst(&alone))
        .require(Target::AtMost(LONGEST_ABSENCE));
    Ok(())
}

/// Process of a servant that is killed.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Victim {
    Shim,
    Init,
    Node,
}

impl Victim {
    pub(crate) const ALL: [Self; 3] = [Self::Shim, Self::Init, Self::Node];

    fn pid(self, processes: ServantProcesses) -> i32 {
        match self {
            Self::Shim => processes.shim,
            Self::Init => processes.init,
            Self::Node => processes.node,
        }
    }
}

impl fmt::Display for Victim {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Shim => "shim",
            Self::Init => "init",
            Self::Node => "node",
        })
    }
}

/// Kills the process in servants of a new robot each time, because a robot whose servants fail repeatedly has to wait
/// before the next start.
pub(crate) fn kill_in_servants(report: &mut BenchReport, daemon: &Daemon, victim: Victim, rounds: u32) -> Result<()> {
    let (mut first, mut again) = (Vec::new(), Vec::new());
    for round in 0..rounds {
        let name = format!("{victim}-{round}");
        let began = Instant::now();
        let mut robot = daemon.robot(&greeters::robot_path(&name))?;
        greeters::greeting_count(&mut robot)?;
        first.push(began.elapsed());
        let processes = ServantProcesses::for_robot(daemon, &name)?;
        let began = Instant::now();
        kill(Pid::from_raw(victim.pid(processes)), Signal::SIGKILL)?;
        // The node ends whichever of the processes is killed; until then it may still answer.
        support::wait_until("the end of the node", || {
            let is_there = procfs::is_running(processes.node);
            Ok((!is_there).then_some(()).ok_or_else(|| "it runs".to_owned()))
        })?;
        match greeters::ask_until_answered(daemon, &name) {
            Ok(_) => again.push(began.elapsed()),
            Err(error) => eprintln!("{name} was not answered again: {error:#}"),
        }
        drop(robot);
        greeters::stop_all(daemon)?;
    }
    let recovered = u32::try_from(again.len()).unwrap_or(u32::MAX);
    report_recovered(report, &format!("a servant's {victim}"), recovered, rounds);
    let title = format!("from kill -9 of the {victim} to the next answer");
    report.figure(title, "ms", median(&again)).relative_to("a robot's first answer", median(&first)).note(format!(
        "medians; at worst {:.0} ms beside {:.0} ms",
        worst(&again),
        worst(&first)
    ));
    Ok(())
}

fn report_recovered<'a>(
    report: &'a mut BenchReport,
    victim: &str,
    recovered: u32,
    rounds: u32,
) -> &'a mut bench_report::Figure {
    let title = format!("kill -9 of {victim}, recovered of {rounds}");
    report.figure(title, "", f64::from(recovered)).require(Target::AtLeast(f64::from(rounds)))
}
