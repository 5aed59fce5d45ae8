//! `make bench ONLY=choreographer`: how fast the choreographer decides, queues robots and shares servants. Arguments
//! name the parts to run; all except `decide` need root. What robots gain from its decisions beside greedy neighbours
//! and with mixed agreements is experiment 9 of the evaluation (`make eval ONLY=9`).

#![forbid(unsafe_code)]

mod decide;
mod herd;
mod shared;

use bench_report::{Part, run_parts};

/// All parts, in the order in which they are measured.
const PARTS: [Part; 3] = [("decide", decide::measure), ("herd", herd::measure), ("shared", shared::measure)];

fn main() -> anyhow::Result<()> {
    run_parts("choreographer", &PARTS)
}
