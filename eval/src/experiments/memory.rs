//! Experiment 3: a package that needs more memory than a robot has.

use anyhow::Result;

use crate::cells::{Cells, Measured};
use crate::examples::{DETECTOR, Example, Where, Workshop};
use crate::place::{Class, Cost, Network, Place};
use crate::robot::Node;
use crate::section::{Missing, Section, Table};
use crate::statistics::quantile;
use crate::trace::Trace;
use crate::words::milliseconds;

/// The detector with pictures of this size in its network needs more than a gigabyte.
const LARGE: [&str; 2] = ["_width:=2048", "_height:=2048"];
/// Requests of each run.
const REQUESTS: usize = 5;

/// The detector on that robot, and its stub there.
pub struct Runs {
    /// On the robot.
    pub native: Measured<(Trace, Cost)>,
    /// In the cloud.
    pub outsourced: Measured<(Trace, Cost)>,
}

/// Measures both.
pub fn measure(cells: &Cells, workshop: &Workshop) -> Result<Runs> {
    let run = |name: &str, at: Where| {
        cells.measure(name, &(Class::PI, LARGE, REQUESTS), || {
            let detector = Example {
                parameters: &LARGE,
                ..DETECTOR
            };
            workshop.publishes(&detector)?;
            let directory = workshop.directory()?;
            let mut plan = workshop.plan(&detector, at, directory.path())?;
            if let Node::Stub { settings, .. } = &mut plan.node {
                // A robot of its own: parameters that a node has set stay with its robot's servant, as they stay with a ROS Master.
                settings.push_str("\nrobot = \"large-pictures\"");
            }
            plan.most = REQUESTS;
            plan.patience = 240.0;
            let place = Place::new(&workshop.daemon.address, Class::PI, Network::Lan)?;
            match place.runs(&plan, directory.path()) {
                // What is to be shown: not a run that failed to be measured.
                Err(error) if place.killed_for_memory() > 0 => {
                    let trace = Trace {
                        node_ended: Some(format!("{error:#}")),
                        ..Trace::default()
                    };
                    let cost = Cost {
                        killed_for_memory: place.killed_for_memory(),
                        ..Cost::default()
                    };
                    Ok((trace, cost))
                }
                run => run,
            }
        })
    };
    Ok(Runs {
        native: run("memory native", Where::Native)?,
        outsourced: run("memory outsourced", Where::Outsourced)?,
    })
}

/// What the report says.
pub fn section(runs: &Runs) -> Section {
    let mut section = Section::new(
        3,
        "memory",
        "A package that needs more memory than the robot has",
    );
    section.published = "The publication could not run SSD on the Raspberry Pi, whose memory does not hold it; outsourced it answered.".to_owned();
    section.differs = vec![
        "object_detector with pictures of 2048x2048 in its network stands in for SSD; the robot has 1 GiB. The limit is the kernel's, as on a robot without swap."
            .to_owned(),
    ];
    let mut table = Table::new(
        "object_detector on a robot of the class Pi",
        [
            "where",
            "requests answered",
            "published",
            "processes ended for want of memory",
            "median (ms)",
        ],
    );
    for (name, published, run) in [
        ("native", "SSD could not be run", &runs.native),
        ("outsourced, LAN", "SSD answered", &runs.outsourced),
    ] {
        match run {
            Measured::Done((trace, cost)) => table.push([
                name.to_owned(),
                format!("{} of {REQUESTS}", trace.answered()),
                published.to_owned(),
                cost.killed_for_memory.to_string(),
                milliseconds(quantile(&trace.responses(), 0.5)),
            ]),
            Measured::Missing(why) => section.missing.push(Missing::again(name, why)),
        }
    }
    section.tables.push(table);
    if let (Some((native, cost)), Some((outsourced, _))) =
        (runs.native.done(), runs.outsourced.done())
    {
        let killed = if cost.killed_for_memory > 0 {
            "is ended by the kernel for want of memory"
        } else if native.answered() == 0 {
            "answers nothing"
        } else {
            "answers: this limit is too high to show what was published"
        };
        section.findings.push(format!(
            "On the robot the detector {killed}; outsourced {} of {REQUESTS} requests are answered.",
            outsourced.answered()
        ));
    }
    section
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::Request;

    #[test]
    fn who_was_killed_is_told() {
        let killed = Cost {
            killed_for_memory: 1,
            ..Cost::default()
        };
        let answer = Request {
            response: Some(0.2),
            ..Request::default()
        };
        let outsourced = Trace {
            requests: vec![answer; REQUESTS],
            ..Trace::default()
        };
        let section = section(&Runs {
            native: Measured::Done((Trace::default(), killed)),
            outsourced: Measured::Done((outsourced, Cost::default())),
        });
        assert_eq!(
            section.tables[0].rows[0][1..4],
            ["0 of 5", "SSD could not be run", "1"].map(str::to_owned)
        );
        assert!(
            section.findings[0].contains("want of memory"),
            "{:?}",
            section.findings
        );
        assert!(
            section.findings[0].contains("5 of 5"),
            "{:?}",
            section.findings
        );
    }
}
