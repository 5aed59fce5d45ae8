//! Section of the report on a degraded network.

use anyhow::Result;

use super::{
    CLASS, FailoverRun, FailoverRuns, FailoverSetUp, HERTZ, Q, TIMES, count_late, is_late, replay_satisfaction,
};
use crate::place::NetworkProfile;
use crate::plots::{self, Series, TimelineData};
use crate::recording::PICTURE;
use crate::section::{AGAIN, Section, Table};
use crate::statistics::{mean, quantile};
use crate::trace::{RequestSample, Trace};
use crate::words::{digits, milliseconds, or_dash, percent};

/// Classes of points in the plot.
const CLASSES: [&str; 4] =
    ["answered by the cloud", "answered by the local original", "later than T_max", "never answered (at the top)"];

/// Creates the section of the report.
pub fn section(runs: &FailoverRuns) -> Result<Section> {
    let mut section = Section::new(6, "failover", "A network that becomes bad and good again");
    section.published = "Fig. 7 of the publication: response times of 130 requests while the network is bad during \
        requests 24-45, 75-96 and 111-122: the local original takes over within a few requests, and hands back. No \
        mean and no share is published."
        .to_owned();
    section.differs = differences(runs);
    if runs.runs.len() < 3 {
        let left_out = "A quick evaluation has one bad time, and neither a cold original nor one alone: make eval \
            ONLY=6 has the published course.";
        section.differs.push(left_out.to_owned());
    }
    let mut table = new_table();
    for run in &runs.runs {
        let name = run.set_up.name();
        let Some((trace, _)) = run.measured.require(&mut section, name, AGAIN) else {
            continue;
        };
        section.note_early_end(format!("{name}: to its end"), trace);
        add_row(&mut table, runs, run.set_up, trace);
        let title = format!("object_detector, {name}");
        let data = timeline_data(runs, run);
        section.add_drawing(
            format!("failover-{}", name.replace([' ', ','], "-")),
            format!("{name}: response time of each request, and Q{}", whose_q(run.set_up)),
            plots::timeline(&title, "request", "response time (s)", &data)?,
        );
    }
    section.tables.push(table);
    let seen: Vec<Series> = measured_requests(runs)
        .map(|(set_up, requests)| Series::new(set_up.name(), number_values(replay_satisfaction(requests))))
        .collect();
    section.add_drawing(
        "failover-satisfaction",
        "Q of what the robot got, whoever answered first, in each set-up",
        plots::lines("Satisfaction of the robot", "request", "Q", &seen, false)?,
    );
    section.findings = findings(runs);
    Ok(section)
}

fn differences(runs: &FailoverRuns) -> Vec<String> {
    let bad: Vec<String> = runs.course.bad.iter().map(|(from, to)| format!("{from}-{to}")).collect();
    let alone = measured_requests(runs).find(|(set_up, _)| *set_up == FailoverSetUp::Local);
    let alone = alone
        .and_then(|(_, requests)| quantile(&requests.iter().filter_map(|one| one.response).collect::<Vec<f64>>(), 0.5));
    let alone = alone.map(|median| {
        format!(
            ", where alone it needs {} ms of the {} ms from request to request (median)",
            milliseconds(Some(median)),
            milliseconds(Some(1.0 / HERTZ))
        )
    });
    vec![
        format!(
            "object_detector stands in for SSD; it is asked {HERTZ} times a second, {} times, on a robot of the class \
             {} ({} of a core){}.",
            runs.course.requests,
            CLASS.name(),
            CLASS.cores,
            alone.unwrap_or_default()
        ),
        format!(
            "The good network is the LAN ({}). That during requests {} is bad ({}): one picture of {} bytes, as it is \
             without a codec, takes {} s there at that rate.",
            NetworkProfile::Lan.describe(),
            bad.join(", "),
            NetworkProfile::Bad.describe(),
            PICTURE,
            digits(NetworkProfile::Bad.transfer_time(PICTURE))
        ),
        format!(
            "T_desire is {} s, T_max {} s, Q begins at {}, Q_t is {}; Q stays below {} here, so that two late requests \
             in a row always suffice (the published algorithm has no cap).",
            TIMES.0, TIMES.1, Q.0, Q.1, Q.2
        ),
    ]
}

fn new_table() -> Table {
    Table::new(
        "By set-up. Q of the robot counts first answers, whoever gave them; Q of the cloud is the stub's own, of the \
         cloud's times",
        "set-up | requests | within T_max | late from each bad time's beginning on | never answered | \
         answered more than once | answered first by the local original | \
         mean response of those answered (ms) | median of those answered (ms) | mean Q of the robot | \
         least Q of the robot | mean Q of the cloud | original asked, left, started, stopped",
    )
    .row(["published (Fig. 7)", "130", "–", "drawn only", "–", "–", "drawn only", "–", "–", "–", "–", "–", "–"])
}

fn add_row(table: &mut Table, runs: &FailoverRuns, set_up: FailoverSetUp, trace: &Trace) {
    let requests = &trace.requests;
    let responses: Vec<f64> = requests.iter().filter_map(|one| one.response).collect();
    let count = |is: &dyn Fn(&RequestSample) -> bool| requests.iter().filter(|one| is(one)).count();
    let seen = replay_satisfaction(requests);
    let own: Vec<f64> = requests.iter().filter_map(|one| one.satisfaction).collect();
    let number = |value: Option<f64>| or_dash(value, digits);
    let onsets: Vec<String> = count_late(&runs.course, requests).iter().map(usize::to_string).collect();
    table.push([
        set_up.name().to_owned(),
        requests.len().to_string(),
        percent(share_in_time(requests)),
        onsets.join(", "),
        count(&|one| one.response.is_none()).to_string(),
        count(&|one| one.answers > 1).to_string(),
        count(&|one| is_local(set_up, one)).to_string(),
        milliseconds(mean(&responses)),
        milliseconds(quantile(&responses, 0.5)),
        number(mean(&seen)),
        number(seen.iter().copied().reduce(f64::min)),
        number(mean(&own)),
        match set_up {
            FailoverSetUp::Stub | FailoverSetUp::Cold => trace.handovers.map(|one| one.to_string()).join(", "),
            FailoverSetUp::Cloud | FailoverSetUp::Local => "–".to_owned(),
        },
    ]);
}

/// Returns the fraction of requests answered within T_max.
fn share_in_time(requests: &[RequestSample]) -> Option<f64> {
    let late = requests.iter().filter(|request| is_late(request)).count();
    (!requests.is_empty()).then(|| 1.0 - late as f64 / requests.len() as f64)
}

fn is_local(set_up: FailoverSetUp, request: &RequestSample) -> bool {
    request.response.is_some() && (request.local || set_up == FailoverSetUp::Local)
}

fn whose_q(set_up: FailoverSetUp) -> &'static str {
    match set_up {
        FailoverSetUp::Local => " of these times",
        _ => " of the cloud's times, as the stub has it",
    }
}

fn measured_requests(runs: &FailoverRuns) -> impl Iterator<Item = (FailoverSetUp, &[RequestSample])> {
    runs.runs.iter().filter_map(|run| Some((run.set_up, &run.measured.value()?.0.requests[..])))
}

fn number_values(values: impl IntoIterator<Item = f64>) -> Vec<(f64, f64)> {
    let numbers = (1..).map(|number: u32| f64::from(number));
    numbers.zip(values).collect()
}

fn timeline_data(runs: &FailoverRuns, run: &FailoverRun) -> TimelineData {
    let requests = run.measured.value().map_or(&[][..], |done| &done.0.requests);
    let answered = requests.iter().filter_map(|request| request.response);
    // The time for which answers were awaited after the last request.
    let top = answered.fold(runs.course.stragglers, f64::max);
    let point = |(number, request): (u32, &RequestSample)| {
        let class = match (request.response, is_late(request)) {
            (None, _) => 3,
            (Some(_), true) => 2,
            (Some(_), false) => usize::from(is_local(run.set_up, request)),
        };
        (f64::from(number), request.response.unwrap_or(top), class)
    };
    let own = |(number, request): (u32, &RequestSample)| Some((f64::from(number), request.satisfaction?));
    TimelineData {
        points: (1..).zip(requests).map(point).collect(),
        classes: CLASSES.map(str::to_owned).to_vec(),
        bad: runs.course.bad.iter().map(|(first, last)| (*first as f64 - 0.5, *last as f64 + 0.5)).collect(),
        levels: vec![(TIMES.0, "T_desire".to_owned()), (TIMES.1, "T_max".to_owned())],
        q: match run.set_up {
            FailoverSetUp::Local => number_values(replay_satisfaction(requests)),
            _ => (1..).zip(requests).filter_map(own).collect(),
        },
    }
}

fn findings(runs: &FailoverRuns) -> Vec<String> {
    let of = |wanted: FailoverSetUp| measured_requests(runs).find(|(set_up, _)| *set_up == wanted);
    let mut findings = Vec::new();
    for (set_up, requests) in measured_requests(runs) {
        let lost = requests.iter().filter(|one| one.response.is_none()).count();
        findings.push(format!(
            "{}: {} of {} requests are answered within T_max, {lost} are never answered.",
            set_up.name(),
            percent(share_in_time(requests)),
            requests.len()
        ));
    }
    for run in &runs.runs {
        if run.measured.value().is_some_and(|(trace, _)| trace.late_before) {
            findings.push(format!(
                "{}: answers were late already before the first request that counts: the machine was busy, or the \
                 package is too slow for this rate.",
                run.set_up.name()
            ));
        }
    }
    if let (Some((_, stub)), Some((_, cloud))) = (of(FailoverSetUp::Stub), of(FailoverSetUp::Cloud)) {
        let both = share_in_time(stub).zip(share_in_time(cloud));
        if both.is_some_and(|(stub, cloud)| stub <= cloud) {
            findings.push(
                "The stub with a local original is in time no more often than the cloud alone: the local \
                original did not help, or the network was not bad enough."
                    .to_owned(),
            );
        }
    }
    if let (Some((_, stub)), Some((_, local))) = (of(FailoverSetUp::Stub), of(FailoverSetUp::Local)) {
        if let Some((stub, local)) = share_in_time(stub).zip(share_in_time(local)) {
            if stub < local {
                findings.push(lateness_reason(runs, of(FailoverSetUp::Stub), 100.0 * (local - stub)));
            }
        }
    }
    findings
}

/// Explains why more requests are late through the stub than on the robot, by `more` percentage points.
fn lateness_reason(runs: &FailoverRuns, stub: Option<(FailoverSetUp, &[RequestSample])>, more: f64) -> String {
    let requests = stub.map_or(&[][..], |(_, requests)| requests);
    let all = requests.iter().filter(|request| is_late(request)).count();
    let noticing: usize = count_late(&runs.course, requests).iter().sum();
    let others = if all > noticing {
        format!(
            " ({noticing} of {all}), and those that the original answers late because stub and original share {} of a \
             core",
            CLASS.cores
        )
    } else {
        format!(" (all {all})")
    };
    format!(
        "Compared with the original alone {more:.1} percentage points more of the requests are late, which is worse \
         than hoped: those by which the stub notices that the network is bad{others}."
    )
}

#[cfg(test)]
mod tests {
    use super::super::FaultSchedule;
    use super::*;
    use crate::cells::CachedResult;
    use crate::place::RunCost;
    use crate::words::assert_tells;

    fn test_run(set_up: FailoverSetUp, responses: &[Option<f64>], local: bool) -> FailoverRun {
        let one = |response: &Option<f64>| RequestSample {
            response: *response,
            local,
            answers: usize::from(response.is_some()),
            satisfaction: Some(8.0),
            ..RequestSample::default()
        };
        let trace = Trace { requests: responses.iter().map(one).collect(), ..Trace::default() };
        FailoverRun { set_up, measured: CachedResult::Done((trace, RunCost::default())) }
    }

    fn test_runs(runs: Vec<FailoverRun>) -> FailoverRuns {
        FailoverRuns { course: FaultSchedule { requests: 4, bad: vec![(2, 3)], stragglers: 1.0 }, runs }
    }

    #[test]
    fn the_table_counts_what_was_late_and_what_was_lost() {
        let runs = test_runs(vec![
            test_run(FailoverSetUp::Stub, &[Some(0.2), Some(0.9), Some(0.3), Some(0.2)], true),
            test_run(FailoverSetUp::Cloud, &[Some(0.2), None, None, Some(0.3)], false),
        ]);
        let section = section(&runs).expect("a section");
        let [published, stub, cloud] = &section.tables[0].rows[..] else {
            panic!("{:?}", section.tables[0].rows);
        };
        assert_eq!(published[1], "130");
        assert_eq!(stub[2..7], ["75.0 %", "1", "0", "0", "4"].map(str::to_owned));
        assert_eq!(cloud[2..7], ["50.0 %", "2", "2", "0", "0"].map(str::to_owned));
        assert_eq!(cloud[7], "250");
        // 15 + 2, at most 16; halved twice; plus 2: 16, 8, 4, 6.
        assert_eq!(cloud[9..12], ["8.50", "4.00", "8.00"].map(str::to_owned));
    }

    #[test]
    fn a_stub_that_did_not_help_is_told() {
        let same = [Some(0.2), None, Some(0.3), Some(0.2)];
        let mut all = vec![
            test_run(FailoverSetUp::Stub, &same, false),
            test_run(FailoverSetUp::Cloud, &same, false),
            test_run(FailoverSetUp::Local, &[Some(0.2); 4], false),
        ];
        if let CachedResult::Done((trace, _)) = &mut all[1].measured {
            trace.late_before = true;
        }
        let section = section(&test_runs(all)).expect("a section");
        let told = section.findings.join(" ");
        assert_tells(&told, "cloud alone: answers were late already");
        assert_tells(&told, "did not help");
        assert_tells(
            &told,
            "25.0 percentage points more of the requests are late, which is worse than hoped: those by \
                which the stub notices that the network is bad (all 1).",
        );
        assert!(section.missing.is_empty(), "{:?}", section.missing);
    }

    #[test]
    fn a_run_that_failed_is_missing() {
        let lost = FailoverRun {
            set_up: FailoverSetUp::Cloud,
            measured: CachedResult::Missing("no control groups".to_owned()),
        };
        let section = section(&test_runs(vec![lost])).expect("a section");
        assert!(section.missing[0].why.contains("no control groups"));
    }
}
