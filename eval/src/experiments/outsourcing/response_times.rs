//! Experiment 2: response times natively and outsourced, and the speedup.

use anyhow::Result;

use super::{OutsourcingRun, OutsourcingSetUp, add_missing, examples, find_run};
use crate::place::NetworkProfile;
use crate::plots::{self, Series};
use crate::section::{Section, Table};
use crate::statistics::{mean, quantile};
use crate::trace::Trace;
use crate::words::{milliseconds, or_dash, ratio};

/// Largest factor in Fig. 5 of the publication.
const PUBLISHED: u32 = 25;

/// Creates the section of experiment 2.
pub fn response_times(runs: &[OutsourcingRun]) -> Result<Section> {
    let mut section = Section::new(2, "outsourcing", "Native and outsourced, on two kinds of robots");
    section.published = "Fig. 5 of the publication: response times per request and accumulated times of RGBD-SLAM, \
        RTAB-Map and SSD on a \
        Raspberry Pi and on an ultrabook, native and outsourced: outsourced they were up to 25 times as fast."
        .to_owned();
    section.differs = differences();
    let network = runs.iter().find_map(|run| Some(&run.measured.value()?.1.network));
    section.differs.extend(network.map(|network| format!("Packets are delayed by {network}.")));
    let mut table = Table::new(
        "Response times, from publishing a request to its answer (milliseconds), one request after the other",
        "package | robot | where | requests | answered | median | 95 % | accumulated (s) | \
         times as fast, by medians | times as fast, by means | published | robot's CPU, whole run (s) | \
         bytes a request, both ways",
    );
    for run in runs {
        let Some((trace, cost)) = run.measured.value() else {
            continue;
        };
        let responses = trace.responses();
        let native = find_run(runs, run.example.name, run.class, OutsourcingSetUp::Native);
        let native = native.map(|(trace, _)| trace.responses());
        let median = quantile(&responses, 0.5);
        let times = |of: &dyn Fn(&[f64]) -> Option<f64>| Some(of(native.as_ref()?)? / of(&responses)?);
        let faster = times(&|all| quantile(all, 0.5));
        let by_means = times(&|all| mean(all));
        table.push([
            run.example.name.to_owned(),
            run.class.name().to_owned(),
            run.set_up.name().to_owned(),
            trace.requests.len().to_string(),
            trace.answered_count().to_string(),
            milliseconds(median),
            milliseconds(quantile(&responses, 0.95)),
            format!("{:.1}", responses.iter().sum::<f64>()),
            ratio(faster),
            ratio(by_means),
            published_factor(run.set_up),
            format!("{:.1}", cost.robot_cpu),
            or_dash(trace.bytes_per_request(1), |ways| format!("{:.0}", ways[0] + ways[1])),
        ]);
        if let (Some(both), OutsourcingSetUp::Behind(network)) = (faster.zip(by_means), run.set_up) {
            section.findings.push(finding(run, network, both));
        }
        let lost = trace.requests.len() - trace.answered_count();
        if lost > 0 {
            section.findings.push(format!(
                "{}, {}, {}: {lost} of {} requests were never answered, and times are those of the others.",
                run.example.name,
                run.class.name(),
                run.set_up.name(),
                trace.requests.len()
            ));
        }
    }
    section.tables.push(table);
    for example in examples(runs) {
        let series = |of: fn(&Trace) -> Vec<(f64, f64)>| -> Vec<Series> {
            let done = runs.iter().filter(|run| run.example.name == example.name);
            let one = |run: &OutsourcingRun| {
                Some(Series {
                    name: format!("{}, {}", run.class.name(), run.set_up.name()),
                    points: of(&run.measured.value()?.0),
                })
            };
            done.filter_map(one).collect()
        };
        let title = format!("{} (stands for {})", example.name, example.stands_for);
        section.add_drawing(
            format!("outsourcing-{}", example.name),
            format!("{title}: response time of each request"),
            plots::lines(&title, "request", "response time (s)", &series(numbered_responses), true)?,
        );
        section.add_drawing(
            format!("outsourcing-{}-accumulated", example.name),
            format!("{title}: accumulated response times"),
            plots::lines(&title, "request", "accumulated response times (s)", &series(accumulate), false)?,
        );
    }
    add_missing(&mut section, runs);
    Ok(section)
}

/// Returns the speedup of the publication's packages over the robot (Fig. 5); only its largest number is known to us.
fn published_factor(set_up: OutsourcingSetUp) -> String {
    match set_up {
        OutsourcingSetUp::Native => "1".to_owned(),
        OutsourcingSetUp::Behind(_) => format!("up to {PUBLISHED}"),
    }
}

fn differences() -> Vec<String> {
    [
        "The published packages are not packaged for this system: laser_slam (scan matching), graph_slam (a graph of \
         poses, whose steps take longer as it grows) and object_detector (a neural network) stand in; the SLAM \
         packages work on a recorded drive of MRPT.",
        "A Raspberry Pi is a quarter of a core of this machine and 1 GiB, an ultrabook half a core and 4 GiB; the \
         cloud has one core for each servant. With that few cores no factor of 25 can come about: one core is four \
         times a quarter.",
        &format!(
            "Networks are delays, rates and losses between two namespaces of this machine (LAN: {}; WAN: {}).",
            NetworkProfile::Lan.describe(),
            NetworkProfile::Wan.describe()
        ),
        "The model of cores beside this predicts means, because only means follow a limit of a fraction of a core: the \
         column by means is to be compared with it.",
    ]
    .map(str::to_owned)
    .to_vec()
}

/// Reports the ratios of medians and of means, which may disagree if few requests take long.
fn finding(run: &OutsourcingRun, network: NetworkProfile, (medians, means): (f64, f64)) -> String {
    let (name, class, network) = (run.example.name, run.class.name(), network.name());
    let [by_medians, by_means] = [medians, means].map(|times| ratio(Some(times)));
    if medians >= 1.0 {
        return format!(
            "{name} answers {by_medians} times as fast outsourced by {network} as on a robot of the class {class} \
             (medians; by means {by_means} times)."
        );
    }
    let why = if means < 1.0 {
        ": the way to the cloud and back takes longer than what its processor saves"
    } else {
        ": most requests are quicker on the robot, the slowest ones in the cloud"
    };
    format!(
        "{name} answers more slowly outsourced by {network} than on a robot of the class {class} ({by_medians} times \
         as fast by medians, {by_means} times by means){why}."
    )
}

fn numbered_responses(trace: &Trace) -> Vec<(f64, f64)> {
    let known = (1..).zip(&trace.requests);
    let point = |(number, one): (u32, &crate::trace::RequestSample)| Some((f64::from(number), one.response?));
    known.filter_map(point).collect()
}

fn accumulate(trace: &Trace) -> Vec<(f64, f64)> {
    let mut sum = 0.0;
    let add = |(number, response)| {
        sum += response;
        (number, sum)
    };
    numbered_responses(trace).into_iter().map(add).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::outsourcing::tests::test_run;
    use crate::words::assert_tells;

    #[test]
    fn how_much_faster_is_by_the_medians() {
        let runs = [
            test_run(OutsourcingSetUp::Native, &[0.3, 0.4, 0.5]),
            test_run(OutsourcingSetUp::Behind(NetworkProfile::Lan), &[0.1, 0.1, 0.9]),
            test_run(OutsourcingSetUp::Behind(NetworkProfile::Wan), &[0.8, 0.8, 0.8]),
        ];
        let section = response_times(&runs).expect("a section");
        let faster: Vec<&str> = section.tables[0].rows.iter().map(|row| row[8].as_str()).collect();
        assert_eq!(faster, ["1.0", "4.0", "0.50"]);
        assert_eq!(section.tables[0].rows[1][9], "1.1");
        assert_eq!(section.tables[0].rows[1][10], "up to 25");
        assert_tells(&section.findings[0], "4.0 times as fast");
        assert_tells(&section.findings[1], "more slowly");
    }

    #[test]
    fn accumulated_times_are_sums() {
        let OutsourcingRun { measured, .. } = test_run(OutsourcingSetUp::Native, &[1.0, 2.0, 3.0]);
        let sums = accumulate(&measured.value().expect("it is").0);
        assert_eq!(sums, [(1.0, 1.0), (2.0, 3.0), (3.0, 6.0)]);
    }
}
