//! Experiment 9: robots on the same machine. Response time of a robot next to greedy neighbours under three policies;
//! and the number of requests in time of robots with different agreements, with and without the controller.

mod agreements;
mod isolation;

use anyhow::Result;

use crate::cells::RunCache;
use crate::section::Section;

use super::crowd::CrowdDaemon;

/// Results of both parts.
pub struct NeighbourRuns {
    isolation: isolation::IsolationRuns,
    agreements: agreements::AgreementRuns,
}

/// Measures both parts; with `quick`, few points for a short time each.
pub fn measure(cells: &RunCache, yard: &mut CrowdDaemon, quick: bool) -> Result<NeighbourRuns> {
    Ok(NeighbourRuns {
        isolation: isolation::measure(cells, yard, quick)?,
        agreements: agreements::measure(cells, yard, quick)?,
    })
}

/// Creates the section of the report.
pub fn section(runs: &NeighbourRuns) -> Result<Section> {
    let mut section = Section::new(9, "neighbours", "Robots beside each other");
    section.published =
        "Robots have servants of their own in the publication, which are isolated from one another; no \
        published figure is \
                         repeated here."
            .to_owned();
    section.differs = vec![
        "The services compute for a known time of a core at each call (eval/packages/worker_cpp), so that what is \
         beyond it is waiting. \
         Robots are WebSocket clients on the same machine."
            .to_owned(),
        "With fewer greedy neighbours than cores nobody has to wait: on a machine of more than nine cores this \
         experiment shows nothing."
            .to_owned(),
    ];
    isolation::add_to_section(&runs.isolation, &mut section)?;
    agreements::add_to_section(&runs.agreements, &mut section)?;
    Ok(section)
}

/// Next step for missing measurements.
const AGAIN: &str = "make eval ONLY=9 tries it again";
