//! Experiment 2: response times natively and outsourced, and the speedup.

use super::{OutsourcingRun, OutsourcingSetUp, add_missing, examples};
use crate::plots::{self, Series};
use crate::section::{About, Section, Table};
use crate::statistics::{Spread, mean, median};
use crate::trace::Trace;
use crate::words::{count, digits, milliseconds, ratio, spread};

/// The experiment.
pub const RESPONSE_TIMES: About = About {
    number: 2,
    id: "outsourcing",
    title: "Native and outsourced, on two kinds of robots",
    published: "Fig. 5 of the publication: response times per request and accumulated times of RGBD-SLAM, RTAB-Map \
        and SSD on a Raspberry Pi and on an ultrabook: outsourced they were up to 25 times as fast.",
    differs: &[
        "laser_slam (scan matching), graph_slam (a graph of poses, whose steps take longer as it grows) and \
         object_detector (a neural network) stand in; the SLAM packages work on a recorded drive of MRPT.",
        "A Raspberry Pi is a quarter of a core of this machine and 1 GiB, an ultrabook half a core and 4 GiB; the \
         cloud has one core for each servant. No factor of 25 can come about: one core is four times a quarter.",
        "Networks are delays and rates between two namespaces: LAN 1 ms each way, 100 Mbit/s; WAN 30 ms, 20 Mbit/s.",
    ],
};

/// Creates the section of experiment 2.
pub fn response_times(runs: &[OutsourcingRun]) -> Section {
    let mut section = RESPONSE_TIMES.section();
    let network = runs.iter().find_map(|run| Some(&run.measured.first()?.1.network));
    section.differs.extend(network.map(|network| format!("Packets are delayed by {network}.")));
    let mut table = Table::new(
        "Response times, from publishing a request to its answer (milliseconds), one request after the other",
        "package | robot | where | requests | answered | p50 | p95 | p99 | accumulated (s) | \
         times as fast, by medians | times as fast, by means | published | robot's CPU, whole run (s) | \
         bytes a request, both ways",
    );
    for run in runs.iter().filter(|run| !run.measured.done.is_empty()) {
        let figure = |find: &dyn Fn(&Trace) -> Option<f64>| run.measured.figure(|(trace, _)| find(trace));
        let faster = |of: fn(&[f64]) -> Option<f64>| {
            let native = &run.native(runs)?.measured;
            native.compare(&run.measured, |(native, _), (here, _)| {
                Some(of(&native.responses())? / of(&here.responses())?)
            })
        };
        let (by_medians, by_means) = (faster(median), faster(mean));
        let mut row = run.labels().map(str::to_owned).to_vec();
        row.push(count(figure(&|trace| Some(trace.requests.len() as f64))));
        row.push(count(figure(&|trace| Some(trace.answered_count() as f64))));
        row.extend(run.measured.percentiles(|(trace, _)| trace.responses()).map(milliseconds));
        row.push(spread(figure(&|trace| Some(trace.responses().iter().sum())), digits));
        row.extend([ratio(by_medians), ratio(by_means)]);
        row.push(if run.set_up == OutsourcingSetUp::Native { "1" } else { "up to 25" }.to_owned());
        row.push(spread(run.measured.figure(|(_, cost)| Some(cost.robot_cpu)), digits));
        row.push(count(figure(&|trace| trace.bytes_per_request(1).map(|ways| ways[0] + ways[1]))));
        table.push(row);
        if run.set_up != OutsourcingSetUp::Native {
            section.findings.extend(by_medians.zip(by_means).map(|both| finding(run, both)));
        }
        let lost = figure(&|trace| Some((trace.requests.len() - trace.answered_count()) as f64));
        if lost.is_some_and(|lost| lost.high > 0.0) {
            section.findings.push(format!(
                "{}: {} requests were never answered.",
                run.labels().join(", "),
                count(lost)
            ));
        }
    }
    section.tables.push(table);
    for example in examples(runs) {
        let series = |of: fn(&Trace) -> Vec<(f64, f64)>| -> Vec<Series> {
            let done = runs.iter().filter(|run| run.example.name == example.name);
            done.filter_map(|run| Some(Series::new(run.place_name(), of(&run.measured.first()?.0)))).collect()
        };
        let title = format!("{} (stands for {})", example.name, example.stands_for);
        let (id, each) = (format!("outsourcing-{}", example.name), series(numbered_responses));
        let drawing = plots::lines(&title, "request", "response time (s)", &each, true);
        section.add_drawing(&id, format!("{title}: response time of each request, first run"), drawing);
        let drawing = plots::lines(&title, "request", "accumulated response times (s)", &series(accumulate), false);
        section.add_drawing(format!("{id}-accumulated"), format!("{title}: accumulated response times"), drawing);
    }
    add_missing(&mut section, runs);
    section
}

/// Reports the ratios of medians and of means, which may disagree if few requests take long.
fn finding(run: &OutsourcingRun, (medians, means): (Spread, Spread)) -> String {
    let [name, class, network] = run.labels();
    let why = match (medians.median < 1.0, means.median < 1.0) {
        (true, true) => ": slower, the way to the cloud takes longer than what its processor saves",
        (true, false) => ": most requests are quicker on the robot, the slowest ones in the cloud",
        _ => "",
    };
    format!(
        "{name} answers {} times as fast outsourced by {network} as on a robot of the class {class} by medians, {} \
         times by means{why}.",
        ratio(Some(medians)),
        ratio(Some(means))
    )
}

fn numbered_responses(trace: &Trace) -> Vec<(f64, f64)> {
    (1..).zip(&trace.requests).filter_map(|(number, one)| Some((f64::from(number), one.response?))).collect()
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
    use crate::place::NetworkProfile;
    use crate::words::assert_tells;

    #[test]
    fn how_much_faster_is_by_the_medians() {
        let runs = [
            test_run(OutsourcingSetUp::Native, &[0.3, 0.4, 0.5]),
            test_run(OutsourcingSetUp::Behind(NetworkProfile::Lan), &[0.1, 0.1, 0.9]),
            test_run(OutsourcingSetUp::Behind(NetworkProfile::Wan), &[0.8, 0.8, 0.8]),
        ];
        let section = response_times(&runs);
        let faster: Vec<&str> = section.tables[0].rows.iter().map(|row| row[9].as_str()).collect();
        assert_eq!(faster, ["1.0", "4.0", "0.50"]);
        assert_eq!(section.tables[0].rows[1][10..12], ["1.1", "up to 25"]);
        assert_tells(&section.findings[0], "4.0 times as fast");
        assert_tells(&section.findings[1], "slower");
    }

    #[test]
    fn accumulated_times_are_sums() {
        let run = test_run(OutsourcingSetUp::Native, &[1.0, 2.0, 3.0]);
        let (trace, _) = run.measured.first().expect("it is measured");
        assert_eq!(accumulate(trace), [(1.0, 1.0), (2.0, 3.0), (3.0, 6.0)]);
    }
}
