//! Half-open connections: they stay established, but nothing passes any more, as after a robot has lost its network.
//! Clients are disconnected, and links are replaced.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{BenchReport, Target};
use ros::bus::RosVersion;
use support::daemon::Daemon;
use support::freezer::Freezer;
use support::site::{NodeProcess, Site};
use support::twins::{self, Twin};

use crate::crowd::IdleCrowd;
use crate::greeters;
use crate::milliseconds::{median, worst};
use crate::resources::Resources;

/// Number of rosbridge clients.
const CLIENTS: usize = 100;
/// Number of stubs of one robot, each with a servant of its own.
const LINKS: usize = 5;
/// Response time that their SLA accepts: after that a link counts as silent.
const ACCEPTED: Duration = Duration::from_secs(1);

/// Durations of calls over working links, and of the first call after each link fell silent.
#[derive(Default)]
struct LinkTimes {
    standing: Vec<Duration>,
    silent: Vec<Duration>,
}

/// Runs both parts against one daemon; links fall silent `rounds` times.
pub(crate) fn measure(report: &mut BenchReport, daemon: &Daemon, rounds: u32) -> Result<()> {
    let let_go = lose_clients(daemon)?;
    let links = silence_links(daemon, rounds)?;
    greeters::stop_all(daemon)?;
    let title = format!("until {CLIENTS} half-open WebSockets are let go");
    report
        .figure(title, "s", let_go.as_secs_f64())
        .relative_to("the time without data that is configured", greeters::SILENCE.as_secs_f64())
        .require(Target::RatioAtMost(1.5));
    let all = rounds as usize * LINKS;
    let title = format!("half-open links of {all} whose next call is answered");
    report.figure(title, "", links.silent.len() as f64).require(Target::AtLeast(all as f64));
    report
        .figure("until that is answered", "ms", median(&links.silent))
        .relative_to("what the robot accepts (T_max)", ACCEPTED.as_secs_f64() * 1e3)
        .note(format!(
            "medians; at worst {:.0} ms; {:.0} ms by a link that stands",
            worst(&links.silent),
            median(&links.standing)
        ));
    Ok(())
}

/// Makes clients fall silent; returns how long the daemon keeps their descriptors.
fn lose_clients(daemon: &Daemon) -> Result<Duration> {
    // Has the servant started, so that the descriptors that are open for it are not counted.
    let mut first = daemon.robot(&greeters::robot_path("half-open"))?;
    greeters::greeting_count(&mut first)?;
    first.leave()?;
    let before = Resources::read(daemon)?.descriptors;
    let freezer = Freezer::new(&daemon.address)?;
    let url = format!("ws://{}/{}", freezer.server, greeters::robot_path("half-open"));
    let crowd = IdleCrowd::connect(&url, CLIENTS)?;
    let silent = freezer.freeze();
    ensure!(silent == CLIENTS, "{silent} of {CLIENTS} connections are there");
    let began = Instant::now();
    support::wait_until("the end of connections that carry nothing", || {
        let now = Resources::read(daemon)?.descriptors;
        Ok((now <= before).then_some(()).ok_or_else(|| format!("{now} descriptors, {before} before")))
    })?;
    let took = began.elapsed();
    drop(freezer);
    // The clients notice only now that their connections have ended.
    crowd.ask_and_leave()?;
    Ok(took)
}

/// Makes links fall silent and measures the time until the node behind each is heard again.
fn silence_links(daemon: &Daemon, rounds: u32) -> Result<LinkTimes> {
    let mut links = LinkTimes::default();
    let freezer = Freezer::new(&daemon.address)?;
    let (site, twin) = (Site::new()?, Twin::greeter(RosVersion::One));
    let app = site.node("/app")?;
    let server = freezer.server.to_string();
    let settings = format!("desire = {0}.0\nmax = {0}.0\n", ACCEPTED.as_secs());
    let mut stubs: Vec<NodeProcess> = Vec::new();
    for number in 0..LINKS {
        let argv = twin.argv(&format!("link{number}"), &[]);
        let robot = format!("linked-{number}");
        stubs.push(twin.stub(&site, (&server, &robot), &settings, &argv)?);
    }
    let ask = |number: usize| -> Result<Duration> {
        let began = Instant::now();
        support::wait_until(&format!("an answer of link{number}"), || {
            let answer = twins::greeting_count(&site, &app, &format!("/link{number}"));
            Ok(answer.map_err(|error| format!("{error:#}")))
        })?;
        Ok(began.elapsed())
    };
    for (number, stub) in stubs.iter().enumerate() {
        ask(number).with_context(|| stub.output())?;
    }
    for _ in 0..rounds {
        for number in 0..LINKS {
            links.standing.push(ask(number)?);
        }
        freezer.freeze();
        let began = Instant::now();
        for (number, stub) in stubs.iter().enumerate() {
            match ask(number) {
                Ok(_) => links.silent.push(began.elapsed()),
                Err(error) => {
                    eprintln!("link{number}: {error:#}; it said:\n{}", stub.output());
                }
            }
        }
    }
    Ok(links)
}
