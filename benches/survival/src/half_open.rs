//! Half-open connections: they stand, and nothing comes through them any more, as after a robot has lost its network. Clients that were there
//! are let go, and links are replaced.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{Report, Target};
use ros::bus::RosVersion;
use support::daemon::Daemon;
use support::freezer::Freezer;
use support::site::{Running, Site};
use support::twins::{self, Twin};

use crate::crowd::Crowd;
use crate::greeters;
use crate::milliseconds::{median, worst};
use crate::resources::Resources;

/// Clients of rosbridge.
const CLIENTS: usize = 100;
/// Stubs of one robot, each with a servant of its own.
const LINKS: usize = 5;
/// What their SLA accepts: a link is silent after that.
const ACCEPTED: Duration = Duration::from_secs(1);

/// What came of it.
#[derive(Debug)]
pub(crate) struct HalfOpen {
    /// Until the daemon had let all clients go.
    let_go: Duration,
    rounds: u32,
    /// Times of calls by links that stand, and of the first after each fell silent.
    standing: Vec<Duration>,
    silent: Vec<Duration>,
}

/// Does it to one daemon; links fall silent in so many rounds.
pub(crate) fn measure(daemon: &Daemon, rounds: u32) -> Result<HalfOpen> {
    let let_go = lose_clients(daemon)?;
    let mut outcome = HalfOpen {
        let_go,
        rounds,
        standing: Vec::new(),
        silent: Vec::new(),
    };
    silence_links(daemon, &mut outcome)?;
    greeters::stop_all(daemon)?;
    Ok(outcome)
}

/// Clients that fall silent: how long the daemon has descriptors for them.
fn lose_clients(daemon: &Daemon) -> Result<Duration> {
    // The servant stays, and what is open for it.
    let mut first = daemon.robot(&greeters::path("half-open"))?;
    greeters::count(&mut first)?;
    first.leaves()?;
    let before = Resources::of(daemon.pid())?.descriptors;
    let freezer = Freezer::new(&daemon.address)?;
    let url = format!("ws://{}/{}", freezer.server, greeters::path("half-open"));
    let crowd = Crowd::connect(&url, CLIENTS)?;
    let silent = freezer.freeze();
    ensure!(
        silent == CLIENTS,
        "{silent} of {CLIENTS} connections are there"
    );
    let began = Instant::now();
    support::until("the end of connections that carry nothing", || {
        let now = Resources::of(daemon.pid())?.descriptors;
        Ok((now <= before)
            .then_some(())
            .ok_or_else(|| format!("{now} descriptors, {before} before")))
    })?;
    let took = began.elapsed();
    drop(freezer);
    // Their own ends are told only now.
    crowd.ask()?;
    Ok(took)
}

/// Links that fall silent: how long until the node behind each is heard again.
fn silence_links(daemon: &Daemon, outcome: &mut HalfOpen) -> Result<()> {
    let freezer = Freezer::new(&daemon.address)?;
    let (site, twin) = (Site::new()?, Twin::greeter(RosVersion::One));
    let app = site.node("/app")?;
    let server = freezer.server.to_string();
    let settings = format!("desire = {0}.0\nmax = {0}.0\n", ACCEPTED.as_secs());
    let mut stubs: Vec<Running> = Vec::new();
    for number in 0..LINKS {
        let argv = twin.argv(&format!("link{number}"), &[]);
        let robot = format!("linked-{number}");
        stubs.push(twin.stub(&site, (&server, &robot), &settings, &argv)?);
    }
    let ask = |number: usize| -> Result<Duration> {
        let began = Instant::now();
        support::until(&format!("an answer of link{number}"), || {
            let answer = twins::count(&site, &app, &format!("/link{number}"));
            Ok(answer.map_err(|error| format!("{error:#}")))
        })?;
        Ok(began.elapsed())
    };
    for (number, stub) in stubs.iter().enumerate() {
        ask(number).with_context(|| stub.said())?;
    }
    for _ in 0..outcome.rounds {
        for number in 0..LINKS {
            outcome.standing.push(ask(number)?);
        }
        freezer.freeze();
        let began = Instant::now();
        for (number, stub) in stubs.iter().enumerate() {
            match ask(number) {
                Ok(_) => outcome.silent.push(began.elapsed()),
                Err(error) => {
                    eprintln!("link{number}: {error:#}; it said:\n{}", stub.said());
                }
            }
        }
    }
    Ok(())
}

impl HalfOpen {
    /// Adds their figures.
    pub(crate) fn tell(&self, report: &mut Report) {
        report
            .figure(
                format!("until {CLIENTS} half-open WebSockets are let go"),
                "s",
                self.let_go.as_secs_f64(),
            )
            .beside(
                "the time without data that is configured",
                greeters::SILENCE.as_secs_f64(),
            )
            .reach(Target::RatioAtMost(1.5));
        let all = self.rounds as usize * LINKS;
        report
            .figure(
                format!("half-open links of {all} whose next call is answered"),
                "",
                self.silent.len() as f64,
            )
            .reach(Target::AtLeast(all as f64));
        report
            .figure("until that is answered", "ms", median(&self.silent))
            .beside(
                "what the robot accepts (T_max)",
                ACCEPTED.as_secs_f64() * 1e3,
            )
            .note(format!(
                "medians; at worst {:.0} ms; {:.0} ms by a link that stands",
                worst(&self.silent),
                median(&self.standing)
            ));
    }
}
