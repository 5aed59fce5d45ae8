//! `make bench ONLY=ros2`: a participant of the crate `rtps` compared with rclpy's, and a robot of the portal compared
//! with the direct path and with other rosbridge servers: round trips of Strings, calls and goals, images in both
//! directions, joining a running node, and idle resources. Needs root, and the Python with rclpy below
//! `CLOUDROID_ROS2_PREFIX`. `CLOUDROID_BENCH_FULL=1` measures longer, `CLOUDROID_BENCH_SECONDS` sets how many seconds
//! images are sent; arguments name the parts to run. The program runs itself as the participants (`inside ROLE …`), so
//! that each is a separate process.

#![forbid(unsafe_code)]

mod awake;
mod bus;
mod camera;
mod client;
mod cost;
mod crowd;
mod ends;
mod hop;
mod joins;
mod lost;
mod message;
mod pictures;
mod place;
mod portal;
mod process;
mod rivals;
mod roles;
mod trips;
mod types;
mod world;

use anyhow::{Result, ensure};
use bench_report::BenchReport;

/// Returns whether longer measurements are requested (`CLOUDROID_BENCH_FULL=1`).
fn is_full_run() -> bool {
    std::env::var_os("CLOUDROID_BENCH_FULL").is_some_and(|value| value == "1")
}

type Part = fn(&mut BenchReport) -> Result<()>;

/// Parts of the benchmark, in the order in which they run.
const PARTS: [(&str, Part); 6] = [
    ("trips", trips::measure_strings),
    ("calls", trips::measure_calls),
    ("goals", trips::measure_goals),
    ("joins", joins::measure),
    ("cost", cost::measure),
    ("pictures", pictures::measure),
];

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    if let ["inside", role @ ..] = words.as_slice() {
        return roles::run(role);
    }
    let unknown = words
        .iter()
        .find(|word| PARTS.iter().all(|(name, _)| name != *word));
    ensure!(
        unknown.is_none(),
        "no part is called {unknown:?}: there are trips, calls, goals, joins, cost, pictures"
    );
    // Fails early rather than after an hour.
    world::python_path()?;
    let mut report = BenchReport::new("ros2");
    let mut failed = Vec::new();
    for (name, part) in PARTS {
        if !words.is_empty() && !words.contains(&name) {
            continue;
        }
        // Earlier figures are reported all the same.
        if let Err(why) = part(&mut report) {
            report.skip(format!("what {name} has not come to"), format!("{why:#}"));
            failed.push(name);
        }
    }
    report.finish()?;
    ensure!(failed.is_empty(), "not measured to the end: {failed:?}");
    Ok(())
}
