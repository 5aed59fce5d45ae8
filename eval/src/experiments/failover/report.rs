//! Section of the report on a degraded network.

use super::{ABOUT, CLASS, FailoverRuns, FailoverSetUp, HERTZ, Q, TIMES, count_late, is_late, replay_satisfaction};
use crate::cells::Runs;
use crate::pictures::PICTURE;
use crate::place::{NetworkProfile, RunCost};
use crate::plots::{self, Series, TimelineData};
use crate::section::{Section, Table};
use crate::statistics::{Spread, mean};
use crate::trace::{RequestSample, Trace};
use crate::words::{count, digits, milliseconds, percent, spread};

/// Classes of points in the plot.
const CLASSES: [&str; 4] =
    ["answered by the cloud", "answered by the local original", "later than T_max", "never answered (at the top)"];

/// Runs of one set-up.
type SetUpRuns = Runs<(Trace, RunCost)>;

pub fn section(runs: &FailoverRuns) -> Section {
    let mut section = ABOUT.section();
    section.differs.push(conditions(runs));
    let mut table = Table::new(
        "By set-up. Q of the robot counts first answers, whoever gave them; Q of the cloud is the stub's own, of the \
         cloud's times",
        "set-up | requests | within T_max | late from each bad time's beginning on | never answered | \
         answered more than once | answered first by the local original | mean of those answered (ms) | p50 | p95 | \
         p99 | mean Q of the robot | least Q of the robot | mean Q of the cloud | \
         original asked, left, started, stopped",
    );
    table.push(["published (Fig. 7)", "130", "–", "drawn only", "–", "–", "drawn only"]);
    let mut seen = Vec::new();
    for (set_up, measured) in &runs.runs {
        let name = set_up.name();
        let Some((trace, _)) = measured.require(&mut section, name) else {
            continue;
        };
        measured.done.iter().for_each(|(trace, _)| section.note_early_end(name, trace));
        table.push(row(runs, *set_up, measured));
        section.add_drawing(
            format!("failover-{}", name.replace(", ", "--").replace(' ', "-")),
            format!("{name}: response time of each request of the first run, and Q"),
            plots::timeline(
                &format!("object_detector, {name}"),
                "request",
                "response time (s)",
                &timeline_data(runs, *set_up, trace),
            ),
        );
        seen.push(Series::new(name, number_values(replay_satisfaction(&trace.requests))));
    }
    section.tables.push(table);
    section.add_drawing(
        "failover-satisfaction",
        "Q of what the robot got, whoever answered first, in each set-up's first run",
        plots::lines("Satisfaction of the robot", "request", "Q", &seen, false),
    );
    section.findings = findings(runs);
    section
}

fn conditions(runs: &FailoverRuns) -> String {
    let bad: Vec<String> = runs.course.bad.iter().map(|(from, to)| format!("{from}-{to}")).collect();
    format!(
        "{HERTZ} requests a second, {} in all, on a robot of the class {}. The good network is the LAN ({}); that \
         during requests {} is bad ({}): one picture of {PICTURE} bytes takes {} s there. T_desire is {} s, T_max {} \
         s, Q begins at {}, Q_t is {}, the cap {}.",
        runs.course.requests,
        CLASS.name(),
        NetworkProfile::Lan.describe(),
        bad.join(", "),
        NetworkProfile::Bad.describe(),
        digits(NetworkProfile::Bad.transfer_time(PICTURE)),
        TIMES.0,
        TIMES.1,
        Q.0,
        Q.1,
        Q.2
    )
}

fn row(runs: &FailoverRuns, set_up: FailoverSetUp, measured: &SetUpRuns) -> Vec<String> {
    let figure = |find: &dyn Fn(&[RequestSample]) -> Option<f64>| measured.figure(|(trace, _)| find(&trace.requests));
    let number = |is: &dyn Fn(&RequestSample) -> bool| {
        count(figure(&|requests| Some(requests.iter().filter(|one| is(one)).count() as f64)))
    };
    let onsets = (0..runs.course.bad.len())
        .map(|onset| count(figure(&|requests| Some(count_late(&runs.course, requests)[onset] as f64))));
    let handovers = [0, 1, 2, 3].map(|kind| count(measured.figure(|(trace, _)| Some(trace.handovers[kind] as f64))));
    let own = |requests: &[RequestSample]| -> Vec<f64> { requests.iter().filter_map(|one| one.satisfaction).collect() };
    let mut row = vec![
        set_up.name().to_owned(),
        number(&|_| true),
        percent(share_in_time(measured)),
        onsets.collect::<Vec<_>>().join(", "),
        number(&|one| one.response.is_none()),
        number(&|one| one.answers > 1),
        number(&|one| is_local(set_up, one)),
        milliseconds(measured.figure(|(trace, _)| mean(&trace.responses()))),
    ];
    row.extend(measured.percentiles(|(trace, _)| trace.responses()).map(milliseconds));
    row.push(spread(figure(&|requests| mean(&replay_satisfaction(requests))), digits));
    row.push(spread(figure(&|requests| replay_satisfaction(requests).into_iter().reduce(f64::min)), digits));
    row.push(spread(figure(&|requests| mean(&own(requests))), digits));
    let has_both = matches!(set_up, FailoverSetUp::Stub | FailoverSetUp::Cold);
    row.push(if has_both { handovers.join(", ") } else { "–".to_owned() });
    row
}

/// Returns the fraction of requests answered within T_max.
fn share_in_time(measured: &SetUpRuns) -> Option<Spread> {
    measured.figure(|(trace, _)| {
        let late = trace.requests.iter().filter(|request| is_late(request)).count();
        (!trace.requests.is_empty()).then(|| 1.0 - late as f64 / trace.requests.len() as f64)
    })
}

fn is_local(set_up: FailoverSetUp, request: &RequestSample) -> bool {
    request.response.is_some() && (request.local || set_up == FailoverSetUp::Local)
}

fn number_values(values: impl IntoIterator<Item = f64>) -> Vec<(f64, f64)> {
    (1..).map(|number: u32| f64::from(number)).zip(values).collect()
}

fn timeline_data(runs: &FailoverRuns, set_up: FailoverSetUp, trace: &Trace) -> TimelineData {
    let requests = &trace.requests;
    // The time for which answers were awaited after the last request.
    let top = trace.responses().into_iter().fold(runs.course.stragglers, f64::max);
    let point = |(number, request): (u32, &RequestSample)| {
        let class = match request.response {
            None => 3,
            Some(_) if is_late(request) => 2,
            Some(_) => usize::from(is_local(set_up, request)),
        };
        (f64::from(number), request.response.unwrap_or(top), class)
    };
    let own = |(number, request): (u32, &RequestSample)| Some((f64::from(number), request.satisfaction?));
    TimelineData {
        points: (1..).zip(requests).map(point).collect(),
        classes: CLASSES.map(str::to_owned).to_vec(),
        bad: runs.course.bad.iter().map(|(first, last)| (*first as f64 - 0.5, *last as f64 + 0.5)).collect(),
        levels: vec![(TIMES.0, "T_desire".to_owned()), (TIMES.1, "T_max".to_owned())],
        q: match set_up {
            FailoverSetUp::Local => number_values(replay_satisfaction(requests)),
            _ => (1..).zip(requests).filter_map(own).collect(),
        },
    }
}

fn findings(runs: &FailoverRuns) -> Vec<String> {
    let mut findings = Vec::new();
    for (set_up, measured) in &runs.runs {
        let lost = measured.figure(|(trace, _)| Some((trace.requests.len() - trace.answered_count()) as f64));
        findings.extend(share_in_time(measured).map(|share| {
            let (name, share) = (set_up.name(), percent(Some(share)));
            format!("{name}: {share} of the requests are answered within T_max, {} are never answered.", count(lost))
        }));
        if measured.done.iter().any(|(trace, _)| trace.late_before) {
            findings.push(format!(
                "{}: answers were late already before the first request that counts: the machine was busy.",
                set_up.name()
            ));
        }
    }
    let share = |wanted| share_in_time(&runs.runs.iter().find(|(set_up, _)| *set_up == wanted)?.1);
    let Some(stub) = share(FailoverSetUp::Stub) else {
        return findings;
    };
    if share(FailoverSetUp::Cloud).is_some_and(|cloud| stub.median <= cloud.median) {
        findings.push("The stub with a local original is in time no more often than the cloud alone.".to_owned());
    }
    if let Some(local) = share(FailoverSetUp::Local).filter(|local| stub.median < local.median) {
        findings.push(format!(
            "Compared with the original alone {:.1} percentage points more of the requests are late: those by which \
             the stub notices that the network is bad, and those that wait for the processor that stub and original \
             share.",
            100.0 * (local.median - stub.median)
        ));
    }
    findings
}

#[cfg(test)]
mod tests {
    use super::super::FaultSchedule;
    use super::*;
    use crate::words::assert_tells;

    fn test_run(set_up: FailoverSetUp, responses: &[Option<f64>], local: bool) -> (FailoverSetUp, SetUpRuns) {
        let one = |response: &Option<f64>| RequestSample {
            response: *response,
            local,
            answers: usize::from(response.is_some()),
            satisfaction: Some(8.0),
            ..RequestSample::default()
        };
        let trace = Trace { requests: responses.iter().map(one).collect(), ..Trace::default() };
        (set_up, Runs::from((trace, RunCost::default())))
    }

    fn test_runs(runs: Vec<(FailoverSetUp, SetUpRuns)>) -> FailoverRuns {
        FailoverRuns { course: FaultSchedule { requests: 4, bad: vec![(2, 3)], stragglers: 1.0 }, runs }
    }

    #[test]
    fn the_table_counts_what_was_late_and_what_was_lost() {
        let section = section(&test_runs(vec![
            test_run(FailoverSetUp::Stub, &[Some(0.2), Some(0.9), Some(0.3), Some(0.2)], true),
            test_run(FailoverSetUp::Cloud, &[Some(0.2), None, None, Some(0.3)], false),
        ]));
        let [published, stub, cloud] = &section.tables[0].rows[..] else {
            panic!("{:?}", section.tables[0].rows);
        };
        assert_eq!(published[1], "130");
        assert_eq!(stub[2..7], ["75.0 %", "1", "0", "0", "4"]);
        assert_eq!(cloud[2..9], ["50.0 %", "2", "2", "0", "0", "250", "250"]);
        // 15 + 2, at most 16; halved twice; plus 2: 16, 8, 4, 6.
        assert_eq!(cloud[11..14], ["8.50", "4.00", "8.00"]);
    }

    #[test]
    fn a_stub_that_did_not_help_is_told() {
        let same = [Some(0.2), None, Some(0.3), Some(0.2)];
        let mut all = vec![
            test_run(FailoverSetUp::Stub, &same, false),
            test_run(FailoverSetUp::Cloud, &same, false),
            test_run(FailoverSetUp::Local, &[Some(0.2); 4], false),
        ];
        all[1].1.done[0].0.late_before = true;
        let section = section(&test_runs(all));
        let told = section.findings.join(" ");
        assert_tells(&told, "cloud alone: answers were late already");
        assert_tells(&told, "no more often than the cloud alone");
        assert_tells(&told, "25.0 percentage points more of the requests are late");
        assert!(section.missing.is_empty(), "{:?}", section.missing);
    }

    #[test]
    fn a_run_that_failed_is_missing() {
        let lost = (FailoverSetUp::Cloud, Runs::from_failure("no control groups"));
        let section = section(&test_runs(vec![lost]));
        assert!(section.missing[0].why.contains("no control groups"));
    }
}
