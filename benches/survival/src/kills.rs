//! `kill -9` of the daemon, and of a servant's shim, init and node: whether those come back who worked, and how long it takes at worst.

use std::fmt;
use std::time::{Duration, Instant};

use anyhow::Result;
use bench_report::{Report, Target};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::json;
use support::daemon::{Daemon, Setup};
use support::procfs;

use crate::greeters::{self, Processes};
use crate::milliseconds::{median, worst};

/// Starts of a daemon that has nothing to find.
const STARTS_ALONE: usize = 5;

/// Kills daemons under traffic, and starts others in their place.
pub(crate) fn of_daemons(report: &mut Report, setup: &Setup, rounds: u32) -> Result<()> {
    let mut alone = Vec::new();
    for _ in 0..STARTS_ALONE {
        let (daemon, took) = greeters::start(setup)?;
        alone.push(took);
        daemon.is_killed()?;
    }
    let robots = ["r1", "r2", "r3"].map(str::to_owned);
    let mut daemon = setup.start()?;
    for robot in &robots {
        greeters::greet(&mut daemon.robot(&greeters::path(robot))?)?;
    }
    let before = greeters::identities(&daemon, &robots)?;
    let (mut recovered, mut lost, mut forgotten, mut found) = (0, 0, 0, Vec::new());
    for round in 0..rounds {
        // One of them is at work when it happens.
        let at_work = &robots[round as usize % robots.len()];
        let mut robot = daemon.robot(&greeters::path(at_work))?;
        let counted = greeters::greet(&mut robot)?;
        robot.says(json!({"op": "call_service", "service": "/greeter/count", "args": {}}))?;
        daemon.is_killed()?;
        let (next, took) = greeters::start(setup)?;
        daemon = next;
        found.push(took);
        let after = greeters::identities(&daemon, &robots);
        let lost_now = greeters::count_lost(&before, &after);
        lost += lost_now;
        // More than was heard back may have been on its way.
        let is_forgotten = greeters::ask_again(&daemon, at_work)? < counted;
        forgotten += u32::from(is_forgotten);
        if lost_now == 0 && !is_forgotten {
            recovered += 1;
        } else {
            eprintln!("round {round}: {before:?} became {after:?}; forgotten: {is_forgotten}");
        }
        // Whoever was lost once differs from then on, and would be counted again.
        if lost > 0 {
            break;
        }
    }
    greeters::stop_all(&daemon)?;
    daemon.ends()?;
    tell_recovered(report, "the daemon", recovered, rounds).note(format!(
        "{lost} servants of {} lost, {forgotten} nodes that had forgotten what they knew",
        robots.len()
    ));
    report
        .figure(
            "until a daemon with servants to find answers",
            "ms",
            median(&found),
        )
        .beside("with none", median(&alone))
        .note("medians");
    report
        .figure("the same, the worst", "ms", worst(&found))
        .beside("with none, the worst", worst(&alone));
    Ok(())
}

/// Who is killed of a servant.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Victim {
    Shim,
    Init,
    Node,
}

impl Victim {
    pub(crate) const ALL: [Self; 3] = [Self::Shim, Self::Init, Self::Node];

    fn pid(self, processes: Processes) -> i32 {
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

/// What came of killing one of these again and again.
#[derive(Debug)]
pub(crate) struct Kills {
    victim: Victim,
    rounds: u32,
    /// From a robot's first connection to its first answer.
    first: Vec<Duration>,
    /// From the kill to its next answer, of those that came.
    again: Vec<Duration>,
}

/// Kills the victim in servants of robots that are new each time: whose servants fail again and again has to wait for the next one.
pub(crate) fn in_servants(daemon: &Daemon, victim: Victim, rounds: u32) -> Result<Kills> {
    let (mut first, mut again) = (Vec::new(), Vec::new());
    for round in 0..rounds {
        let name = format!("{victim}-{round}");
        let began = Instant::now();
        let mut robot = daemon.robot(&greeters::path(&name))?;
        greeters::count(&mut robot)?;
        first.push(began.elapsed());
        let processes = Processes::of(daemon, &name)?;
        let began = Instant::now();
        kill(Pid::from_raw(victim.pid(processes)), Signal::SIGKILL)?;
        // Whoever of them is killed, the node ends with it. Until then it may answer.
        support::until("the end of the node", || {
            let is_there = procfs::is_running(processes.node);
            Ok((!is_there)
                .then_some(())
                .ok_or_else(|| "it runs".to_owned()))
        })?;
        match greeters::ask_again(daemon, &name) {
            Ok(_) => again.push(began.elapsed()),
            Err(error) => eprintln!("{name} was not answered again: {error:#}"),
        }
        drop(robot);
        greeters::stop_all(daemon)?;
    }
    Ok(Kills {
        victim,
        rounds,
        first,
        again,
    })
}

impl Kills {
    /// Adds their figures.
    pub(crate) fn tell(&self, report: &mut Report) {
        let victim = self.victim;
        let recovered = u32::try_from(self.again.len()).unwrap_or(u32::MAX);
        tell_recovered(
            report,
            &format!("a servant's {victim}"),
            recovered,
            self.rounds,
        );
        report
            .figure(
                format!("from kill -9 of the {victim} to the next answer"),
                "ms",
                median(&self.again),
            )
            .beside("a robot's first answer", median(&self.first))
            .note(format!(
                "medians; at worst {:.0} ms beside {:.0} ms",
                worst(&self.again),
                worst(&self.first)
            ));
    }
}

fn tell_recovered<'a>(
    report: &'a mut Report,
    victim: &str,
    recovered: u32,
    rounds: u32,
) -> &'a mut bench_report::Figure {
    report
        .figure(
            format!("kill -9 of {victim}, recovered of {rounds}"),
            "",
            f64::from(recovered),
        )
        .reach(Target::AtLeast(f64::from(rounds)))
}
