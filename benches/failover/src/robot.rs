//! The robot's side of one run: a ROS Master, a camera, and the stub or the original.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use nix::sys::signal::Signal;
use ros::bus::{Publisher, Subscription};
use support::cable::Cable;
use support::daemon::Daemon;
use support::people::{self, PeopleCamera, picture};
use support::site::{NodeProcess, Site};
use tokio::time::{Instant as At, sleep_until, timeout};

use crate::{BAD, BADNESS, REQUESTS};

/// Maximum time to wait for anything that is not measured.
const PATIENCE: Duration = Duration::from_secs(120);
/// Time to wait for late answers after the last request.
const STRAGGLERS: Duration = Duration::from_secs(10);
const SIZE: (u32, u32) = (640, 480);
/// Stamps of measured requests are greater than this number.
const FIRST: u32 = 1000;

/// Inputs of a run, and when to send them.
pub struct FailoverPlan<'a> {
    /// Requests per second.
    pub rate: f64,
    /// T_desire and T_max, seconds.
    pub times: (f64, f64),
    /// `cold`, `warm`, `none`, or `alone`: the original without a stub.
    pub local: &'a str,
    /// File of raw bgr8 pictures.
    pub pictures: &'a Path,
}

/// Measurements of one request.
#[derive(Clone, Copy, Default)]
pub struct FailoverSample {
    /// Seconds until the first answer; `None` if it was never answered.
    pub after: Option<f64>,
    /// Number of answers.
    pub count: usize,
    /// True if the first answer came from the local original.
    pub local: bool,
    /// Q after this request had been counted.
    pub q: Option<f64>,
}

/// Results of one run.
pub struct FailoverResult {
    /// One sample per request.
    pub answers: Vec<FailoverSample>,
    /// T_desire and T_max, seconds.
    pub times: (f64, f64),
    /// How often the local original was asked as well.
    pub fed: usize,
    /// How often it was no longer asked.
    pub unfed: usize,
    /// How often its process was started.
    pub started: usize,
    /// How often its process was stopped.
    pub stopped: usize,
}

impl FailoverResult {
    /// Number of requests answered within T_max.
    pub fn count_in_time(&self) -> usize {
        self.answers
            .iter()
            .filter(|answer| !self.is_late(answer))
            .count()
    }

    /// Returns whether a request was answered after T_max, or never.
    pub fn is_late(&self, answer: &FailoverSample) -> bool {
        answer.after.is_none_or(|after| after > self.times.1)
    }

    /// Number of late requests from each onset of degradation to the next.
    pub fn count_late_by_onset(&self) -> Vec<usize> {
        let ends = BAD.iter().skip(1).map(|(first, _)| first - 1);
        let ends = ends.chain([REQUESTS]);
        let late = |((first, _), end): (&(usize, usize), usize)| {
            let during = self.answers[first - 1..end].iter();
            during.filter(|answer| self.is_late(answer)).count()
        };
        BAD.iter().zip(ends).map(late).collect()
    }

    /// Median response time of the answered requests, in seconds.
    pub fn median_response_time(&self) -> f64 {
        let times = self.answers.iter().filter_map(|answer| answer.after);
        bench_report::quantile(&times.collect::<Vec<f64>>(), 0.5).unwrap_or(f64::NAN)
    }
}

/// Runs `plan`.
pub fn run(daemon: &Daemon, cable: &Cable, plan: &FailoverPlan) -> Result<FailoverResult> {
    let site = Site::new()?;
    let mut node = start_node(&site, daemon, cable, plan)?;
    let outcome = run_requests(&site, cable, plan);
    let mut outcome = outcome.with_context(|| format!("the node said:\n{}", node.output()))?;
    // SIGINT, as roslaunch sends it: the stub ends the servant's node.
    node.signal(Signal::SIGINT)?;
    node.wait_for_exit()?;
    if std::env::var_os("CLOUDROID_BENCH_LOG").is_some() {
        eprintln!("{}", node.output());
    }
    parse_log(&node.output(), &mut outcome);
    if plan.local == "alone" {
        outcome
            .answers
            .iter_mut()
            .for_each(|answer| answer.local = true);
    }
    Ok(outcome)
}

fn start_node(
    site: &Site,
    daemon: &Daemon,
    cable: &Cable,
    plan: &FailoverPlan,
) -> Result<NodeProcess> {
    let service = "opencv_apps";
    if plan.local == "alone" {
        return people::original(site, daemon, service);
    }
    let settings = format!(
        "local = \"{}\"\ndesire = {:?}\nmax = {:?}\nfallback_after = 300.0",
        plan.local, plan.times.0, plan.times.1
    );
    let robot = format!("failover-{}", plan.local);
    let environment = [("CLOUDROID_LOG", "info,requests=debug")];
    let who = (service, robot.as_str());
    people::stub(site, daemon, cable, who, &settings, &environment)
}

fn run_requests(site: &Site, cable: &Cable, plan: &FailoverPlan) -> Result<FailoverResult> {
    let mut camera = PeopleCamera::new(site, 1)?;
    let (image, found) = (&*camera.image, &mut camera.found);
    let pictures = std::fs::read(plan.pictures)?;
    let pictures: Vec<&[u8]> = pictures
        .chunks_exact((SIZE.0 * SIZE.1 * 3) as usize)
        .collect();
    site.runtime.block_on(async {
        warm_up(image, found, pictures[0], plan.times.1).await?;
        measure(image, found, cable, plan, &pictures).await
    })
}

async fn measure(
    image: &dyn Publisher,
    found: &mut Subscription,
    cable: &Cable,
    plan: &FailoverPlan<'_>,
    pictures: &[&[u8]],
) -> Result<FailoverResult> {
    let mut answers = vec![FailoverSample::default(); REQUESTS];
    let mut sent = vec![Instant::now(); REQUESTS];
    let begun = At::now();
    for index in 0..REQUESTS {
        let message = picture(FIRST + index as u32, SIZE, pictures[index % pictures.len()]);
        let due = begun + Duration::from_secs_f64(index as f64 / plan.rate);
        collect(found, &mut answers, &sent, due).await;
        let number = index + 1;
        if BAD.iter().any(|(first, _)| *first == number) {
            cable.degrade(BADNESS)?;
        }
        if BAD.iter().any(|(_, last)| *last + 1 == number) {
            cable.restore()?;
        }
        sent[index] = Instant::now();
        image.publish(message);
    }
    collect(found, &mut answers, &sent, At::now() + STRAGGLERS).await;
    Ok(FailoverResult {
        answers,
        times: plan.times,
        fed: 0,
        unfed: 0,
        started: 0,
        stopped: 0,
    })
}

/// Sends requests until ten answers in a row have arrived within `max` seconds: by then all parts are warmed up.
async fn warm_up(
    image: &dyn Publisher,
    found: &mut Subscription,
    pixels: &[u8],
    max: f64,
) -> Result<()> {
    let begun = Instant::now();
    let mut answered = 0;
    let mut number = 1;
    while answered < 10 {
        ensure!(
            begun.elapsed() < PATIENCE,
            "the first pictures are not answered in time"
        );
        image.publish(picture(number, SIZE, pixels));
        let asked = Instant::now();
        let waiting = timeout(Duration::from_secs(2), found.messages.recv()).await;
        let in_time = waiting.is_ok() && asked.elapsed().as_secs_f64() <= max;
        answered = if in_time { answered + 1 } else { 0 };
        number += 1;
    }
    // A late answer must not be mistaken for an answer to a measured request.
    tokio::time::sleep(Duration::from_secs(1)).await;
    while found.messages.try_recv().is_some() {}
    Ok(())
}

/// Records answers until `until`.
async fn collect(
    found: &mut Subscription,
    answers: &mut [FailoverSample],
    sent: &[Instant],
    until: At,
) {
    loop {
        let message = tokio::select! {
            biased;
            Some(message) = found.messages.recv() => message,
            () = sleep_until(until) => return,
        };
        let index = people::number(&message).and_then(|secs| secs.checked_sub(FIRST));
        let Some(index) = index
            .map(|index| index as usize)
            .filter(|index| *index < answers.len())
        else {
            continue;
        };
        let answer = &mut answers[index];
        answer.count += 1;
        answer
            .after
            .get_or_insert(sent[index].elapsed().as_secs_f64());
    }
}

/// Reads from the stub's log what it says about each request and about the local original.
fn parse_log(log: &str, outcome: &mut FailoverResult) {
    // Only measured requests count; the warm-up requests come before them.
    let begins = log.find(&format!("stamp=Some(({FIRST},")).unwrap_or(0);
    let times = |words: &str| log[begins..].matches(words).count();
    outcome.fed = times("the local original answers, too");
    outcome.unfed = times("the cloud answers alone");
    outcome.started = times("the local original is started");
    outcome.stopped = times("the local original is stopped");
    for line in log.lines() {
        let after = |key: &str| line.split(key).nth(1);
        let secs =
            after("stamp=Some((").and_then(|text| text.split(',').next()?.parse::<u32>().ok());
        let index = secs.and_then(|secs| secs.checked_sub(FIRST));
        let Some(answer) = index.and_then(|index| outcome.answers.get_mut(index as usize)) else {
            continue;
        };
        answer.local = line.contains("answer=Some((Local");
        let q = after(" q=").and_then(|text| text.split(' ').next()?.parse().ok());
        // Later log lines about a request do not change the value that Q had when it was counted.
        answer.q = answer.q.or(q);
    }
}
