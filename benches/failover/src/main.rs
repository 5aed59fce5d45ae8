//! `make bench ONLY=failover`: people_detect is asked 130 times while the robot's network is bad during requests
//! 24-45, 75-96 and 111-122; through the stub, and beside it by the cloud alone and by the original alone. Needs root.
//!
//! The robot's side is this machine's network, the server's a namespace behind a cable that can be degraded (see
//! `support::cable`). Daemon, servant, stub and originals are the real ones.

#![forbid(unsafe_code)]

mod plot;
mod robot;

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, ensure};
use bench_report::{Report, Target};
use robot::{Outcome, Plan};
use support::cable::{Badness, Cable};
use support::daemon::Setup;
use support::world::PEOPLE;

/// Requests during which the network is bad, both ends included.
pub const BAD: [(usize, usize); 3] = [(24, 45), (75, 96), (111, 122)];
/// Requests of one run.
pub const REQUESTS: usize = 130;
/// Pictures that are asked about in turn.
const PICTURES: usize = 30;
/// A picture takes 3.7 s at this rate.
const BADNESS: Badness = Badness {
    rate: 2000,
    delay: 100,
    jitter: 0,
    loss: 0.01,
    limit: 100,
};

fn main() -> Result<()> {
    let _first = First::new();
    let place = tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?;
    let daemon = Setup::new(&place.path().join("home")).start()?;
    eprintln!("pushing people_detect: base and dependencies are made now, if they are not cached");
    // What else runs on this machine is not what is measured.
    let push = [&["push", "--cpu-weight", "10000"], PEOPLE.arguments].concat();
    daemon.deployer().types(&push)?.succeeded()?;
    let pictures = pictures(place.path())?;
    let cable = Cable::new(&daemon.address)?;
    eprintln!("the network is degraded by {}: {BADNESS:?}", cable.means());
    let mut report = Report::new("failover");
    let mut runs = Vec::new();
    for (name, rate, times, local) in [
        ("5 Hz, warm local original", 5.0, (0.25, 0.5), "warm"),
        ("2 Hz, cold local original", 2.0, (0.4, 0.8), "cold"),
        ("5 Hz, cloud alone", 5.0, (0.25, 0.5), "none"),
        ("5 Hz, original alone", 5.0, (0.25, 0.5), "alone"),
    ] {
        let only = std::env::var("CLOUDROID_BENCH_RUN").unwrap_or_default();
        if !name.contains(&only) {
            continue;
        }
        eprintln!("{name}");
        let plan = Plan {
            rate,
            times,
            local,
            pictures: &pictures,
        };
        let outcome = robot::run(&daemon, &cable, &plan).with_context(|| name.to_owned())?;
        daemon.deployer().types(&["stop", "--all"])?.succeeded()?;
        figures(&mut report, name, local, &outcome);
        runs.push((name.to_owned(), outcome));
    }
    report.finish()?;
    let path = bench_report::root().join("target/bench/failover.svg");
    std::fs::write(&path, plot::draw(&runs))?;
    println!("the plot is {}", path.display());
    daemon.ends()?;
    Ok(())
}

/// This run's processes come before the machine's other ones. Where the scheduler groups processes by session
/// (sched(7), autogroup), only the group's nice value counts between sessions; it is put back at the end.
struct First;

impl First {
    fn new() -> Self {
        let own = std::process::id().to_string();
        let _ = Command::new("renice")
            .args(["-n", "-15", "-p", &own])
            .output();
        let _ = std::fs::write("/proc/self/autogroup", "-15");
        Self
    }
}

impl Drop for First {
    fn drop(&mut self) {
        let _ = std::fs::write("/proc/self/autogroup", "0");
    }
}

fn figures(report: &mut Report, name: &str, local: &str, outcome: &Outcome) {
    let (within, late) = match local {
        "warm" => (Some(95.0), Some(2.0)),
        "cold" => (Some(93.0), Some(3.0)),
        _ => (None, None),
    };
    let share = 100.0 * outcome.within() as f64 / REQUESTS as f64;
    let figure = report.figure(format!("{name}: answered within T_max"), "%", share);
    within.map(|within| figure.reach(Target::AtLeast(within)));
    for (index, count) in outcome.late().into_iter().enumerate() {
        let name = format!("{name}: late from onset {} on", index + 1);
        let figure = report.figure(name, "requests", count as f64);
        late.map(|late| figure.reach(Target::AtMost(late)));
    }
    let times = |count: usize| {
        outcome
            .answers
            .iter()
            .filter(move |answer| answer.count == count)
    };
    let once = times(1).count() as f64;
    let figure = report.figure(format!("{name}: answered exactly once"), "of 130", once);
    within.map(|_| figure.reach(Target::AtLeast(REQUESTS as f64)));
    let never = times(0).count() as f64;
    report.figure(format!("{name}: never answered"), "of 130", never);
    let median = outcome.median() * 1e3;
    report.figure(format!("{name}: response time, median"), "ms", median);
    if within.is_none() {
        return;
    }
    for (what, count) in [
        ("asked", outcome.fed),
        ("not asked any more", outcome.unfed),
        ("process started", outcome.started),
        ("process stopped", outcome.stopped),
    ] {
        let figure = report.figure(format!("{name}: {what}"), "times", count as f64);
        let process = what.starts_with("process");
        if !process || local == "cold" {
            figure.reach(Target::AtLeast(3.0));
        }
    }
}

/// Pedestrians, 640x480, bgr8, one after the other.
fn pictures(place: &Path) -> Result<PathBuf> {
    let path = place.join("pictures.raw");
    let status = Command::new("ffmpeg")
        .args(["-v", "error", "-i"])
        .arg("/usr/share/doc/opencv-doc/examples/data/vtest.avi")
        .args(["-vf", "scale=640:480", "-frames:v", &PICTURES.to_string()])
        .args(["-pix_fmt", "bgr24", "-f", "rawvideo"])
        .arg(&path)
        .status()?;
    ensure!(status.success(), "ffmpeg ended with {status}");
    Ok(path)
}
