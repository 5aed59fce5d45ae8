//! `make bench ONLY=ros2`: a participant of crate `rtps` beside rclpy's, and a robot of the portal beside the direct way and beside other
//! servers of rosbridge: Strings, calls and goals there and back, pictures in both directions, joining a node that runs, and what it takes to be
//! there. Needs root, and the Python with rclpy below `CLOUDROID_ROS2_PREFIX`. `CLOUDROID_BENCH_FULL=1` measures longer,
//! `CLOUDROID_BENCH_SECONDS` says how long pictures are watched; names of parts as arguments run those alone. The program calls itself for the participants
//! (`inside ROLE …`), so that each is a process of its own.

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
use bench_report::Report;

/// Longer measurements are wanted.
fn full() -> bool {
    std::env::var_os("CLOUDROID_BENCH_FULL").is_some_and(|value| value == "1")
}

type Part = fn(&mut Report) -> Result<()>;

/// What is measured, in this order.
const PARTS: [(&str, Part); 6] = [
    ("trips", trips::strings),
    ("calls", trips::calls),
    ("goals", trips::goals),
    ("joins", joins::measure),
    ("cost", cost::measure),
    ("pictures", pictures::measure),
];

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    if let ["inside", role @ ..] = words.as_slice() {
        return roles::play(role);
    }
    let unknown = words
        .iter()
        .find(|word| PARTS.iter().all(|(name, _)| name != *word));
    ensure!(
        unknown.is_none(),
        "no part is called {unknown:?}: there are trips, calls, goals, joins, cost, pictures"
    );
    // Before an hour has gone.
    world::python()?;
    let mut report = Report::new("ros2");
    let mut failed = Vec::new();
    for (name, part) in PARTS {
        if !words.is_empty() && !words.contains(&name) {
            continue;
        }
        // What was measured before is told all the same.
        if let Err(why) = part(&mut report) {
            report.left_out(format!("what {name} has not come to"), format!("{why:#}"));
            failed.push(name);
        }
    }
    report.finish()?;
    ensure!(failed.is_empty(), "not measured to the end: {failed:?}");
    Ok(())
}
