//! Experiment 5: variation of response times.

use anyhow::Result;

use super::{OutsourcingRun, OutsourcingSetUp, add_missing, examples, find_run};
use crate::place::NetworkProfile;
use crate::plots;
use crate::section::{Section, Table};
use crate::statistics::{mean, quantile, standard_deviation};
use crate::words::milliseconds;

/// Creates the section of experiment 5.
pub fn jitter(runs: &[OutsourcingRun]) -> Result<Section> {
    let mut section = Section::new(5, "jitter", "How much response times differ from request to request");
    section.published = "Fig. 6 of the publication: jitter of response times, native and outsourced.".to_owned();
    section.differs = vec![
        "The network itself has no jitter here (LAN, WAN): what is shown is that of the packages, \
        the portal and this machine's scheduler. A robot that has a quarter of a core is stopped by the kernel for \
        most of each tenth of a second, which is jitter, too."
            .to_owned(),
    ];
    let mut table = Table::new(
        "Response times, milliseconds",
        "package | robot | where | standard deviation | of the mean | 5 % | median | 95 % | 99 %",
    );
    for run in runs {
        let Some((trace, _)) = run.measured.value() else {
            continue;
        };
        let responses = trace.responses();
        let deviation = standard_deviation(&responses);
        let share =
            deviation.zip(mean(&responses)).map(|(deviation, mean)| format!("{:.0} %", 100.0 * deviation / mean));
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
        let native = find_run(runs, run.example.name, run.class, OutsourcingSetUp::Native);
        if let (OutsourcingSetUp::Behind(network), Some((native, _))) = (run.set_up, native) {
            let told = steadiness_finding(run, network, &native.responses(), &responses);
            section.findings.extend(told);
        }
    }
    section.tables.push(table);
    for example in examples(runs) {
        let of = runs.iter().filter(|run| run.example.name == example.name);
        let series = of.filter_map(|run| {
            let name = format!("{}, {}", run.class.name(), run.set_up.name());
            Some((name, run.measured.value()?.0.responses()))
        });
        let series: Vec<(String, Vec<f64>)> = series.collect();
        section.add_drawing(
            format!("jitter-{}", example.name),
            format!("{}: share of requests answered within a time", example.name),
            plots::distribution(example.name, "response time (s)", &series, true)?,
        );
    }
    add_missing(&mut section, runs);
    Ok(section)
}

/// Compares the variation natively and outsourced: by the standard deviations and, where that of the outsourced run is
/// not smaller, by the range of nine in ten requests.
fn steadiness_finding(run: &OutsourcingRun, network: NetworkProfile, native: &[f64], here: &[f64]) -> Option<String> {
    let [on_robot, outsourced] = [native, here].map(standard_deviation);
    let (on_robot, outsourced) = on_robot.zip(outsourced)?;
    let most = |all: &[f64]| Some(quantile(all, 0.95)? - quantile(all, 0.05)?);
    let less = outsourced < on_robot;
    let why = match most(native).zip(most(here)) {
        _ if less => String::new(),
        Some((native, here)) if here < native => format!(
            ": worse than hoped, and by few requests, as from 5 % to 95 % they differ by {} ms and on the robot by {} \
             ms",
            milliseconds(Some(here)),
            milliseconds(Some(native))
        ),
        _ => ": worse than hoped".to_owned(),
    };
    Some(format!(
        "{} by {}: response times {} outsourced (standard deviation {} ms) than on a robot of the class {} ({} \
         ms){why}.",
        run.example.name,
        network.name(),
        if less { "differ less" } else { "differ more" },
        milliseconds(Some(outsourced)),
        run.class.name(),
        milliseconds(Some(on_robot))
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::outsourcing::tests::test_run;
    use crate::words::assert_tells;

    #[test]
    fn jitter_is_compared_with_that_of_the_robot() {
        let runs = [
            test_run(OutsourcingSetUp::Native, &[0.3, 0.5]),
            test_run(OutsourcingSetUp::Behind(NetworkProfile::Lan), &[0.1, 0.1]),
            test_run(OutsourcingSetUp::Behind(NetworkProfile::Wan), &[0.1, 0.9]),
        ];
        let section = jitter(&runs).expect("a section");
        let [lan, wan] = &section.findings[..] else {
            panic!("{:?}", section.findings);
        };
        assert_tells(lan, "LAN: response times differ less");
        assert_tells(wan, "response times differ more outsourced (standard deviation 566 ms) than");
        assert!(wan.ends_with("(141 ms): worse than hoped."), "{wan}");
    }

    #[test]
    fn few_slow_requests_are_told_as_such() {
        let mut few = vec![0.1; 100];
        few[99] = 9.0;
        let runs = [
            test_run(OutsourcingSetUp::Native, &[0.3, 0.5]),
            test_run(OutsourcingSetUp::Behind(NetworkProfile::Wan), &few),
        ];
        let section = jitter(&runs).expect("a section");
        let told = &section.findings[0];
        assert!(
            told.ends_with("by few requests, as from 5 % to 95 % they differ by 0.00 ms and on the robot by 180 ms."),
            "{told}"
        );
    }
}
