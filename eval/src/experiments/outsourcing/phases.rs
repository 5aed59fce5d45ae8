//! Experiment 4: the parts of a frame's response time.

use super::{OutsourcingRun, add_missing};
use crate::examples::LASER_SLAM;
use crate::plots::{self, Bar};
use crate::section::{About, Section, Table};
use crate::trace::{PART_NAMES, Trace};
use crate::words::{count, milliseconds};

/// The experiment.
pub const PHASES: About = About {
    number: 4,
    id: "phases",
    title: "Where the time of one frame goes",
    published: "Table II of the publication: SLAMBench's phases (acquisition, computation, rendering) of KinectFusion, \
        native and outsourced.",
    differs: &["The phases are those that laser_slam tells; what is left of the response time is transport: \
        serialization, the network, the portal and waiting."],
};

/// Creates the section of experiment 4.
pub fn phases(runs: &[OutsourcingRun]) -> Section {
    let mut section = PHASES.section();
    let head = format!("robot | where | {} | response time", PART_NAMES.join(" | "));
    let mut table = Table::new("Mean of all frames, milliseconds", &head);
    let mut bars = Vec::new();
    let of_slam = || runs.iter().filter(|run| run.example.name == LASER_SLAM.name);
    for run in of_slam().filter(|run| !run.measured.done.is_empty()) {
        let figure = |find: &dyn Fn(&Trace) -> Option<f64>| run.measured.figure(|(trace, _)| find(trace));
        let parts = [0, 1, 2, 3].map(|part| figure(&|trace| Some(trace.mean_parts()?[part])));
        let whole = figure(&|trace| Some(trace.mean_parts()?.iter().sum()));
        if whole.is_none() {
            let next = "look at its topic laser_slam/timing";
            section.add_missing(format!("phases, {}", run.place_name()), "the node told none", next);
            continue;
        }
        let [computation, transport] = [1, 3].map(|part| {
            figure(&|trace| {
                let parts = trace.mean_parts()?;
                Some(100.0 * parts[part] / parts.iter().sum::<f64>())
            })
        });
        section.findings.push(format!(
            "{}: computation is {} % of the response time, transport and waiting {} %.",
            run.place_name(),
            count(computation),
            count(transport)
        ));
        bars.extend(PART_NAMES.iter().zip(parts).filter_map(|(name, part)| {
            let part = part?;
            let spread = Some((part.low * 1e3, part.high * 1e3));
            Some(Bar { spread, ..Bar::new(run.place_name(), *name, part.median * 1e3) })
        }));
        let mut row = run.labels()[1..].iter().map(|label| (*label).to_owned()).collect::<Vec<_>>();
        row.extend(parts.into_iter().chain([whole]).map(milliseconds));
        table.push(row);
    }
    section.tables.push(table);
    let drawing = plots::bars("laser_slam", "time (ms)", &bars, false);
    section.add_drawing("phases", "Parts of one frame's response time", drawing);
    add_missing(&mut section, of_slam());
    section
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::outsourcing::OutsourcingSetUp;
    use crate::experiments::outsourcing::tests::test_run;

    #[test]
    fn what_phases_do_not_tell_is_transport() {
        let section = phases(&[test_run(OutsourcingSetUp::Native, &[1.0, 1.0])]);
        assert_eq!(section.tables[0].rows[0][2..], ["100", "500", "200", "200", "1000"]);
    }
}
