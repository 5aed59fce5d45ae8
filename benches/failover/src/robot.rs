//! The robot's side of one run: a Master, a camera, the stub or the original.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use nix::sys::signal::Signal;
use ros::bus::{Publisher, Subscription};
use support::cable::Cable;
use support::daemon::Daemon;
use support::people::{self, Camera, picture};
use support::site::{Running, Site};
use tokio::time::{Instant as At, sleep_until, timeout};

use crate::{BAD, BADNESS, REQUESTS};

/// Anything that is waited for and not measured.
const PATIENCE: Duration = Duration::from_secs(120);
/// For answers that are still under way after the last request.
const STRAGGLERS: Duration = Duration::from_secs(10);
const SIZE: (u32, u32) = (640, 480);
/// Stamps of measured requests begin after this one.
const FIRST: u32 = 1000;

/// The inputs that are sent, and when.
pub struct Plan<'a> {
    /// Requests per second.
    pub rate: f64,
    /// T_desire and T_max, seconds.
    pub times: (f64, f64),
    /// `cold`, `warm`, `none`, or `alone`: the original without a stub.
    pub local: &'a str,
    /// Raw bgr8 pictures.
    pub pictures: &'a Path,
}

/// How one request went.
#[derive(Clone, Copy, Default)]
pub struct Answer {
    /// Seconds to the first answer.
    pub after: Option<f64>,
    /// Answers.
    pub count: usize,
    /// The local original's was the first.
    pub local: bool,
    /// Q once it was counted.
    pub q: Option<f64>,
}

/// How all went.
pub struct Outcome {
    /// By request.
    pub answers: Vec<Answer>,
    /// T_desire and T_max, seconds.
    pub times: (f64, f64),
    /// How often the local original was asked as well,
    pub fed: usize,
    /// not asked any more,
    pub unfed: usize,
    /// its process started,
    pub started: usize,
    /// and stopped.
    pub stopped: usize,
}

impl Outcome {
    /// Requests answered within T_max.
    pub fn within(&self) -> usize {
        self.answers
            .iter()
            .filter(|answer| !self.is_late(answer))
            .count()
    }

    /// Answered after T_max, or never.
    pub fn is_late(&self, answer: &Answer) -> bool {
        answer.after.is_none_or(|after| after > self.times.1)
    }

    /// Late requests from each onset to the next.
    pub fn late(&self) -> Vec<usize> {
        let ends = BAD.iter().skip(1).map(|(first, _)| first - 1);
        let ends = ends.chain([REQUESTS]);
        let late = |((first, _), end): (&(usize, usize), usize)| {
            let during = self.answers[first - 1..end].iter();
            during.filter(|answer| self.is_late(answer)).count()
        };
        BAD.iter().zip(ends).map(late).collect()
    }

    /// Of those that were answered, seconds.
    pub fn median(&self) -> f64 {
        let times = self.answers.iter().filter_map(|answer| answer.after);
        bench_report::quantile(&times.collect::<Vec<f64>>(), 0.5).unwrap_or(f64::NAN)
    }
}

/// Runs it.
pub fn run(daemon: &Daemon, cable: &Cable, plan: &Plan) -> Result<Outcome> {
    let site = Site::new()?;
    let mut node = start(&site, daemon, cable, plan)?;
    let outcome = ask(&site, cable, plan);
    let mut outcome = outcome.with_context(|| format!("the node said:\n{}", node.said()))?;
    // As roslaunch would: the stub ends its servant's node.
    node.signal(Signal::SIGINT)?;
    node.ends()?;
    if std::env::var_os("CLOUDROID_BENCH_LOG").is_some() {
        eprintln!("{}", node.said());
    }
    read(&node.said(), &mut outcome);
    if plan.local == "alone" {
        outcome
            .answers
            .iter_mut()
            .for_each(|answer| answer.local = true);
    }
    Ok(outcome)
}

fn start(site: &Site, daemon: &Daemon, cable: &Cable, plan: &Plan) -> Result<Running> {
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

fn ask(site: &Site, cable: &Cable, plan: &Plan) -> Result<Outcome> {
    let mut camera = Camera::new(site, 1)?;
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
    plan: &Plan<'_>,
    pictures: &[&[u8]],
) -> Result<Outcome> {
    let mut answers = vec![Answer::default(); REQUESTS];
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
    Ok(Outcome {
        answers,
        times: plan.times,
        fed: 0,
        unfed: 0,
        started: 0,
        stopped: 0,
    })
}

/// Asks until ten answers in a row have come within `max` seconds: by then all are awake.
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
    // What is answered late must not be taken for an answer later.
    tokio::time::sleep(Duration::from_secs(1)).await;
    while found.messages.try_recv().is_some() {}
    Ok(())
}

/// Notes answers until `until`.
async fn collect(found: &mut Subscription, answers: &mut [Answer], sent: &[Instant], until: At) {
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

/// What the stub's log tells of each request, and of the local original.
fn read(log: &str, outcome: &mut Outcome) {
    // Of the measured requests only: the robot has had others before.
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
        // What is told later of a request does not change what Q was when it counted.
        answer.q = answer.q.or(q);
    }
}
