//! What the report says of a network that becomes bad.

use anyhow::Result;

use super::{CLASS, HERTZ, Q, Run, Runs, SetUp, TIMES, is_late, late, satisfaction};
use crate::cells::Measured;
use crate::place::Network;
use crate::plots::{self, Banded, Series};
use crate::recording::PICTURE;
use crate::section::{Missing, Section, Table};
use crate::statistics::{mean, quantile};
use crate::trace::Request;
use crate::words::{digits, known, milliseconds, percent};

/// Of points.
const CLASSES: [&str; 4] = [
    "answered by the cloud",
    "answered by the local original",
    "later than T_max",
    "never answered (at the top)",
];

/// What the report says.
pub fn section(runs: &Runs) -> Result<Section> {
    let mut section = Section::new(6, "failover", "A network that becomes bad and good again");
    section.published = "Fig. 7 of the publication: response times of 130 requests while the network is bad during requests 24-45, 75-96 and 111-122: the local original takes over within a few requests, and hands back. No mean and no share is published."
        .to_owned();
    section.differs = differs(runs);
    if runs.runs.len() < 3 {
        let left_out = "A quick evaluation has one bad time, and no run of the original alone: make eval ONLY=6 has the published course.";
        section.differs.push(left_out.to_owned());
    }
    let mut table = table();
    for run in &runs.runs {
        match &run.measured {
            Measured::Missing(why) => {
                section
                    .missing
                    .push(Missing::again(run.set_up.name(), why.clone()));
            }
            Measured::Done((trace, _)) => {
                if let Some(why) = &trace.node_ended {
                    let what = format!("{}: to its end", run.set_up.name());
                    section.missing.push(Missing::new(
                        what,
                        why.clone(),
                        "look at what the node printed",
                    ));
                }
                row(&mut table, runs, run.set_up, &trace.requests);
                let title = format!("object_detector, {}", run.set_up.name());
                section.drawing(
                    format!("failover-{}", run.set_up.name().replace([' ', ','], "-")),
                    format!(
                        "{}: response time of each request, and Q{}",
                        run.set_up.name(),
                        whose_q(run.set_up)
                    ),
                    plots::timeline(&title, "request", "response time (s)", &drawn(runs, run))?,
                );
            }
        }
    }
    section.tables.push(table);
    let seen: Vec<Series> = done(runs)
        .map(|(set_up, requests)| Series::new(set_up.name(), numbered(satisfaction(requests))))
        .collect();
    section.drawing(
        "failover-satisfaction",
        "Q of what the robot got, whoever answered first, in each set-up",
        plots::lines("Satisfaction of the robot", "request", "Q", &seen, false)?,
    );
    section.findings = findings(runs);
    Ok(section)
}

fn differs(runs: &Runs) -> Vec<String> {
    let bad: Vec<String> = runs
        .course
        .bad
        .iter()
        .map(|(from, to)| format!("{from}-{to}"))
        .collect();
    let alone = done(runs).find(|(set_up, _)| *set_up == SetUp::Local);
    let alone = alone.and_then(|(_, requests)| {
        quantile(
            &requests
                .iter()
                .filter_map(|one| one.response)
                .collect::<Vec<f64>>(),
            0.5,
        )
    });
    let alone = alone.map(|median| {
        format!(
            ", where alone it needs {} ms of the {} ms from request to request (median)",
            milliseconds(Some(median)),
            milliseconds(Some(1.0 / HERTZ))
        )
    });
    vec![
        format!(
            "object_detector stands in for SSD; it is asked {HERTZ} times a second, {} times, on a robot of the class {} ({} of a core){}.",
            runs.course.requests,
            CLASS.name(),
            CLASS.cores,
            alone.unwrap_or_default()
        ),
        format!(
            "The good network is the LAN ({}). That during requests {} is bad ({}): one picture of {} bytes, as it is without a codec, takes {} s there at that rate.",
            Network::Lan.told(),
            bad.join(", "),
            Network::Bad.told(),
            PICTURE,
            digits(Network::Bad.takes(PICTURE))
        ),
        format!(
            "T_desire is {} s, T_max {} s, Q begins at {}, Q_t is {}; Q stays below {} here, so that two late requests in a row always suffice (the published algorithm has no cap).",
            TIMES.0, TIMES.1, Q.0, Q.1, Q.2
        ),
    ]
}

fn table() -> Table {
    Table::new(
        "By set-up. Q of the robot counts first answers, whoever gave them; Q of the cloud is the stub's own, of the cloud's times",
        [
            "set-up",
            "requests",
            "within T_max",
            "late from each bad time's beginning on",
            "never answered",
            "answered more than once",
            "answered first by the local original",
            "mean response of those answered (ms)",
            "median of those answered (ms)",
            "mean Q of the robot",
            "least Q of the robot",
            "mean Q of the cloud",
        ],
    )
    .row([
        "published (Fig. 7)",
        "130",
        "–",
        "drawn only",
        "–",
        "–",
        "drawn only",
        "–",
        "–",
        "–",
        "–",
        "–",
    ])
}

fn row(table: &mut Table, runs: &Runs, set_up: SetUp, requests: &[Request]) {
    let responses: Vec<f64> = requests.iter().filter_map(|one| one.response).collect();
    let count = |is: &dyn Fn(&Request) -> bool| requests.iter().filter(|one| is(one)).count();
    let seen = satisfaction(requests);
    let own: Vec<f64> = requests.iter().filter_map(|one| one.satisfaction).collect();
    let number = |value: Option<f64>| known(value, digits);
    let onsets: Vec<String> = late(&runs.course, requests)
        .iter()
        .map(usize::to_string)
        .collect();
    table.push([
        set_up.name().to_owned(),
        requests.len().to_string(),
        percent(within(requests)),
        onsets.join(", "),
        count(&|one| one.response.is_none()).to_string(),
        count(&|one| one.answers > 1).to_string(),
        count(&|one| is_local(set_up, one)).to_string(),
        milliseconds(mean(&responses)),
        milliseconds(quantile(&responses, 0.5)),
        number(mean(&seen)),
        number(seen.iter().copied().reduce(f64::min)),
        number(mean(&own)),
    ]);
}

/// The share that is answered within T_max.
fn within(requests: &[Request]) -> Option<f64> {
    let late = requests.iter().filter(|request| is_late(request)).count();
    (!requests.is_empty()).then(|| 1.0 - late as f64 / requests.len() as f64)
}

fn is_local(set_up: SetUp, request: &Request) -> bool {
    request.response.is_some() && (request.local || set_up == SetUp::Local)
}

fn whose_q(set_up: SetUp) -> &'static str {
    match set_up {
        SetUp::Local => " of these times",
        _ => " of the cloud's times, as the stub has it",
    }
}

fn done(runs: &Runs) -> impl Iterator<Item = (SetUp, &[Request])> {
    runs.runs
        .iter()
        .filter_map(|run| Some((run.set_up, &run.measured.done()?.0.requests[..])))
}

fn numbered(values: impl IntoIterator<Item = f64>) -> Vec<(f64, f64)> {
    let numbers = (1..).map(|number: u32| f64::from(number));
    numbers.zip(values).collect()
}

fn drawn(runs: &Runs, run: &Run) -> Banded {
    let requests = run.measured.done().map_or(&[][..], |done| &done.0.requests);
    let answered = requests.iter().filter_map(|request| request.response);
    // As long as answers were waited for after the last request.
    let top = answered.fold(runs.course.stragglers, f64::max);
    let point = |(number, request): (u32, &Request)| {
        let class = match (request.response, is_late(request)) {
            (None, _) => 3,
            (Some(_), true) => 2,
            (Some(_), false) => usize::from(is_local(run.set_up, request)),
        };
        (f64::from(number), request.response.unwrap_or(top), class)
    };
    let own = |(number, request): (u32, &Request)| Some((f64::from(number), request.satisfaction?));
    Banded {
        points: (1..).zip(requests).map(point).collect(),
        classes: CLASSES.map(str::to_owned).to_vec(),
        bad: runs
            .course
            .bad
            .iter()
            .map(|(first, last)| (*first as f64 - 0.5, *last as f64 + 0.5))
            .collect(),
        levels: vec![
            (TIMES.0, "T_desire".to_owned()),
            (TIMES.1, "T_max".to_owned()),
        ],
        q: match run.set_up {
            SetUp::Local => numbered(satisfaction(requests)),
            _ => (1..).zip(requests).filter_map(own).collect(),
        },
    }
}

fn findings(runs: &Runs) -> Vec<String> {
    let of = |wanted: SetUp| done(runs).find(|(set_up, _)| *set_up == wanted);
    let mut findings = Vec::new();
    for (set_up, requests) in done(runs) {
        let lost = requests.iter().filter(|one| one.response.is_none()).count();
        findings.push(format!(
            "{}: {} of {} requests are answered within T_max, {lost} are never answered.",
            set_up.name(),
            percent(within(requests)),
            requests.len()
        ));
    }
    for run in &runs.runs {
        if run
            .measured
            .done()
            .is_some_and(|(trace, _)| trace.late_before)
        {
            findings.push(format!(
                "{}: answers were late already before the first request that counts: the machine was busy, or the package is too slow for this rate.",
                run.set_up.name()
            ));
        }
    }
    if let (Some((_, stub)), Some((_, cloud))) = (of(SetUp::Stub), of(SetUp::Cloud)) {
        let both = within(stub).zip(within(cloud));
        if both.is_some_and(|(stub, cloud)| stub <= cloud) {
            findings.push("The stub with a local original is in time no more often than the cloud alone: the local original did not help, or the network was not bad enough.".to_owned());
        }
    }
    if let (Some((_, stub)), Some((_, local))) = (of(SetUp::Stub), of(SetUp::Local)) {
        if let Some((stub, local)) = within(stub).zip(within(local)) {
            if stub < local {
                findings.push(later(runs, of(SetUp::Stub), 100.0 * (local - stub)));
            }
        }
    }
    findings
}

/// Why more requests are late through the stub than on the robot, by so many percentage points.
fn later(runs: &Runs, stub: Option<(SetUp, &[Request])>, more: f64) -> String {
    let requests = stub.map_or(&[][..], |(_, requests)| requests);
    let all = requests.iter().filter(|request| is_late(request)).count();
    let noticing: usize = late(&runs.course, requests).iter().sum();
    let others = if all > noticing {
        format!(
            " ({noticing} of {all}), and those that the original answers late because stub and original share {} of a core",
            CLASS.cores
        )
    } else {
        format!(" (all {all})")
    };
    format!(
        "Compared with the original alone {more:.1} percentage points more of the requests are late, which is worse than hoped: those by which the stub notices that the network is bad{others}."
    )
}

#[cfg(test)]
mod tests {
    use super::super::Course;
    use super::*;
    use crate::place::Cost;
    use crate::trace::Trace;

    fn run(set_up: SetUp, responses: &[Option<f64>], local: bool) -> Run {
        let one = |response: &Option<f64>| Request {
            response: *response,
            local,
            answers: usize::from(response.is_some()),
            satisfaction: Some(8.0),
            ..Request::default()
        };
        let trace = Trace {
            requests: responses.iter().map(one).collect(),
            ..Trace::default()
        };
        Run {
            set_up,
            measured: Measured::Done((trace, Cost::default())),
        }
    }

    fn runs(runs: Vec<Run>) -> Runs {
        Runs {
            course: Course {
                requests: 4,
                bad: vec![(2, 3)],
                stragglers: 1.0,
            },
            runs,
        }
    }

    #[test]
    fn the_table_counts_what_was_late_and_what_was_lost() {
        let runs = runs(vec![
            run(
                SetUp::Stub,
                &[Some(0.2), Some(0.9), Some(0.3), Some(0.2)],
                true,
            ),
            run(SetUp::Cloud, &[Some(0.2), None, None, Some(0.3)], false),
        ]);
        let section = section(&runs).expect("a section");
        let [published, stub, cloud] = &section.tables[0].rows[..] else {
            panic!("{:?}", section.tables[0].rows);
        };
        assert_eq!(published[1], "130");
        assert_eq!(
            stub[2..7],
            ["75.0 %", "1", "0", "0", "4"].map(str::to_owned)
        );
        assert_eq!(
            cloud[2..7],
            ["50.0 %", "2", "2", "0", "0"].map(str::to_owned)
        );
        assert_eq!(cloud[7], "250");
        // 15 + 2, below 16; halved twice; 2 more: 16, 8, 4, 6.
        assert_eq!(cloud[9..12], ["8.50", "4.00", "8.00"].map(str::to_owned));
    }

    #[test]
    fn a_stub_that_did_not_help_is_told() {
        let same = [Some(0.2), None, Some(0.3), Some(0.2)];
        let mut all = vec![
            run(SetUp::Stub, &same, false),
            run(SetUp::Cloud, &same, false),
            run(SetUp::Local, &[Some(0.2); 4], false),
        ];
        if let Measured::Done((trace, _)) = &mut all[1].measured {
            trace.late_before = true;
        }
        let section = section(&runs(all)).expect("a section");
        let told = section.findings.join(" ");
        assert!(
            told.contains("cloud alone: answers were late already"),
            "{told}"
        );
        assert!(told.contains("did not help"), "{told}");
        assert!(
            told.contains("25.0 percentage points more of the requests are late, which is worse than hoped: those by which the stub notices that the network is bad (all 1)."),
            "{told}"
        );
        assert!(section.missing.is_empty(), "{:?}", section.missing);
    }

    #[test]
    fn a_run_that_failed_is_missing() {
        let lost = Run {
            set_up: SetUp::Cloud,
            measured: Measured::Missing("no control groups".to_owned()),
        };
        let section = section(&runs(vec![lost])).expect("a section");
        assert!(section.missing[0].why.contains("no control groups"));
    }
}
