//! Experiment 5: how much response times differ from request to request.

use anyhow::Result;

use super::{Run, SetUp, find, missing};
use crate::examples::ALL;
use crate::place::Network;
use crate::plots;
use crate::section::{Section, Table};
use crate::statistics::{mean, quantile, standard_deviation};
use crate::words::milliseconds;

/// Experiment 5.
pub fn jitter(runs: &[Run]) -> Result<Section> {
    let mut section = Section::new(
        5,
        "jitter",
        "How much response times differ from request to request",
    );
    section.published =
        "Fig. 6 of the publication: jitter of response times, native and outsourced.".to_owned();
    section.differs = vec!["The network itself has no jitter here (LAN, WAN): what is shown is that of the packages, the portal and this machine's scheduler. A robot that has a quarter of a core is stopped by the kernel for most of each tenth of a second, which is jitter, too.".to_owned()];
    let mut table = Table::new(
        "Response times, milliseconds",
        [
            "package",
            "robot",
            "where",
            "standard deviation",
            "of the mean",
            "5 %",
            "median",
            "95 %",
            "99 %",
        ],
    );
    for run in runs {
        let Some((trace, _)) = run.measured.done() else {
            continue;
        };
        let responses = trace.responses();
        let deviation = standard_deviation(&responses);
        let share = deviation
            .zip(mean(&responses))
            .map(|(deviation, mean)| format!("{:.0} %", 100.0 * deviation / mean));
        let at = |share| milliseconds(quantile(&responses, share));
        table.push([
            run.example.name.to_owned(),
            run.class.name().to_owned(),
            run.set_up.name().to_owned(),
            milliseconds(deviation),
            share.unwrap_or_default(),
            at(0.05),
            at(0.5),
            at(0.95),
            at(0.99),
        ]);
        let native = find(runs, run.example.name, run.class, SetUp::Native);
        let native = native.and_then(|(trace, _)| standard_deviation(&trace.responses()));
        if let (SetUp::Behind(network), Some((native, here))) = (run.set_up, native.zip(deviation))
        {
            section
                .findings
                .push(steadier(run, network, (native, here)));
        }
    }
    section.tables.push(table);
    for example in ALL {
        let of = runs.iter().filter(|run| run.example.name == example.name);
        let series = of.filter_map(|run| {
            let name = format!("{}, {}", run.class.name(), run.set_up.name());
            Some((name, run.measured.done()?.0.responses()))
        });
        let series: Vec<(String, Vec<f64>)> = series.collect();
        section.drawing(
            format!("jitter-{}", example.name),
            format!("{}: share of requests answered within a time", example.name),
            plots::distribution(example.name, "response time (s)", &series, true)?,
        );
    }
    missing(&mut section, runs);
    Ok(section)
}

/// By the standard deviations natively and outsourced, seconds.
fn steadier(run: &Run, network: Network, (native, here): (f64, f64)) -> String {
    let words = if here < native {
        "differ less"
    } else {
        "do not differ less, which is worse than hoped"
    };
    format!(
        "{} by {}: response times {words} outsourced (standard deviation {} ms) than on a robot of the class {} ({} ms).",
        run.example.name,
        network.name(),
        milliseconds(Some(here)),
        run.class.name(),
        milliseconds(Some(native))
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::outsourcing::tests::run;

    #[test]
    fn jitter_is_compared_with_that_of_the_robot() {
        let runs = [
            run(SetUp::Native, &[0.3, 0.5]),
            run(SetUp::Behind(Network::Lan), &[0.1, 0.1]),
            run(SetUp::Behind(Network::Wan), &[0.1, 0.9]),
        ];
        let section = jitter(&runs).expect("a section");
        let [lan, wan] = &section.findings[..] else {
            panic!("{:?}", section.findings);
        };
        assert!(lan.contains("LAN: response times differ less"), "{lan}");
        assert!(wan.contains("worse than hoped"), "{wan}");
    }
}
