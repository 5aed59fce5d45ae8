//! Experiments 2, 4 and 5: packages on two kinds of robots, there and in the cloud: response times, their parts, and how much they differ
//! from request to request.

use anyhow::Result;
use serde::{Deserialize, Serialize};

use crate::cells::{Cells, Measured};
use crate::examples::{ALL, Example, LASER_SLAM, Where, Workshop};
use crate::place::{Class, Cost, Network, Place};
use crate::plots::{self, Bar, Series};
use crate::section::{Missing, Section, Table};
use crate::statistics::{mean, quantile, standard_deviation};
use crate::trace::{Phases, Trace};
use crate::words::{known, milliseconds, ratio};

/// Where one package ran.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum SetUp {
    /// On the robot.
    Native,
    /// In the cloud, behind this network.
    Behind(Network),
}

impl SetUp {
    /// As tables name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Native => "native",
            Self::Behind(network) => network.name(),
        }
    }
}

/// The set-ups of the published figure.
pub const SET_UPS: [SetUp; 3] = [
    SetUp::Native,
    SetUp::Behind(Network::Lan),
    SetUp::Behind(Network::Wan),
];

/// The largest factor in the publication's Fig. 5.
const PUBLISHED: u32 = 25;

/// One package on one robot in one set-up.
pub struct Run {
    /// The package.
    pub example: Example,
    /// The robot.
    pub class: Class,
    /// Where it answered.
    pub set_up: SetUp,
    /// What came out.
    pub measured: Measured<(Trace, Cost)>,
}

/// Measures all; so many requests each, or as many as the example says.
pub fn measure(cells: &Cells, workshop: &Workshop, most: Option<usize>) -> Result<Vec<Run>> {
    let mut runs = Vec::new();
    for example in ALL {
        for class in [Class::PI, Class::ULTRABOOK] {
            for set_up in SET_UPS {
                let name = format!("{} {} {}", example.name, class.name(), set_up.name());
                let most = most.unwrap_or(example.requests).min(example.requests);
                let measured = cells.measure(&name, &(class, set_up, most), || {
                    one(workshop, &example, class, set_up, most)
                })?;
                runs.push(Run {
                    example,
                    class,
                    set_up,
                    measured,
                });
            }
        }
    }
    Ok(runs)
}

fn one(
    workshop: &Workshop,
    example: &Example,
    class: Class,
    set_up: SetUp,
    most: usize,
) -> Result<(Trace, Cost)> {
    workshop.publishes(example)?;
    let (at, network) = match set_up {
        SetUp::Native => (Where::Native, Network::Lan),
        SetUp::Behind(network) => (Where::Outsourced, network),
    };
    let directory = workshop.directory()?;
    let mut plan = workshop.plan(example, at, directory.path())?;
    plan.most = most;
    let place = Place::new(&workshop.daemon.address, class, network)?;
    place.runs(&plan, directory.path())
}

/// What was measured of one package, robot and set-up.
fn find<'a>(
    runs: &'a [Run],
    example: &str,
    class: Class,
    set_up: SetUp,
) -> Option<&'a (Trace, Cost)> {
    let wanted =
        |run: &&Run| run.example.name == example && run.class == class && run.set_up == set_up;
    runs.iter().find(wanted)?.measured.done()
}

/// Experiment 2.
pub fn response_times(runs: &[Run]) -> Result<Section> {
    let mut section = Section::new(
        2,
        "outsourcing",
        "Native and outsourced, on two kinds of robots",
    );
    section.published = "Fig. 5 of the publication: response times per request and accumulated times of RGBD-SLAM, RTAB-Map and SSD on a \
        Raspberry Pi and on an ultrabook, native and outsourced: outsourced they were up to 25 times as fast."
        .to_owned();
    section.differs = differs();
    let network = runs
        .iter()
        .find_map(|run| Some(&run.measured.done()?.1.network));
    section
        .differs
        .extend(network.map(|network| format!("Packets are delayed by {network}.")));
    let mut table = Table::new(
        "Response times, from publishing a request to its answer (milliseconds), one request after the other",
        [
            "package",
            "robot",
            "where",
            "requests",
            "answered",
            "median",
            "95 %",
            "accumulated (s)",
            "times as fast, by medians",
            "times as fast, by means",
            "published",
            "robot's CPU, whole run (s)",
            "bytes a request, both ways",
        ],
    );
    for run in runs {
        let Some((trace, cost)) = run.measured.done() else {
            continue;
        };
        let responses = trace.responses();
        let native = find(runs, run.example.name, run.class, SetUp::Native);
        let native = native.map(|(trace, _)| trace.responses());
        let median = quantile(&responses, 0.5);
        let times =
            |of: &dyn Fn(&[f64]) -> Option<f64>| Some(of(native.as_ref()?)? / of(&responses)?);
        let faster = times(&|all| quantile(all, 0.5));
        table.push([
            run.example.name.to_owned(),
            run.class.name().to_owned(),
            run.set_up.name().to_owned(),
            trace.requests.len().to_string(),
            trace.answered().to_string(),
            milliseconds(median),
            milliseconds(quantile(&responses, 0.95)),
            format!("{:.1}", responses.iter().sum::<f64>()),
            ratio(faster),
            ratio(times(&|all| mean(all))),
            published(run.set_up),
            format!("{:.1}", cost.robot_cpu),
            known(trace.carried_each(1), |ways| {
                format!("{:.0}", ways[0] + ways[1])
            }),
        ]);
        if let (Some(faster), SetUp::Behind(network)) = (faster, run.set_up) {
            section.findings.push(finding(run, network, faster));
        }
        let lost = trace.requests.len() - trace.answered();
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
    for example in ALL {
        let series = |of: fn(&Trace) -> Vec<(f64, f64)>| -> Vec<Series> {
            let done = runs.iter().filter(|run| run.example.name == example.name);
            let one = |run: &Run| {
                Some(Series {
                    name: format!("{}, {}", run.class.name(), run.set_up.name()),
                    points: of(&run.measured.done()?.0),
                })
            };
            done.filter_map(one).collect()
        };
        let title = format!("{} (stands for {})", example.name, example.stands_for);
        section.drawing(
            format!("outsourcing-{}", example.name),
            format!("{title}: response time of each request"),
            plots::lines(&title, "request", "response time (s)", &series(each), true)?,
        );
        section.drawing(
            format!("outsourcing-{}-accumulated", example.name),
            format!("{title}: accumulated response times"),
            plots::lines(
                &title,
                "request",
                "accumulated response times (s)",
                &series(accumulated),
                false,
            )?,
        );
    }
    missing(&mut section, runs);
    Ok(section)
}

/// How many times as fast as on the robot the publication's packages were (Fig. 5), of which its largest number is known to us.
fn published(set_up: SetUp) -> String {
    match set_up {
        SetUp::Native => "1".to_owned(),
        SetUp::Behind(_) => format!("up to {PUBLISHED}"),
    }
}

fn differs() -> Vec<String> {
    [
        "The published packages are not packaged for this system: laser_slam (scan matching), graph_slam (a graph of poses, whose steps take longer as it grows) and object_detector (a neural network) stand in; the SLAM packages work on a recorded drive of MRPT.",
        "A Raspberry Pi is a quarter of a core of this machine and 1 GiB, an ultrabook half a core and 4 GiB; the cloud has one core for each servant. With that few cores no factor of 25 can come about: one core is four times a quarter.",
        &format!(
            "Networks are delays, rates and losses between two namespaces of this machine (LAN: {}; WAN: {}).",
            Network::Lan.told(),
            Network::Wan.told()
        ),
        "The model of cores beside this predicts means, because only means follow a limit of a fraction of a core: the column by means is to be compared with it.",
    ]
    .map(str::to_owned)
    .to_vec()
}

fn finding(run: &Run, network: Network, faster: f64) -> String {
    let (name, class, network) = (run.example.name, run.class.name(), network.name());
    if faster >= 1.0 {
        return format!(
            "{name} answers {faster:.1} times as fast outsourced by {network} as on a robot of the class {class}."
        );
    }
    format!(
        "{name} answers more slowly outsourced by {network} than on a robot of the class {class} ({faster:.2} times as fast): the way to the cloud and back takes longer than what its processor saves."
    )
}

fn each(trace: &Trace) -> Vec<(f64, f64)> {
    let known = (1..).zip(&trace.requests);
    let point =
        |(number, one): (u32, &crate::trace::Request)| Some((f64::from(number), one.response?));
    known.filter_map(point).collect()
}

fn accumulated(trace: &Trace) -> Vec<(f64, f64)> {
    let mut sum = 0.0;
    let add = |(number, response)| {
        sum += response;
        (number, sum)
    };
    each(trace).into_iter().map(add).collect()
}

/// Experiment 4.
pub fn phases(runs: &[Run]) -> Result<Section> {
    let mut section = Section::new(4, "phases", "Where the time of one frame goes");
    section.published = "Table II of the publication: SLAMBench's phases (acquisition, computation, rendering) of KinectFusion, native and outsourced.".to_owned();
    section.differs = vec![
        "The phases are those of laser_slam, as it tells them itself; what is left of the response time is transport: serialization, the network, the portal and waiting.".to_owned(),
    ];
    let mut table = Table::new(
        "Mean of all frames, milliseconds",
        [
            "robot",
            "where",
            "acquisition",
            "computation",
            "rendering",
            "transport and waiting",
            "response time",
        ],
    );
    let mut bars = Vec::new();
    for run in runs
        .iter()
        .filter(|run| run.example.name == LASER_SLAM.name)
    {
        let Some((trace, _)) = run.measured.done() else {
            continue;
        };
        // Of the same requests all: one whose parts are not known counts in none of the means.
        let both = trace.requests.iter();
        let both = both.filter_map(|one| Some((one.response?, one.phases?)));
        let (responses, told): (Vec<f64>, Vec<Phases>) = both.unzip();
        if told.is_empty() {
            section.missing.push(Missing {
                what: format!("phases, {}, {}", run.class.name(), run.set_up.name()),
                why: "the node told none".to_owned(),
                next: "look at its topic laser_slam/timing".to_owned(),
            });
            continue;
        }
        let of = |part: fn(&Phases) -> f64| mean(&told.iter().map(part).collect::<Vec<f64>>());
        let parts = [
            of(|one| one.acquisition),
            of(|one| one.computation),
            of(|one| one.rendering),
        ];
        let own: f64 = parts.iter().flatten().sum();
        let whole = mean(&responses);
        let rest = whole.map(|whole| whole - own);
        let group = format!("{}, {}", run.class.name(), run.set_up.name());
        let shares = [parts[1], rest].map(|part| Some(100.0 * part? / whole?));
        if let [Some(computation), Some(transport)] = shares {
            section.findings.push(format!(
                "{group}: computation is {computation:.0} % of the response time, transport and waiting {transport:.0} %."
            ));
        }
        for (name, part) in ["acquisition", "computation", "rendering", "transport"]
            .into_iter()
            .zip(parts.into_iter().chain([rest]))
        {
            bars.push(Bar {
                group: group.clone(),
                name: name.to_owned(),
                value: part.unwrap_or(f64::NAN) * 1e3,
                spread: None,
            });
        }
        let cells = parts.into_iter().chain([rest, whole]).map(milliseconds);
        table.push(
            [run.class.name().to_owned(), run.set_up.name().to_owned()]
                .into_iter()
                .chain(cells),
        );
    }
    section.tables.push(table);
    section.drawing(
        "phases",
        "Parts of one frame's response time",
        plots::bars("laser_slam", "time (ms)", &bars, false)?,
    );
    missing(
        &mut section,
        &runs
            .iter()
            .filter(|run| run.example.name == LASER_SLAM.name)
            .collect::<Vec<_>>(),
    );
    Ok(section)
}

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

/// Names what was not measured.
fn missing<R: std::borrow::Borrow<Run>>(section: &mut Section, runs: &[R]) {
    for run in runs.iter().map(std::borrow::Borrow::borrow) {
        let what = format!(
            "{}, {}, {}",
            run.example.name,
            run.class.name(),
            run.set_up.name()
        );
        match &run.measured {
            Measured::Missing(why) => section.missing.push(Missing::again(what, why)),
            Measured::Done((trace, _)) => {
                if let Some(why) = &trace.node_ended {
                    section.missing.push(Missing {
                        what: format!("{what}: after request {}", trace.requests.len()),
                        why: why.clone(),
                        next: "look at what the node printed".to_owned(),
                    });
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::Request;

    fn run(set_up: SetUp, responses: &[f64]) -> Run {
        let request = |response: &f64| Request {
            response: Some(*response),
            phases: Some(Phases {
                acquisition: response * 0.1,
                computation: response * 0.5,
                rendering: response * 0.2,
            }),
            ..Request::default()
        };
        let trace = Trace {
            requests: responses.iter().map(request).collect(),
            ..Trace::default()
        };
        Run {
            example: LASER_SLAM,
            class: Class::PI,
            set_up,
            measured: Measured::Done((trace, Cost::default())),
        }
    }

    #[test]
    fn how_much_faster_is_by_the_medians() {
        let runs = [
            run(SetUp::Native, &[0.3, 0.4, 0.5]),
            run(SetUp::Behind(Network::Lan), &[0.1, 0.1, 0.9]),
            run(SetUp::Behind(Network::Wan), &[0.8, 0.8, 0.8]),
        ];
        let section = response_times(&runs).expect("a section");
        let faster: Vec<&str> = section.tables[0]
            .rows
            .iter()
            .map(|row| row[8].as_str())
            .collect();
        assert_eq!(faster, ["1.0", "4.0", "0.50"]);
        assert_eq!(section.tables[0].rows[1][9], "1.1");
        assert_eq!(section.tables[0].rows[1][10], "up to 25");
        assert!(
            section.findings[0].contains("4.0 times as fast"),
            "{:?}",
            section.findings
        );
        assert!(
            section.findings[1].contains("more slowly"),
            "{:?}",
            section.findings
        );
    }

    #[test]
    fn what_phases_do_not_tell_is_transport() {
        let section = phases(&[run(SetUp::Native, &[1.0, 1.0])]).expect("a section");
        assert_eq!(
            section.tables[0].rows[0][2..],
            ["100", "500", "200", "200", "1000"].map(str::to_owned)
        );
    }

    #[test]
    fn accumulated_times_are_sums() {
        let Run { measured, .. } = run(SetUp::Native, &[1.0, 2.0, 3.0]);
        let sums = accumulated(&measured.done().expect("it is").0);
        assert_eq!(sums, [(1.0, 1.0), (2.0, 3.0), (3.0, 6.0)]);
    }

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

    #[test]
    fn what_was_not_measured_is_named() {
        let lost = Run {
            measured: Measured::Missing("the robot's place was ended by signal 9".to_owned()),
            ..run(SetUp::Native, &[])
        };
        let section = jitter(&[lost]).expect("a section");
        assert!(section.missing[0].why.contains("signal 9"));
        assert!(section.missing[0].what.contains("laser_slam"));
    }
}
