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
mod measuring;
mod message;
mod pictures;
mod place;
mod portal;
mod rivals;
mod roles;
mod trips;
mod types;
mod world;

use anyhow::Result;
use bench_report::{Part, run_parts};

/// Parts of the benchmark, in the order in which they run.
const PARTS: [Part; 6] = [
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
    // Fails early rather than after an hour.
    world::python_path()?;
    run_parts("ros2", &PARTS)
}
