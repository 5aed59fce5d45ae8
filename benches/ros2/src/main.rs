//! `make bench ONLY=ros2`: a node of ours compared with rclpy's, and a robot of the portal with the direct path and
//! other rosbridge servers. Needs root, and rclpy below `CLOUDROID_ROS2_PREFIX`. `CLOUDROID_BENCH_FULL=1` measures
//! longer, `CLOUDROID_BENCH_SECONDS` is how long images are sent; arguments name the parts to run. The program runs
//! itself as the participants (`inside ROLE …`).

#![forbid(unsafe_code)]

mod bus;
mod client;
mod cost;
mod crowd;
mod echoes;
mod exchanges;
mod in_flight;
mod joins;
mod messages;
mod pictures;
mod portal;
mod rivals;
mod roles;
mod trips;
mod turns;
mod world;

use anyhow::Result;
use bench_report::{Part, run_parts};

/// Parts of the benchmark, in the order in which they run.
const PARTS: [Part; 7] = [
    ("trips", trips::measure_strings),
    ("calls", trips::measure_calls),
    ("goals", trips::measure_goals),
    ("rival", in_flight::measure),
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
