//! Experiment 3: a package that needs more memory than the robot has.

use anyhow::Result;

use crate::cells::{RunCache, Runs};
use crate::examples::{DETECTOR, EvalFixtures, EvalPackage, ExecutionSite};
use crate::place::{NetworkProfile, RobotHardware, RobotSandbox, RunCost};
use crate::robot::NodeUnderTest;
use crate::section::{About, Section, Table};
use crate::trace::Trace;
use crate::words::{count, milliseconds};

/// With images of this size in its network the detector needs more than a gigabyte.
const LARGE: [&str; 2] = ["_width:=2048", "_height:=2048"];
/// Requests per run.
const REQUESTS: usize = 5;

/// The experiment.
pub const ABOUT: About = About {
    number: 3,
    id: "memory",
    title: "A package that needs more memory than the robot has",
    published: "The publication could not run SSD on the Raspberry Pi, whose memory does not hold it; outsourced it \
        answered.",
    differs: &[
        "object_detector with pictures of 2048x2048 in its network stands in for SSD; the robot has 1 GiB. The \
        limit is the kernel's, as on a robot without swap.",
    ],
};

/// Results of the detector on the robot, and of its stub there.
pub struct MemoryRuns([Runs<(Trace, RunCost)>; 2]);

pub fn measure(cells: &RunCache, workshop: &EvalFixtures) -> Result<MemoryRuns> {
    let run = |name: &str, at: ExecutionSite| {
        cells.repeat(name, &(RobotHardware::PI, LARGE, REQUESTS), || measure_once(workshop, at))
    };
    let native = run("memory native", ExecutionSite::Native)?;
    Ok(MemoryRuns([native, run("memory outsourced", ExecutionSite::Outsourced)?]))
}

fn measure_once(workshop: &EvalFixtures, at: ExecutionSite) -> Result<(Trace, RunCost)> {
    let detector = EvalPackage { parameters: &LARGE, ..DETECTOR };
    workshop.publish(&detector)?;
    let directory = workshop.directory()?;
    let mut plan = workshop.plan(&detector, at, directory.path())?;
    if let NodeUnderTest::Stub { settings, .. } = &mut plan.node {
        // A robot of its own: parameters that a node sets stay with the robot's servant, as they stay with a ROS
        // Master.
        settings.push_str("\nrobot = \"large-pictures\"");
    }
    plan.most = REQUESTS;
    plan.patience = 240.0;
    let place = RobotSandbox::new(&workshop.daemon.address, RobotHardware::PI, NetworkProfile::Lan)?;
    match place.run(&plan, directory.path()) {
        // The expected result, not a failed measurement.
        Err(error) if place.killed_for_memory() > 0 => {
            let trace = Trace { node_ended: Some(format!("{error:#}")), ..Trace::default() };
            Ok((trace, RunCost { killed_for_memory: place.killed_for_memory(), ..RunCost::default() }))
        }
        run => run,
    }
}

pub fn section(runs: &MemoryRuns) -> Section {
    let mut section = ABOUT.section();
    let mut table = Table::new(
        "object_detector on a robot of the class Pi",
        "where | requests answered | published | processes ended for want of memory | p50 (ms) | p95 (ms) | p99 (ms)",
    );
    let names = [("native", "SSD could not be run"), ("outsourced, LAN", "SSD answered")];
    for ((name, published), run) in names.into_iter().zip(&runs.0) {
        if run.require(&mut section, name).is_none() {
            continue;
        }
        let answered = run.figure(|(trace, _)| Some(trace.answered_count() as f64));
        let killed = run.figure(|(_, cost)| Some(cost.killed_for_memory as f64));
        let mut row = vec![name.to_owned(), format!("{} of {REQUESTS}", count(answered)), published.to_owned()];
        row.push(count(killed));
        row.extend(run.percentiles(|(trace, _)| trace.responses()).map(milliseconds));
        table.push(row);
        section.findings.push(format!(
            "{name}: {} of {REQUESTS} requests are answered; the kernel ends {} processes for want of memory.",
            count(answered),
            count(killed)
        ));
    }
    section.tables.push(table);
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
        let runs = [(Trace::default(), killed), (outsourced, RunCost::default())].map(Runs::from);
        let section = section(&MemoryRuns(runs));
        assert_eq!(section.tables[0].rows[0][1..4], ["0 of 5", "SSD could not be run", "1"]);
        assert_tells(&section.findings[0], "ends 1 processes for want of memory");
        assert_tells(&section.findings[1], "5 of 5");
    }
}
