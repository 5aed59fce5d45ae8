//! `make bench ONLY=choreographer`: what the choreographer decides, how fast, and what robots gain from it. Each group
//! of figures has a file of its own; `CLOUDROID_BENCH_RUN=herd` runs only the groups whose name contains that word. All
//! groups except `decide` need root.

#![forbid(unsafe_code)]

mod decide;
mod herd;
mod in_time;
mod neighbours;
mod shared;
mod worker;

use anyhow::{Context, Result};
use bench_report::BenchReport;

/// A group of figures: its name and the function that measures it.
type Group = (&'static str, fn(&mut BenchReport) -> Result<()>);

/// All groups, in the order in which they are measured.
const GROUPS: [Group; 5] = [
    ("decide", decide::measure),
    ("herd", herd::measure),
    ("neighbours", neighbours::measure),
    ("in_time", in_time::measure),
    ("shared", shared::measure),
];

fn main() -> Result<()> {
    let only = std::env::var("CLOUDROID_BENCH_RUN").unwrap_or_default();
    let mut report = BenchReport::new("choreographer");
    for (name, measure) in GROUPS {
        if name.contains(&only) {
            eprintln!("{name}");
            measure(&mut report).with_context(|| name.to_owned())?;
        }
    }
    report.finish()?;
    Ok(())
}
