//! Effect of a promise next to greedy neighbours: a robot's response time with and without a promise of cores.

use std::time::Duration;

use anyhow::Result;
use bench_report::{BenchReport, Target};
use support::daemon::Daemon;
use support::robot::Robot;

use crate::worker::{self, connect_robot, median, time_calls};

const NEIGHBOURS: [usize; 4] = [0, 2, 4, 8];
const LASTS: Duration = Duration::from_secs(15);
/// Time until newly started servants have settled.
const SETTLES: Duration = Duration::from_secs(8);
const PAUSE: Duration = Duration::from_millis(20);
const CONFIG: &str = "[servant]\nwarm_pool = 0\nstart = \"5m\"\n";

pub(crate) fn measure(report: &mut BenchReport) -> Result<()> {
    let promised = median_response_times("", &["--cpus", "0.9"])?;
    let unlimited = median_response_times("[capacity]\ncontroller = \"off\"\n", &[])?;
    for (index, count) in NEIGHBOURS.into_iter().enumerate().skip(1) {
        let slower = |times: &[f64]| (times[index] - times[0]).max(0.1);
        report
            .figure(
                format!("promised servant's call, slower by, {count} greedy neighbours"),
                "ms",
                slower(&promised),
            )
            .relative_to("without limits", slower(&unlimited))
            .require(Target::RatioAtMost(1.0 / 3.0))
            .note(format!(
                "medians; alone {:.1}, and {:.1} without limits",
                promised[0], unlimited[0]
            ));
    }
    Ok(())
}

/// Returns the median response time, in milliseconds, for each number of neighbours.
fn median_response_times(config: &str, limits: &[&str]) -> Result<Vec<f64>> {
    let place = worker::temporary_directory()?;
    let daemon = worker::start_daemon(place.path(), &format!("{config}{CONFIG}"))?;
    worker::push_worker(&daemon, "worker", limits)?;
    worker::push_worker(&daemon, "greedy", &["--param", "greedy=true"])?;
    let mut robot = connect_robot(&daemon, "worker?robot=measured&max_rrt=100ms")?;
    let mut greedy = Vec::new();
    let mut medians = Vec::new();
    for count in NEIGHBOURS {
        connect_neighbours(&daemon, &mut greedy, count)?;
        time_calls(&mut robot, SETTLES, PAUSE)?;
        medians.push(median(&time_calls(&mut robot, LASTS, PAUSE)?));
        eprintln!("{count} neighbours: {:.1} ms", medians[medians.len() - 1]);
    }
    drop(greedy);
    drop(robot);
    daemon.stop()?;
    Ok(medians)
}

/// Connects greedy robots until there are `count` of them.
fn connect_neighbours(daemon: &Daemon, greedy: &mut Vec<Robot>, count: usize) -> Result<()> {
    while greedy.len() < count {
        let path = format!("greedy?robot=greedy{}", greedy.len());
        greedy.push(connect_robot(daemon, &path)?);
    }
    Ok(())
}
