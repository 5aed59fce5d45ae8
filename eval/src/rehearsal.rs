//! An evaluation without experiments, for tests of its failure handling: creates a sandbox, then a robot in another one
//! that waits for a node which never answers.

use std::path::Path;

use anyhow::Result;
use support::people::picture;

use crate::cells::RunCache;
use crate::examples::EvalFixtures;
use crate::pictures::write_pictures;
use crate::place::{NetworkProfile, RobotHardware, RobotSandbox, RunCost};
use crate::robot::{NodeUnderTest, RobotPlan};
use crate::section::{Section, Table};
use crate::trace::Trace;

/// Images of zeros: one more than the warm-up of a robot needs.
const PICTURES: usize = 4;

/// Measures both; the node runs for `seconds`.
pub fn section(cells: &RunCache, workshop: &EvalFixtures, seconds: f64) -> Result<Section> {
    let mut section = Section::new(0, "rehearsal", "Nothing");
    let place = cells.measure("rehearsal place", &(), || {
        RobotSandbox::new(&workshop.daemon.address, RobotHardware::PI, NetworkProfile::Lan)?;
        Ok("made".to_owned())
    })?;
    // As for packages, another duration of the node does not make it another run.
    let robot = cells.measure("rehearsal robot", &(), || {
        let directory = workshop.directory()?;
        let plan = plan(directory.path(), seconds)?;
        let place = RobotSandbox::new(&workshop.daemon.address, RobotHardware::PI, NetworkProfile::Lan)?;
        let seen: (Trace, RunCost) = place.run(&plan, directory.path())?;
        Ok(seen.0.node_ended.unwrap_or_default())
    })?;
    let mut table = Table::new("What came of it", "what | outcome");
    for (name, measured) in [("place", place), ("robot", robot)] {
        if let Some(outcome) = measured.require(&mut section, name) {
            table.push([name, outcome.as_str()]);
        }
    }
    section.tables.push(table);
    Ok(section)
}

/// Returns the plan of a robot whose node is `sleep`.
pub fn plan(directory: &Path, seconds: f64) -> Result<RobotPlan> {
    let recording = directory.join("zeros.messages");
    write_pictures(&recording, &vec![picture(1, (8, 8), &[0; 8 * 8 * 3]); PICTURES], 1)?;
    let node = NodeUnderTest::Native {
        script: "exec \"$@\"".to_owned(),
        program: "sleep".to_owned(),
        argv: vec![seconds.to_string()],
    };
    Ok(RobotPlan { give_up: 1.0, patience: 300.0, ..RobotPlan::new(node, recording, "/image", "/answer") })
}
