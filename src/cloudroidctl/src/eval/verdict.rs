//! What an evaluation found: both sides with their phases, which is faster, and the SLA that follows.

use std::path::Path;

use api::calibration::{TimeSpread, rounded_up};
use api::dictionary::{Row, Spread};
use api::{Calibration, Size};
use serde::Serialize;

use super::network::Network;
use super::point;
use super::probe::Asked;
use super::robot::Robot;
use crate::calibrate::rows;
use crate::output::{self, Table};
use crate::trial::renamed;

/// Less than so many times as fast may be chance.
const WORTH: f64 = 1.1;
/// Such a share of the recording's pace is to be kept, and of the requests to be answered.
const ENOUGH: f64 = 0.95;
/// Fewer answers say nothing of a 95th percentile.
const FEWEST: usize = 10;
/// T_max over T_desire, as `cloudroidctl try` suggests it.
const PATIENCE: f64 = 2.0;

/// All that was found. Times are in milliseconds but for those of the SLA.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Evaluation {
    /// The service.
    pub service: String,
    /// The revision that was measured.
    pub revision: u64,
    /// The recording.
    pub bag: String,
    /// What the robot has.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot: Option<Robot>,
    /// Requests a second of the recording; none where each followed the answer before it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pace: Option<f64>,
    /// What was published to it.
    pub inputs: Vec<api::trial::Fed>,
    /// Topics of the recording that it has no input for.
    pub unused: Vec<String>,
    /// On the robot.
    pub native: Side,
    /// In the cloud.
    pub outsourced: Side,
    /// The network that was added.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub network: Option<Network>,
    /// So many times as fast is a request outsourced (medians).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub times_as_fast: Option<f64>,
    /// The same in words.
    pub verdict: String,
    /// What the robot may count on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sla: Option<Suggested>,
}

/// One side.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Side {
    /// Cores that it had.
    pub cpus: f64,
    /// Memory that it was limited to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_limit: Option<Size>,
    /// Why the kernel has ended it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub out_of_memory: Option<String>,
    /// Requests.
    pub requests: usize,
    /// Of them were answered.
    pub answered: usize,
    /// Response times, as the robot would see them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rrt: Option<TimeSpread>,
    /// The medians' parts.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub phases: Option<Phases>,
    /// Requests a second that were made, as far as that is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate: Option<f64>,
    /// The most memory that was in use.
    pub memory: Size,
    /// Size of the largest request, and of the largest answer where it was heard from here.
    pub bytes: (usize, usize),
    /// Of each answered request.
    pub times: Vec<f64>,
}

/// Parts of a request's time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Phases {
    /// Up by the added network.
    pub up: f64,
    /// Between here and the servant's node, both ways: what is over of the median when that of the node is taken away.
    pub transport: f64,
    /// Down by the added network.
    pub down: f64,
    /// From the request's arrival at the node to its answer (median).
    pub compute: f64,
    /// Of it processor time, on average, summed over cores.
    pub running: f64,
    /// Of it held up by the limit of cores, on average, summed over the threads' cores.
    pub held_up: f64,
}

/// A suggested SLA.
#[derive(Debug, Clone, Serialize)]
pub struct Suggested {
    /// T_desire, in seconds.
    pub desire: f64,
    /// T_max, in seconds.
    pub max: f64,
    /// Whether the robot has a local original to fall back to.
    pub has_local: bool,
    /// For the dictionary of the service.
    pub row: Row,
    /// Why these.
    pub reason: String,
}

impl Side {
    /// With as much as the robot has. Its requests cross no network.
    pub fn native(calibration: &Calibration, times: Vec<f64>, robot: &Robot) -> Side {
        let point = point(calibration);
        Side {
            cpus: point.cpus,
            memory_limit: Some(robot.memory),
            out_of_memory: None,
            requests: point.requests,
            answered: point.answered,
            rrt: point.compute,
            phases: point.compute.map(|compute| Phases {
                compute: compute.p50,
                running: point.running,
                held_up: point.throttled,
                ..Phases::default()
            }),
            rate: Some(point.rate),
            memory: point.memory,
            bytes: (calibration.largest.0 as usize, 0),
            times,
        }
    }

    /// It did not get along with the robot's memory.
    pub fn starved(robot: &Robot, why: String) -> Side {
        Side {
            cpus: robot.cpus,
            memory_limit: Some(robot.memory),
            out_of_memory: Some(why),
            ..Side::default()
        }
    }

    /// As it was heard over the network, with what `network` adds.
    pub fn outsourced(calibration: &Calibration, asked: &Asked, network: Option<Network>) -> Side {
        let point = point(calibration);
        let (up, down) = network.map_or((0.0, 0.0), |network| {
            (
                network.one_way(asked.request),
                network.one_way(asked.answer),
            )
        });
        let heard: Vec<f64> = asked.times.iter().flatten().copied().collect();
        let seen = TimeSpread::of(heard.clone());
        let times: Vec<f64> = heard.iter().map(|time| time + up + down).collect();
        let phases = seen.zip(point.compute).map(|(seen, compute)| Phases {
            up,
            // Two runs: their medians may differ by chance.
            transport: (seen.p50 - compute.p50).max(0.0),
            down,
            compute: compute.p50.min(seen.p50),
            running: point.running,
            held_up: point.throttled,
        });
        Side {
            cpus: point.cpus,
            memory_limit: None,
            out_of_memory: None,
            requests: asked.times.len(),
            answered: times.len(),
            rrt: TimeSpread::of(times.clone()),
            phases,
            rate: Some(point.rate),
            memory: point.memory,
            bytes: (asked.request, asked.answer),
            times,
        }
    }

    fn answers_enough(&self) -> bool {
        self.answered >= FEWEST && self.answered as f64 >= self.requests as f64 * ENOUGH
    }

    /// Whether it keeps the recording's pace, one request after the other.
    fn keeps(&self, pace: Option<f64>) -> bool {
        pace.is_none_or(|pace| {
            let possible = self.rrt.map_or(0.0, |rrt| 1000.0 / rrt.p50);
            possible >= pace * ENOUGH
        })
    }
}

impl Evaluation {
    /// Of both sides; `measured` is the outsourced one as the daemon saw it.
    pub fn new(
        measured: &Calibration,
        bag: String,
        robot: Robot,
        (native, outsourced): (Side, Side),
        network: Option<Network>,
    ) -> Evaluation {
        let medians = outsourced.rrt.zip(native.rrt);
        let mut evaluation = Evaluation {
            service: measured.service.clone(),
            revision: measured.revision,
            bag,
            robot: Some(robot),
            pace: measured.pace,
            inputs: measured.inputs.clone(),
            unused: measured.unused.clone(),
            times_as_fast: medians.map(|(outsourced, native)| native.p50 / outsourced.p50),
            native,
            outsourced,
            network,
            ..Evaluation::default()
        };
        evaluation.verdict = evaluation.in_words();
        evaluation.sla = evaluation.suggested(measured.rows.last());
        evaluation
    }

    fn in_words(&self) -> String {
        let (native, outsourced) = (&self.native, &self.outsourced);
        let Some(there) = outsourced.rrt else {
            return format!(
                "outsourced, none of {} requests was answered within 10 s: look whether an input is missing in the recording, or a \
                 parameter; nothing can be said",
                outsourced.requests
            );
        };
        let outsourced_takes = format!("outsourced, a request takes {:.1} ms (median)", there.p50);
        let worth = if let Some(why) = &native.out_of_memory {
            format!("only outsourced: {why}; {outsourced_takes}")
        } else if let Some((here, factor)) = native.rrt.zip(self.times_as_fast) {
            let both = format!(
                "{:.1} ms instead of {:.1} ms (medians)",
                there.p50, here.p50
            );
            if factor >= WORTH {
                format!("worth it: outsourced, it answers {factor:.1} times as fast, {both}")
            } else if factor > 1.0 / WORTH {
                format!(
                    "no difference in time: {both}; outsourcing spares the robot its cores alone"
                )
            } else {
                format!(
                    "not worth it for its time: outsourced, it takes {:.1} times as long, {both}",
                    1.0 / factor
                )
            }
        } else {
            format!(
                "only outsourced: on the robot none of {} requests was answered within 10 s; {outsourced_takes}",
                native.requests
            )
        };
        match self.pace {
            Some(pace) if native.rrt.is_some() && !native.keeps(Some(pace)) => format!(
                "{worth}; the recording asks {pace:.1} times a second, which {}",
                match outsourced.keeps(Some(pace)) {
                    true => "only the outsourced one keeps up with",
                    false => "neither keeps up with",
                }
            ),
            _ => worth,
        }
    }

    /// What follows from the outsourced times: the row that the daemon proposes for its limits, with the time that was seen from here.
    fn suggested(&self, proposed: Option<&Row>) -> Option<Suggested> {
        let (row, rrt) = proposed.zip(self.outsourced.rrt)?;
        if !self.outsourced.answers_enough() || !self.outsourced.keeps(self.pace) {
            return None;
        }
        let desire = rounded_up(rrt.p95) / 1000.0;
        let max = rounded_up(desire * PATIENCE * 1000.0) / 1000.0;
        let row = Row {
            value: desire,
            spread: Some(Spread {
                p50: rrt.p50 / 1000.0,
                p95: rrt.p95 / 1000.0,
                requests: self.outsourced.answered as u64,
            }),
            ..row.clone()
        };
        Some(Suggested {
            desire,
            max,
            has_local: self.native.out_of_memory.is_none(),
            reason: format!(
                "desire is what 95 % of {} outsourced requests took ({:.1} ms), rounded up; max is twice that",
                self.outsourced.answered, rrt.p95
            ),
            row,
        })
    }
}

impl Suggested {
    /// Lines of `stub.toml`.
    fn stub_toml(&self) -> Vec<String> {
        let mut lines = vec![
            format!("desire = {}", self.desire),
            format!("max = {}", self.max),
        ];
        if !self.has_local {
            lines.push("local = \"none\"    # the robot has no memory for it".to_owned());
        }
        lines
    }
}

/// Shows it.
pub fn print(of: &Evaluation, plot: &Path) -> anyhow::Result<()> {
    output::line("")?;
    response_times(of)?;
    output::line("")?;
    phases(of)?;
    if let Some(network) = of.network {
        output::line(&format!(
            "UP and DOWN are a network of {network}, which was not there: it is added"
        ))?;
    }
    for words in renamed(&of.inputs) {
        output::line(&words)?;
    }
    if !of.unused.is_empty() {
        output::line(&format!("not used: {}", of.unused.join(", ")))?;
    }
    output::line(&format!(
        "native has been measured on cores of this server; a robot's own cores are slower, if they are other ones\nplot: {}\n",
        plot.display()
    ))?;
    output::line(&of.verdict)?;
    let Some(sla) = &of.sla else {
        return output::line(
            "no SLA is suggested: outsourced, too few requests were answered, or not at the recording's pace",
        );
    };
    output::line(&format!("\nin stub.toml ({}):", sla.reason))?;
    for line in sla.stub_toml() {
        output::line(&format!("    {line}"))?;
    }
    output::line("")?;
    rows(std::slice::from_ref(&sla.row))
}

fn sides(of: &Evaluation) -> [(&'static str, &Side); 2] {
    [("native", &of.native), ("outsourced", &of.outsourced)]
}

fn response_times(of: &Evaluation) -> anyhow::Result<()> {
    let mut table = Table::new(&[
        "", "CPUS", "MEMORY", "USED", "ANSWERED", "P50 MS", "P95 MS", "MAX MS",
    ]);
    for (name, side) in sides(of) {
        let time = |of: fn(&TimeSpread) -> f64| {
            let shown = side.rrt.as_ref().map(|rrt| format!("{:.1}", of(rrt)));
            shown.unwrap_or_else(|| "-".to_owned())
        };
        let answered = match side.out_of_memory {
            Some(_) => "out of memory".to_owned(),
            None => format!("{} of {}", side.answered, side.requests),
        };
        let limit = side.memory_limit.map(|limit| limit.to_string());
        table.row([
            name.to_owned(),
            side.cpus.to_string(),
            limit.unwrap_or_else(|| "as pushed".to_owned()),
            match side.memory {
                Size(0) => "-".to_owned(),
                used => used.to_string(),
            },
            answered,
            time(|rrt| rrt.p50),
            time(|rrt| rrt.p95),
            time(|rrt| rrt.max),
        ]);
    }
    table.print()
}

fn phases(of: &Evaluation) -> anyhow::Result<()> {
    let mut table = Table::new(&[
        "",
        "UP",
        "TRANSPORT",
        "DOWN",
        "COMPUTE",
        "RUNNING",
        "HELD UP",
    ]);
    for (name, side) in sides(of) {
        let cells = side.phases.map(|phases| {
            [
                phases.up,
                phases.transport,
                phases.down,
                phases.compute,
                phases.running,
                phases.held_up,
            ]
            .map(|time| format!("{time:.1}"))
        });
        let cells = cells.unwrap_or_else(|| std::array::from_fn(|_| "-".to_owned()));
        table.row(std::iter::once(name.to_owned()).chain(cells));
    }
    table.print()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use api::calibration::Point;
    use api::{Limits, Measure};

    use super::*;
    use crate::eval::robot::Class;

    fn robot() -> Robot {
        Robot::new(Class::Pi, None, None)
    }

    /// Twenty requests that took so long each at the node.
    fn calibration(cpus: f64, compute: f64, answered: usize) -> Calibration {
        let spread = TimeSpread {
            p50: compute,
            p95: compute,
            max: compute,
        };
        Calibration {
            service: "people".into(),
            points: vec![Point {
                cpus,
                requests: 20,
                answered,
                compute: (answered > 0).then_some(spread),
                running: 40.0,
                throttled: 7.0,
                ..Point::default()
            }],
            rows: vec![Row {
                id: 0,
                measure: Measure::Rrt,
                value: 0.001,
                aux: BTreeMap::new(),
                limits: Limits {
                    cpus: Some(cpus),
                    memory: Some(Size(64 << 20)),
                    ..Limits::default()
                },
                spread: None,
                revision: None,
                written: 0,
            }],
            ..Calibration::default()
        }
    }

    fn asked(time: f64) -> Asked {
        Asked {
            times: vec![Some(time); 20],
            request: 125_000,
            answer: 0,
        }
    }

    fn evaluated(native: Side, outsourced: &Calibration, asked: &Asked) -> Evaluation {
        let side = Side::outsourced(outsourced, asked, None);
        Evaluation::new(outsourced, "x.bag".into(), robot(), (native, side), None)
    }

    fn native(compute: f64) -> Side {
        Side::native(&calibration(0.25, compute, 20), vec![compute; 20], &robot())
    }

    #[test]
    fn a_network_is_added_to_what_was_measured_and_told_apart_from_it() {
        let side = Side::outsourced(
            &calibration(1.0, 40.0, 20),
            &asked(45.0),
            "lan".parse().ok(),
        );
        // 1 ms up and 10 ms for a megabit; 1 ms down.
        let phases = side.phases.expect("phases");
        assert!((phases.up - 11.0).abs() < 1e-9 && (phases.down - 1.0).abs() < 1e-9);
        assert!((phases.transport - 5.0).abs() < 1e-9, "{phases:?}");
        assert_eq!(
            (phases.compute, phases.running, phases.held_up),
            (40.0, 40.0, 7.0)
        );
        assert!((side.rrt.expect("times").p50 - 57.0).abs() < 1e-9);
        assert_eq!(side.times.len(), 20);
    }

    #[test]
    fn the_verdict_says_what_is_faster_and_by_how_much() {
        let cloud = calibration(1.0, 40.0, 20);
        for (native, asked, words) in [
            (
                native(200.0),
                asked(50.0),
                "worth it: outsourced, it answers 4.0 times as fast, 50.0 ms instead of 200.0 ms",
            ),
            (native(51.0), asked(50.0), "no difference in time"),
            (
                native(25.0),
                asked(50.0),
                "not worth it for its time: outsourced, it takes 2.0 times as long",
            ),
            (
                Side::starved(&robot(), "people needs more than 1G".into()),
                asked(50.0),
                "only outsourced: people needs more than 1G; outsourced, a request takes 50.0 ms",
            ),
            (
                Side::native(&calibration(0.25, 0.0, 0), vec![], &robot()),
                asked(50.0),
                "on the robot none of 20 requests was answered within 10 s",
            ),
            (native(25.0), Asked::default(), "nothing can be said"),
        ] {
            let verdict = evaluated(native, &cloud, &asked).verdict;
            assert!(verdict.contains(words), "{words}: {verdict}");
        }
    }

    #[test]
    fn a_pace_that_only_one_keeps_is_told() {
        let cloud = Calibration {
            pace: Some(10.0),
            ..calibration(1.0, 40.0, 20)
        };
        let verdict = |native| evaluated(native, &cloud, &asked(50.0)).verdict;
        let told = verdict(native(200.0));
        assert!(
            told.contains("10.0 times a second, which only the outsourced"),
            "{told}"
        );
        let told = verdict(native(80.0));
        assert!(!told.contains("times a second"), "{told}");
    }

    #[test]
    fn the_suggested_sla_is_the_outsourced_95th_percentile_as_it_was_seen_from_the_robot() {
        let cloud = calibration(1.0, 40.0, 20);
        let sla = evaluated(native(200.0), &cloud, &asked(51.2))
            .sla
            .expect("an SLA");
        assert_eq!((sla.desire, sla.max), (0.052, 0.11));
        assert_eq!((sla.row.value, sla.row.limits.cpus), (0.052, Some(1.0)));
        assert_eq!(sla.row.spread.map(|spread| spread.requests), Some(20));
        assert_eq!(sla.stub_toml(), ["desire = 0.052", "max = 0.11"]);
        let starved = Side::starved(&robot(), "x".into());
        let sla = evaluated(starved, &cloud, &asked(51.2))
            .sla
            .expect("an SLA");
        assert!(sla.stub_toml()[2].starts_with("local = \"none\""));
    }

    #[test]
    fn nothing_is_suggested_of_what_answers_too_little_or_too_late() {
        let cloud = calibration(1.0, 40.0, 20);
        let few = Asked {
            times: vec![Some(50.0); 9],
            ..asked(50.0)
        };
        assert!(evaluated(native(200.0), &cloud, &few).sla.is_none());
        let mut lost = asked(50.0);
        lost.times[0] = None;
        lost.times[1] = None;
        assert!(evaluated(native(200.0), &cloud, &lost).sla.is_none());
        let late = Calibration {
            pace: Some(30.0),
            ..cloud.clone()
        };
        assert!(evaluated(native(200.0), &late, &asked(50.0)).sla.is_none());
        let unproposed = Calibration {
            rows: vec![],
            ..cloud
        };
        assert!(
            evaluated(native(200.0), &unproposed, &asked(50.0))
                .sla
                .is_none()
        );
    }
}
