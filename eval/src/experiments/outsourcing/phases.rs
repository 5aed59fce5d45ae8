//! Experiment 4: the parts of a frame's response time.

use anyhow::Result;

use super::{OutsourcingRun, add_missing};
use crate::examples::LASER_SLAM;
use crate::plots::{self, Bar};
use crate::section::{MissingMeasurement, Section, Table};
use crate::statistics::mean;
use crate::trace::ComputationPhases;
use crate::words::milliseconds;

/// Creates the section of experiment 4.
pub fn phases(runs: &[OutsourcingRun]) -> Result<Section> {
    let mut section = Section::new(4, "phases", "Where the time of one frame goes");
    section.published = "Table II of the publication: SLAMBench's phases (acquisition, computation, rendering) of \
        KinectFusion, native and outsourced."
        .to_owned();
    section.differs = vec![
        "The phases are those of laser_slam, as it tells them itself; what is left of the response time is transport: \
         serialization, the network, the portal and waiting."
            .to_owned(),
    ];
    let mut table = Table::new(
        "Mean of all frames, milliseconds",
        "robot | where | acquisition | computation | rendering | transport and waiting | response time",
    );
    let mut bars = Vec::new();
    for run in runs.iter().filter(|run| run.example.name == LASER_SLAM.name) {
        let Some((trace, _)) = run.measured.value() else {
            continue;
        };
        // All means are over the same requests: those whose parts are known.
        let both = trace.requests.iter();
        let both = both.filter_map(|one| Some((one.response?, one.phases?)));
        let (responses, told): (Vec<f64>, Vec<ComputationPhases>) = both.unzip();
        if told.is_empty() {
            section.missing.push(MissingMeasurement {
                what: format!("phases, {}, {}", run.class.name(), run.set_up.name()),
                why: "the node told none".to_owned(),
                next: "look at its topic laser_slam/timing".to_owned(),
            });
            continue;
        }
        let of = |part: fn(&ComputationPhases) -> f64| mean(&told.iter().map(part).collect::<Vec<f64>>());
        let parts = [of(|one| one.acquisition), of(|one| one.computation), of(|one| one.rendering)];
        let own: f64 = parts.iter().flatten().sum();
        let whole = mean(&responses);
        let rest = whole.map(|whole| whole - own);
        let group = format!("{}, {}", run.class.name(), run.set_up.name());
        let shares = [parts[1], rest].map(|part| Some(100.0 * part? / whole?));
        if let [Some(computation), Some(transport)] = shares {
            section.findings.push(format!(
                "{group}: computation is {computation:.0} % of the response time, transport and waiting {transport:.0} \
                 %."
            ));
        }
        for (name, part) in
            ["acquisition", "computation", "rendering", "transport"].into_iter().zip(parts.into_iter().chain([rest]))
        {
            bars.push(Bar {
                group: group.clone(),
                name: name.to_owned(),
                value: part.unwrap_or(f64::NAN) * 1e3,
                spread: None,
            });
        }
        let cells = parts.into_iter().chain([rest, whole]).map(milliseconds);
        table.push([run.class.name().to_owned(), run.set_up.name().to_owned()].into_iter().chain(cells));
    }
    section.tables.push(table);
    section.add_drawing(
        "phases",
        "Parts of one frame's response time",
        plots::bars("laser_slam", "time (ms)", &bars, false)?,
    );
    add_missing(&mut section, &runs.iter().filter(|run| run.example.name == LASER_SLAM.name).collect::<Vec<_>>());
    Ok(section)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::outsourcing::OutsourcingSetUp;
    use crate::experiments::outsourcing::tests::test_run;

    #[test]
    fn what_phases_do_not_tell_is_transport() {
        let section = phases(&[test_run(OutsourcingSetUp::Native, &[1.0, 1.0])]).expect("a section");
        assert_eq!(section.tables[0].rows[0][2..], ["100", "500", "200", "200", "1000"].map(str::to_owned));
    }
}
