//! `make bench ONLY=choreographer`: what the choreographer decides, how fast, and what robots have of it. Each group of rows
//! is a file; `CLOUDROID_BENCH_RUN=herd` measures the groups whose name contains that alone. All but `decide` need root.

#![forbid(unsafe_code)]

mod decide;
mod herd;
mod in_time;
mod neighbours;
mod shared;
mod worker;

use anyhow::{Context, Result};
use bench_report::Report;

/// A group of rows.
type Group = (&'static str, fn(&mut Report) -> Result<()>);

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
    let mut report = Report::new("choreographer");
    for (name, measure) in GROUPS {
        if name.contains(&only) {
            eprintln!("{name}");
            measure(&mut report).with_context(|| name.to_owned())?;
        }
    }
    report.finish()?;
    Ok(())
}
