//! Experiment 9: robots on the same machine. Response time of a robot next to greedy neighbours under three policies;
//! and the number of requests in time of robots with different agreements, with and without the controller.

mod agreements;
mod isolation;

use anyhow::Result;

use super::crowd::CrowdDaemon;
use crate::cells::RunCache;
use crate::section::{About, Section};

/// The experiment.
pub const ABOUT: About = About {
    number: 9,
    id: "neighbours",
    title: "Robots beside each other",
    published: "Robots have servants of their own in the publication, which are isolated from one another; no \
        published figure is repeated here.",
    differs: &[
        "The services compute for a known time of a core at each call (eval/packages/worker_cpp), so that what is \
         beyond it is waiting. Robots are WebSocket clients on the same machine.",
        "With fewer greedy neighbours than cores nobody has to wait: on more than nine cores this shows nothing.",
    ],
};

/// Results of both parts.
pub struct NeighbourRuns {
    isolation: isolation::IsolationRuns,
    agreements: agreements::AgreementRuns,
}

/// Measures both parts; with `quick`, few points for a short time each.
pub fn measure(cells: &RunCache, yard: &mut CrowdDaemon, quick: bool) -> Result<NeighbourRuns> {
    let isolation = isolation::measure(cells, yard, quick)?;
    Ok(NeighbourRuns { isolation, agreements: agreements::measure(cells, yard, quick)? })
}

pub fn section(runs: &NeighbourRuns) -> Section {
    let mut section = ABOUT.section();
    isolation::add_to_section(&runs.isolation, &mut section);
    agreements::add_to_section(&runs.agreements, &mut section);
    section
}
