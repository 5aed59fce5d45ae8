//! Experiment 3: a package that needs more memory than the robot has.

use anyhow::Result;

use crate::cells::{CachedResult, RunCache};
use crate::examples::{DETECTOR, EvalFixtures, EvalPackage, ExecutionSite};
use crate::place::{NetworkProfile, RobotHardware, RobotSandbox, RunCost};
use crate::robot::NodeUnderTest;
use crate::section::{AGAIN, Section, Table};
use crate::statistics::quantile;
use crate::trace::Trace;
use crate::words::milliseconds;

/// With images of this size in its network the detector needs more than a gigabyte.
const LARGE: [&str; 2] = ["_width:=2048", "_height:=2048"];
/// Requests per run.
const REQUESTS: usize = 5;

/// Results of the detector on the robot, and of its stub there.
pub struct MemoryRuns {
    /// Run on the robot.
    pub native: CachedResult<(Trace, RunCost)>,
    /// Run in the cloud.
    pub outsourced: CachedResult<(Trace, RunCost)>,
}

/// Measures both runs.
pub fn measure(cells: &RunCache, workshop: &EvalFixtures) -> Result<MemoryRuns> {
    let run = |name: &str, at: ExecutionSite| {
        cells.measure(name, &(RobotHardware::PI, LARGE, REQUESTS), || {
            let detector = EvalPackage { parameters: &LARGE, ..DETECTOR };
            workshop.publish(&detector)?;
            let directory = workshop.directory()?;
            let mut plan = workshop.plan(&detector, at, directory.path())?;
            if let NodeUnderTest::Stub { settings, .. } = &mut plan.node {
                // A robot of its own: parameters that a node sets stay with the robot's servant, as they stay with a
                // ROS Master.
                settings.push_str("\nrobot = \"large-pictures\"");
            }
            plan.most = REQUESTS;
            plan.patience = 240.0;
            let place = RobotSandbox::new(&workshop.daemon.address, RobotHardware::PI, NetworkProfile::Lan)?;
            match place.run(&plan, directory.path()) {
                // The expected result, not a failed measurement.
                Err(error) if place.killed_for_memory() > 0 => {
                    let trace = Trace { node_ended: Some(format!("{error:#}")), ..Trace::default() };
                    let cost = RunCost { killed_for_memory: place.killed_for_memory(), ..RunCost::default() };
                    Ok((trace, cost))
                }
                run => run,
            }
        })
    };
    Ok(MemoryRuns {
        native: run("memory native", ExecutionSite::Native)?,
        outsourced: run("memory outsourced", ExecutionSite::Outsourced)?,
    })
}

/// Creates the section of the report.
pub fn section(runs: &MemoryRuns) -> Section {
    let mut section = Section::new(3, "memory", "A package that needs more memory than the robot has");
    section.published = "The publication could not run SSD on the Raspberry Pi, whose memory does not hold it; \
        outsourced it answered."
        .to_owned();
    section.differs = vec![
        "object_detector with pictures of 2048x2048 in its network stands in for SSD; the robot has 1 GiB. The limit \
         is the kernel's, as on a robot without swap."
            .to_owned(),
    ];
    let mut table = Table::new(
        "object_detector on a robot of the class Pi",
        "where | requests answered | published | processes ended for want of memory | median (ms)",
    );
    for (name, published, run) in
        [("native", "SSD could not be run", &runs.native), ("outsourced, LAN", "SSD answered", &runs.outsourced)]
    {
        if let Some((trace, cost)) = run.require(&mut section, name, AGAIN) {
            table.push([
                name.to_owned(),
                format!("{} of {REQUESTS}", trace.answered_count()),
                published.to_owned(),
                cost.killed_for_memory.to_string(),
                milliseconds(quantile(&trace.responses(), 0.5)),
            ]);
        }
    }
    section.tables.push(table);
    if let (Some((native, cost)), Some((outsourced, _))) = (runs.native.value(), runs.outsourced.value()) {
        let killed = if cost.killed_for_memory > 0 {
            "is ended by the kernel for want of memory"
        } else if native.answered_count() == 0 {
            "answers nothing"
        } else {
            "answers: this limit is too high to show what was published"
        };
        section.findings.push(format!(
            "On the robot the detector {killed}; outsourced {} of {REQUESTS} requests are answered.",
            outsourced.answered_count()
        ));
    }
    section
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::RequestSample;
    use crate::words::assert_tells;

    #[test]
    fn who_was_killed_is_told() {
        let killed = RunCost { killed_for_memory: 1, ..RunCost::default() };
        let answer = RequestSample { response: Some(0.2), ..RequestSample::default() };
        let outsourced = Trace { requests: vec![answer; REQUESTS], ..Trace::default() };
        let section = section(&MemoryRuns {
            native: CachedResult::Done((Trace::default(), killed)),
            outsourced: CachedResult::Done((outsourced, RunCost::default())),
        });
        assert_eq!(section.tables[0].rows[0][1..4], ["0 of 5", "SSD could not be run", "1"].map(str::to_owned));
        assert_tells(&section.findings[0], "want of memory");
        assert_tells(&section.findings[0], "5 of 5");
    }
}
