//! What a promise is worth beside neighbours that take all they get: a robot's response time with and without one.

use std::time::Duration;

use anyhow::Result;
use bench_report::{Report, Target};
use support::daemon::Daemon;
use support::robot::Robot;

use crate::worker::{self, calls, median, robot};

const NEIGHBOURS: [usize; 4] = [0, 2, 4, 8];
const LASTS: Duration = Duration::from_secs(15);
/// Until what was started has come to rest.
const SETTLES: Duration = Duration::from_secs(8);
const PAUSE: Duration = Duration::from_millis(20);
const CONFIG: &str = "[servant]\nwarm_pool = 0\nstart = \"5m\"\n";

pub(crate) fn measure(report: &mut Report) -> Result<()> {
    let promised = times("", &["--cpus", "0.9"])?;
    let unlimited = times("[capacity]\ncontroller = \"off\"\n", &[])?;
    for (index, count) in NEIGHBOURS.into_iter().enumerate().skip(1) {
        let slower = |times: &[f64]| (times[index] - times[0]).max(0.1);
        report
            .figure(
                format!("promised servant's call, slower by, {count} greedy neighbours"),
                "ms",
                slower(&promised),
            )
            .beside("without limits", slower(&unlimited))
            .reach(Target::RatioAtMost(1.0 / 3.0))
            .note(format!(
                "medians; alone {:.1}, and {:.1} without limits",
                promised[0], unlimited[0]
            ));
    }
    Ok(())
}

/// Median response times with so many neighbours each.
fn times(config: &str, limits: &[&str]) -> Result<Vec<f64>> {
    let place = worker::place()?;
    let daemon = worker::daemon(place.path(), &format!("{config}{CONFIG}"))?;
    worker::push(&daemon, "worker", limits)?;
    worker::push(&daemon, "greedy", &["--param", "greedy=true"])?;
    let mut robot = robot(&daemon, "worker?robot=measured&max_rrt=100ms")?;
    let mut greedy = Vec::new();
    let mut medians = Vec::new();
    for count in NEIGHBOURS {
        beside(&daemon, &mut greedy, count)?;
        calls(&mut robot, SETTLES, PAUSE)?;
        medians.push(median(&calls(&mut robot, LASTS, PAUSE)?));
        eprintln!("{count} neighbours: {:.1} ms", medians[medians.len() - 1]);
    }
    drop(greedy);
    drop(robot);
    daemon.ends()?;
    Ok(medians)
}

/// Until there are so many neighbours.
fn beside(daemon: &Daemon, greedy: &mut Vec<Robot>, count: usize) -> Result<()> {
    while greedy.len() < count {
        let path = format!("greedy?robot=greedy{}", greedy.len());
        greedy.push(robot(daemon, &path)?);
    }
    Ok(())
}
