//! Fifty robots connect at once to a machine with room for four: when each knows its place, and whether all are served.

use std::collections::HashMap;
use std::sync::Barrier;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{BenchDaemon, BenchReport, Target};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::robot::Robot;
use support::{binaries, deployer};
use tokio_tungstenite::tungstenite::Message;

const ROBOTS: usize = 50;
const PLACES: usize = 4;
/// Robots wait without a limit, and a robot that leaves makes room for the next one immediately.
const CONFIG: &str = "[capacity]\ncpus = 4.0\nmemory = \"64G\"\nqueue = 64\ndeadline = \"30m\"\n[servant]\ngrace \
    = \"0s\"\nwarm_pool = 0\nstart = \"5m\"\n";
/// Maximum time to wait for any message.
const PATIENCE: Duration = Duration::from_secs(900);
/// Time within which a second answer would have arrived.
const AGAIN: Duration = Duration::from_millis(200);

/// Measurements of one robot.
struct QueueSample {
    told: Duration,
    waited: bool,
    answers: usize,
}

pub(crate) fn measure(report: &mut BenchReport) -> Result<()> {
    let daemon = BenchDaemon::start(CONFIG)?;
    let worker = ["--name", "worker", "--node", "adder.py", "--cpus", "1"];
    daemon.push(&[&[deployer::path_str(&binaries::package("adder_py"))], &worker[..]].concat())?;
    let floor = run_concurrently(|_| {
        let asked = Instant::now();
        daemon.get("/healthz")?;
        Ok(asked.elapsed())
    })?;
    let went = run_concurrently(|number| run_robot(&daemon, number))?;
    let told = |went: &[QueueSample]| went.iter().map(|one| one.told).max().unwrap_or_default();
    let lost = went.iter().filter(|one| one.answers == 0).count();
    let twice = went.iter().filter(|one| one.answers > 1).count() + count_duplicate_starts(&daemon)?;
    let waited = went.iter().filter(|one| one.waited).count();
    let title = format!("{ROBOTS} robots before {PLACES} places: the last knows where it stands");
    let answered = floor.iter().max().copied().unwrap_or_default().as_secs_f64();
    let figure = report.figure(title, "s", told(&went).as_secs_f64()).require(Target::AtMost(1.0));
    figure.relative_to("the last of as many HTTP answers", answered);
    figure.note(format!("{waited} were told their number in the queue, the others were served at once"));
    report.figure("of them lost", "robots", lost as f64).require(Target::AtMost(0.0));
    report.figure("served twice", "robots", twice as f64).require(Target::AtMost(0.0));
    Ok(())
}

/// Runs `each` in one thread per robot; all threads start at the same moment.
fn run_concurrently<T: Send>(each: impl Fn(usize) -> Result<T> + Sync) -> Result<Vec<T>> {
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
        let joined = all.into_iter().map(|one| one.join().ok().context("a robot's thread broke")?);
        joined.collect()
    })
}

/// Connects, calls a service immediately and leaves once the answer has arrived.
fn run_robot(daemon: &Daemon, number: usize) -> Result<QueueSample> {
    let asked = Instant::now();
    let mut robot = Robot::connect(&daemon.url(&format!("worker?robot=r{number}")))?;
    robot.send(json!({"op": "call_service", "id": "it", "service": "/rosapi/get_time", "args": {}}))?;
    let mut went = QueueSample { told: Duration::MAX, waited: false, answers: 0 };
    loop {
        let patience = if went.answers == 0 { PATIENCE } else { AGAIN };
        let Ok(frame) = robot.next_frame_within(patience) else { break };
        let said: Value = match frame {
            Message::Text(text) => serde_json::from_str(text.as_str())?,
            Message::Close(_) => break,
            _ => continue,
        };
        let number =
            said["op"] == "status" && said["msg"].as_str().is_some_and(|words| words.contains("this robot is number"));
        let answer = said["op"] == "service_response" && said["id"] == "it";
        if number || answer {
            went.told = went.told.min(asked.elapsed());
        }
        went.waited |= number;
        went.answers += usize::from(answer);
    }
    if went.answers > 0 {
        let _ = robot.leave();
    }
    Ok(went)
}

/// Counts the robots for which more than one servant became ready.
fn count_duplicate_starts(daemon: &Daemon) -> Result<usize> {
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
