//! Experiment 5: variation of response times.

use super::{OutsourcingRun, OutsourcingSetUp, add_missing, examples};
use crate::plots;
use crate::section::{About, Section, Table};
use crate::statistics::{mean, standard_deviation};
use crate::words::{count, milliseconds};

/// The experiment.
pub const JITTER: About = About {
    number: 5,
    id: "jitter",
    title: "How much response times differ from request to request",
    published: "Fig. 6 of the publication: jitter of response times, native and outsourced.",
    differs: &["LAN and WAN have no jitter of their own here: what is shown is that of the packages, the portal and \
        the scheduler, which stops a robot with a quarter of a core for most of each tenth of a second."],
};

/// Creates the section of experiment 5.
pub fn jitter(runs: &[OutsourcingRun]) -> Section {
    let mut section = JITTER.section();
    let mut table = Table::new(
        "Response times, milliseconds",
        "package | robot | where | standard deviation | of the mean, % | p50 | p95 | p99",
    );
    for run in runs.iter().filter(|run| !run.measured.done.is_empty()) {
        let deviation = run.measured.figure(|(trace, _)| standard_deviation(&trace.responses()));
        let share = run.measured.figure(|(trace, _)| {
            let responses = trace.responses();
            Some(100.0 * standard_deviation(&responses)? / mean(&responses)?)
        });
        let mut row = run.labels().map(str::to_owned).to_vec();
        row.extend([milliseconds(deviation), count(share)]);
        row.extend(run.measured.percentiles(|(trace, _)| trace.responses()).map(milliseconds));
        table.push(row);
        if let (OutsourcingSetUp::Behind(network), Some(native)) = (run.set_up, run.native(runs)) {
            let on_robot = native.measured.figure(|(trace, _)| standard_deviation(&trace.responses()));
            section.findings.extend(deviation.zip(on_robot).map(|(here, there)| {
                format!(
                    "{} by {}: response times differ {} outsourced than on a robot of the class {} (standard \
                     deviations {} and {} ms).",
                    run.example.name,
                    network.name(),
                    if here.median < there.median { "less" } else { "more, worse than hoped," },
                    run.class.name(),
                    milliseconds(deviation),
                    milliseconds(on_robot)
                )
            }));
        }
    }
    section.tables.push(table);
    for example in examples(runs) {
        let of = runs.iter().filter(|run| run.example.name == example.name);
        let series = of.filter_map(|run| Some((run.place_name(), run.measured.first()?.0.responses())));
        section.add_drawing(
            format!("jitter-{}", example.name),
            format!("{}: share of requests answered within a time, in the first run", example.name),
            plots::distribution(example.name, "response time (s)", &series.collect::<Vec<_>>(), true),
        );
    }
    add_missing(&mut section, runs);
    section
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::outsourcing::tests::test_run;
    use crate::place::NetworkProfile;
    use crate::words::assert_tells;

    #[test]
    fn jitter_is_compared_with_that_of_the_robot() {
        let runs = [
            test_run(OutsourcingSetUp::Native, &[0.3, 0.5]),
            test_run(OutsourcingSetUp::Behind(NetworkProfile::Lan), &[0.1, 0.1]),
            test_run(OutsourcingSetUp::Behind(NetworkProfile::Wan), &[0.1, 0.9]),
        ];
        let section = jitter(&runs);
        assert_tells(&section.findings[0], "LAN: response times differ less outsourced");
        assert_tells(&section.findings[1], "differ more, worse than hoped, outsourced");
        assert_tells(&section.findings[1], "(standard deviations 566 and 141 ms)");
        assert_eq!(section.tables[0].rows[0][5..], ["400", "490", "498"]);
    }
}
