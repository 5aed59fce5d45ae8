//! Fifty robots at once before a machine for four: when each knows where it stands, and what becomes of all.

use std::collections::HashMap;
use std::sync::Barrier;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{Report, Target};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::robot::Robot;
use tokio_tungstenite::tungstenite::Message;

use crate::worker;

const ROBOTS: usize = 50;
const PLACES: usize = 4;
/// Robots wait as long as it takes, and leave room for the next as soon as they leave.
const CONFIG: &str = "[capacity]\ncpus = 4.0\nmemory = \"64G\"\nqueue = 64\ndeadline = \"30m\"\n[servant]\ngrace = \"0s\"\nwarm_pool = 0\nstart = \"5m\"\n";
/// For anything to be said.
const PATIENCE: Duration = Duration::from_secs(900);
/// A second answer would have come within this time.
const AGAIN: Duration = Duration::from_millis(200);

/// How it went for one robot.
struct Went {
    told: Duration,
    waited: bool,
    answers: usize,
}

pub(crate) fn measure(report: &mut Report) -> Result<()> {
    let place = worker::place()?;
    let daemon = worker::daemon(place.path(), CONFIG)?;
    worker::push(&daemon, "worker", &["--cpus", "1"])?;
    let floor = at_once(|_| {
        let asked = Instant::now();
        daemon.get("/healthz")?;
        Ok(asked.elapsed())
    })?;
    let went = at_once(|number| robot(&daemon, number))?;
    let told = |went: &[Went]| went.iter().map(|one| one.told).max().unwrap_or_default();
    let lost = went.iter().filter(|one| one.answers == 0).count();
    let twice = went.iter().filter(|one| one.answers > 1).count() + started_twice(&daemon)?;
    let waited = went.iter().filter(|one| one.waited).count();
    report
        .figure(
            format!("{ROBOTS} robots before {PLACES} places: the last knows where it stands"),
            "s",
            told(&went).as_secs_f64(),
        )
        .beside(
            "the last of as many HTTP answers",
            floor
                .iter()
                .max()
                .copied()
                .unwrap_or_default()
                .as_secs_f64(),
        )
        .reach(Target::AtMost(1.0))
        .note(format!(
            "{waited} were told their number in the queue, the others were served at once"
        ));
    report
        .figure("of them lost", "robots", lost as f64)
        .reach(Target::AtMost(0.0));
    report
        .figure("served twice", "robots", twice as f64)
        .reach(Target::AtMost(0.0));
    daemon.ends()?;
    Ok(())
}

/// What so many do at the same time.
fn at_once<T: Send>(each: impl Fn(usize) -> Result<T> + Sync) -> Result<Vec<T>> {
    let together = Barrier::new(ROBOTS);
    std::thread::scope(|scope| {
        let all: Vec<_> = (0..ROBOTS)
            .map(|number| {
                let (each, together) = (&each, &together);
                scope.spawn(move || {
                    together.wait();
                    each(number)
                })
            })
            .collect();
        let joined = all
            .into_iter()
            .map(|one| one.join().ok().context("a robot's thread broke")?);
        joined.collect()
    })
}

/// Asks for something as soon as it is connected, and leaves when it has its answer.
fn robot(daemon: &Daemon, number: usize) -> Result<Went> {
    let asked = Instant::now();
    let mut robot = Robot::connect(&daemon.url(&format!("worker?robot=r{number}")))?;
    robot.says(
        json!({"op": "call_service", "id": "it", "service": "/rosapi/get_time", "args": {}}),
    )?;
    let mut went = Went {
        told: Duration::MAX,
        waited: false,
        answers: 0,
    };
    loop {
        let patience = if went.answers == 0 { PATIENCE } else { AGAIN };
        let Ok(frame) = robot.frame_within(patience) else {
            break;
        };
        let Message::Text(text) = frame else {
            if frame.is_close() {
                break;
            }
            continue;
        };
        let said: Value = serde_json::from_str(text.as_str())?;
        let number = said["op"] == "status"
            && said["msg"]
                .as_str()
                .is_some_and(|words| words.contains("this robot is number"));
        let answer = said["op"] == "service_response" && said["id"] == "it";
        if number || answer {
            went.told = went.told.min(asked.elapsed());
        }
        went.waited |= number;
        went.answers += usize::from(answer);
    }
    if went.answers > 0 {
        let _ = robot.leaves();
    }
    Ok(went)
}

/// Robots for which more than one servant became ready.
fn started_twice(daemon: &Daemon) -> Result<usize> {
    let events = daemon.api("/api/v1/events?limit=10000")?;
    let mut ready: HashMap<String, usize> = HashMap::new();
    for event in events.as_array().context("a list of events")? {
        if event["kind"] == "servant-ready" {
            let robot = event["robot"].as_str().context("its robot")?;
            *ready.entry(robot.to_owned()).or_default() += 1;
        }
    }
    ensure!(!ready.is_empty(), "no servant became ready");
    Ok(ready.values().filter(|count| **count > 1).count())
}
