//! `make bench ONLY=ros2`: a participant of crate `rtps` beside rclpy's: Strings and calls there and back, pictures in both directions, joining a
//! node that runs, and what it takes to be there. Needs root, and the Python with rclpy below `CLOUDROID_ROS2_PREFIX`.
//! `CLOUDROID_BENCH_FULL=1` measures longer; names of parts as arguments run those alone. The program calls itself for the participants
//! (`inside ROLE …`), so that each is a process of its own.

#![forbid(unsafe_code)]

mod bus;
mod camera;
mod cost;
mod crowd;
mod ends;
mod joins;
mod message;
mod pictures;
mod place;
mod process;
mod roles;
mod trips;
mod world;

use anyhow::{Result, ensure};
use bench_report::Report;

/// Longer measurements are wanted.
fn full() -> bool {
    std::env::var_os("CLOUDROID_BENCH_FULL").is_some_and(|value| value == "1")
}

type Part = fn(&mut Report) -> Result<()>;

/// What is measured, in this order.
const PARTS: [(&str, Part); 4] = [
    ("trips", trips::measure),
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
        "no part is called {unknown:?}: there are trips, joins, cost, pictures"
    );
    // Before an hour has gone.
    world::python()?;
    let mut report = Report::new("ros2");
    for (name, part) in PARTS {
        if words.is_empty() || words.contains(&name) {
            part(&mut report)?;
        }
    }
    // They begin with a push of a package.
    for what in [
        "String through the portal",
        "actions",
        "a servant's cost beyond its nodes",
    ] {
        report.left_out(what, "no package of ROS 2 can be pushed yet");
    }
    report.finish()?;
    Ok(())
}
