//! An evaluation of nothing, for tests of what can go wrong with one: a place is made, then a robot in another one waits for a node that
//! never answers.

use std::path::Path;

use anyhow::Result;

use crate::cells::{Cells, Measured};
use crate::examples::Workshop;
use crate::place::{Class, Cost, Network, Place};
use crate::robot::{Node, Pace, Plan};
use crate::section::{Missing, Section, Table};
use crate::trace::Trace;

/// Pictures of zeros: as many as a robot needs to begin with, and one more.
const PICTURES: usize = 4;
const BYTES: usize = 640 * 480 * 3;

/// Measures both; the node is there for so many seconds.
pub fn section(cells: &Cells, workshop: &Workshop, seconds: f64) -> Result<Section> {
    let mut section = Section::new(0, "rehearsal", "Nothing");
    let place = cells.measure("rehearsal place", &(), || {
        Place::new(&workshop.daemon.address, Class::PI, Network::Lan)?;
        Ok("made".to_owned())
    })?;
    // As for packages: another node is the same run.
    let robot = cells.measure("rehearsal robot", &(), || {
        let directory = workshop.directory()?;
        let plan = plan(directory.path(), seconds)?;
        let place = Place::new(&workshop.daemon.address, Class::PI, Network::Lan)?;
        let seen: (Trace, Cost) = place.runs(&plan, directory.path())?;
        Ok(seen.0.node_ended.unwrap_or_default())
    })?;
    let mut table = Table::new("What came of it", ["what", "outcome"]);
    for (name, measured) in [("place", place), ("robot", robot)] {
        match measured {
            Measured::Done(outcome) => table.push([name.to_owned(), outcome]),
            Measured::Missing(why) => {
                section.missing.push(Missing::new(
                    name,
                    why,
                    "run it again: what was measured stays",
                ));
            }
        }
    }
    section.tables.push(table);
    Ok(section)
}

/// What a robot does that asks `sleep`.
pub fn plan(directory: &Path, seconds: f64) -> Result<Plan> {
    let recording = directory.join("zeros.raw");
    std::fs::write(&recording, vec![0; PICTURES * BYTES])?;
    Ok(Plan {
        server: String::new(),
        node: Node::Native {
            script: "exec \"$@\"".to_owned(),
            program: "sleep".to_owned(),
            argv: vec![seconds.to_string()],
        },
        recording,
        request: "/image".to_owned(),
        left_out: Vec::new(),
        besides: Vec::new(),
        answer: "/answer".to_owned(),
        tells_pose: false,
        timing: None,
        map: None,
        pace: Pace::OneByOne,
        every: 1,
        most: 1,
        give_up: 1.0,
        patience: 300.0,
        changes: Vec::new(),
    })
}
