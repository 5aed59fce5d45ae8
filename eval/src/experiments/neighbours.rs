//! Experiment 9: robots beside each other. What a robot's response time is beside greedy neighbours, in three policies; and how many
//! requests of robots with different agreements are in time, with the controller and without.

mod agreements;
mod isolation;

use anyhow::Result;

use crate::cells::Cells;
use crate::section::Section;

use super::crowd::Yard;

/// What was measured.
pub struct Runs {
    isolation: isolation::Runs,
    agreements: agreements::Runs,
}

/// Measures it; few points, for a short time each, where `quick`.
pub fn measure(cells: &Cells, yard: &mut Yard, quick: bool) -> Result<Runs> {
    Ok(Runs {
        isolation: isolation::measure(cells, yard, quick)?,
        agreements: agreements::measure(cells, yard, quick)?,
    })
}

/// What the report says.
pub fn section(runs: &Runs) -> Result<Section> {
    let mut section = Section::new(9, "neighbours", "Robots beside each other");
    section.published = "Robots have servants of their own in the publication, which are isolated from one another; no published figure is \
                         repeated here."
        .to_owned();
    section.differs = vec![
        "The services compute for a known time of a core at each call (eval/packages/worker_cpp), so that what is beyond it is waiting. \
         Robots are WebSocket clients on the same machine."
            .to_owned(),
        "With fewer greedy neighbours than cores nobody has to wait: on a machine of more than nine cores this experiment shows nothing."
            .to_owned(),
    ];
    isolation::tell(&runs.isolation, &mut section)?;
    agreements::tell(&runs.agreements, &mut section)?;
    Ok(section)
}

/// The next step of everything here.
const AGAIN: &str = "make eval ONLY=9 tries it again";
