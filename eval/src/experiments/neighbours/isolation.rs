//! A robot that asks now and then, beside neighbours that compute without end.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use support::daemon::Daemon;

use super::AGAIN;
use crate::cells::{Cells, Measured};
use crate::experiments::crowd::{self, Controller, ENDLESS, SHORT, Service, Yard};
use crate::plots::{self, Series};
use crate::section::{Missing, Section, Table};
use crate::statistics::{mean, quantile};
use crate::words::{digits, milliseconds, ratio};

/// What the robot is promised, and what each neighbour, as parts of the machine: with eight neighbours that is nearly all of it.
const PARTS: (f64, f64) = (0.45, 0.06);
/// `cpu.weight` of somebody for each core of a promise, as the daemon sets it.
const WEIGHT: f64 = 1000.0;
/// How many times as long as another the mean without neighbours may be, where policies cannot differ.
const ALIKE: f64 = 1.25;
/// Seconds between an answer and the robot's next request.
const PAUSE: f64 = 0.02;

/// How servants are kept apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Policy {
    /// Each may use what it was promised, and has the weight of it: what robots get who state cores.
    Limits,
    /// The same weights, and no limits.
    Weights,
    /// All are equal.
    None,
}

impl Policy {
    const ALL: [Self; 3] = [Self::Limits, Self::Weights, Self::None];

    fn name(self) -> &'static str {
        match self {
            Self::Limits => "limits",
            Self::Weights => "weights only",
            Self::None => "none",
        }
    }
}

/// What a point depends on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Plan {
    policy: Policy,
    neighbours: usize,
    settles: f64,
    lasts: f64,
    work: u32,
    cores: f64,
}

/// A point of the figure.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Beside {
    /// The robot's response times, seconds.
    times: Vec<f64>,
    /// Cores that all neighbours together used meanwhile.
    neighbours_cores: f64,
}

/// All points.
pub(super) struct Runs(Vec<(Plan, Measured<Beside>)>);

pub(super) fn measure(cells: &Cells, yard: &mut Yard, quick: bool) -> Result<Runs> {
    let neighbours: &[usize] = if quick { &[0, 2] } else { &[0, 1, 2, 4, 8] };
    let (settles, lasts) = if quick { (0.3, 1.2) } else { (1.5, 7.0) };
    let mut points = Vec::new();
    for policy in Policy::ALL {
        for neighbours in neighbours.iter().copied() {
            let plan = Plan {
                policy,
                neighbours,
                settles,
                lasts,
                work: SHORT.milliseconds,
                cores: crowd::cores(),
            };
            let name = format!("neighbours {} {neighbours}", policy.name());
            let measured = cells.measure(&name, &plan, || {
                let daemon = yard.cleared(Controller::Off)?;
                crowd::publishes(daemon, SHORT)?;
                crowd::publishes(daemon, ENDLESS)?;
                beside(daemon, &plan)
            })?;
            points.push((plan, measured));
        }
    }
    Ok(Runs(points))
}

fn beside(daemon: &Daemon, plan: &Plan) -> Result<Beside> {
    let joins = |service: Service, name: &str, part: f64| {
        let promised = part * plan.cores;
        let states = match plan.policy {
            Policy::Limits => format!("&cpus={promised:.3}"),
            Policy::Weights | Policy::None => String::new(),
        };
        let robot = crowd::joins(daemon, service, name, &states)?;
        if plan.policy == Policy::Weights {
            let servant = daemon.servant_of(service.name, name)?;
            let id = servant["id"].as_str().context("a servant's id")?;
            let weight = format!("{:.0}", promised * WEIGHT);
            let set = ["set", id, "--cpu-weight", &weight];
            daemon.deployer().types(&set)?.succeeded()?;
        }
        Ok(robot)
    };
    let mut measured = joins(SHORT, "measured", PARTS.0)?;
    crowd::call(&mut measured)?;
    let mut neighbours = (0..plan.neighbours)
        .map(|number| joins(ENDLESS, &format!("greedy{number}"), PARTS.1))
        .collect::<Result<Vec<_>>>()?;
    // When all are there: servants start slowly beside others that compute.
    for neighbour in &mut neighbours {
        crowd::begins(neighbour)?;
    }
    let lasts = |seconds: f64| {
        let now = Instant::now();
        (now, now + Duration::from_secs_f64(seconds))
    };
    crowd::calls(&mut measured, lasts(plan.settles), || PAUSE)?;
    let (before, begun) = (crowd::usage(daemon, ENDLESS)?, Instant::now());
    let times = crowd::calls(&mut measured, lasts(plan.lasts), || PAUSE)?;
    let used = crowd::usage(daemon, ENDLESS)?.0 - before.0;
    Ok(Beside {
        times,
        neighbours_cores: used / begun.elapsed().as_secs_f64(),
    })
}

pub(super) fn tell(runs: &Runs, section: &mut Section) -> Result<()> {
    let plan = &runs.0[0].0;
    section.differs.push(format!(
        "Greedy neighbours: the robot asks for {} ms of a core, {:.0} ms after each answer; each neighbour's node computes without end. \
         Limits: the robot is promised {:.2} cores and each neighbour {:.2}, and none may use more. Weights only: the same cpu.weight \
         ({:.0} and {:.0}), without limits. None: all are equal.",
        plan.work,
        PAUSE * 1e3,
        PARTS.0 * plan.cores,
        PARTS.1 * plan.cores,
        PARTS.0 * plan.cores * WEIGHT,
        PARTS.1 * plan.cores * WEIGHT,
    ));
    let mut table = Table::new(
        "A robot beside greedy neighbours",
        [
            "policy",
            "neighbours",
            "requests",
            "RRT, median (ms)",
            "RRT, 95 % (ms)",
            "median, times that alone",
            "cores that neighbours used",
        ],
    );
    for (plan, measured) in &runs.0 {
        match measured {
            Measured::Done(beside) => table.push([
                plan.policy.name().to_owned(),
                plan.neighbours.to_string(),
                beside.times.len().to_string(),
                milliseconds(quantile(&beside.times, 0.5)),
                milliseconds(quantile(&beside.times, 0.95)),
                ratio(runs.slower(plan.policy, plan.neighbours, 0.5)),
                digits(beside.neighbours_cores),
            ]),
            Measured::Missing(why) => section.missing.push(Missing::new(
                format!("{} neighbours, {}", plan.neighbours, plan.policy.name()),
                why,
                AGAIN,
            )),
        }
    }
    section.tables.push(table);
    for (id, fraction, name) in [
        ("neighbours-median", 0.5, "median"),
        ("neighbours-95", 0.95, "95 %"),
    ] {
        let series =
            Policy::ALL.map(|policy| Series::new(policy.name(), runs.line(policy, fraction)));
        let caption = format!("Response time of a robot beside greedy neighbours, {name}");
        let drawing = plots::lines(
            &caption,
            "greedy neighbours",
            "response time (ms)",
            &series,
            false,
        )?;
        section.drawing(id, caption, drawing);
    }
    runs.find(section);
    Ok(())
}

impl Runs {
    fn at(&self, policy: Policy, neighbours: usize) -> Option<&Beside> {
        let mut all = self.0.iter();
        let found = all.find(|(plan, _)| plan.policy == policy && plan.neighbours == neighbours);
        found?.1.done()
    }

    /// Milliseconds by neighbours.
    fn line(&self, policy: Policy, fraction: f64) -> Vec<(f64, f64)> {
        let of_policy = self.0.iter().filter(|(plan, _)| plan.policy == policy);
        let points = of_policy.filter_map(|(plan, measured)| {
            let time = quantile(&measured.done()?.times, fraction)?;
            Some((plan.neighbours as f64, time * 1e3))
        });
        points.collect()
    }

    /// How many times as long as without neighbours.
    fn slower(&self, policy: Policy, neighbours: usize, fraction: f64) -> Option<f64> {
        let time = |neighbours| quantile(&self.at(policy, neighbours)?.times, fraction);
        Some(time(neighbours)? / time(0)?)
    }

    fn find(&self, section: &mut Section) {
        let most = self.0.iter().map(|(plan, _)| plan.neighbours).max();
        let Some(most) = most.filter(|most| *most > 0) else {
            return;
        };
        let mut parts = Vec::new();
        for policy in Policy::ALL {
            let times = [0.5, 0.95].map(|fraction| self.slower(policy, most, fraction));
            if let [Some(median), Some(long)] = times {
                parts.push(format!(
                    "{}: the median is {} times that alone, the 95 % value {} times",
                    policy.name(),
                    ratio(Some(median)),
                    ratio(Some(long)),
                ));
            }
        }
        if !parts.is_empty() {
            section.findings.push(format!(
                "Beside {most} greedy neighbours, {}.",
                parts.join("; ")
            ));
        }
        let used = |policy| self.at(policy, most).map(|beside| beside.neighbours_cores);
        if let (Some(limits), Some(weights)) = (used(Policy::Limits), used(Policy::Weights)) {
            let idle = if weights > limits {
                "; what the robot does not use is left idle with limits"
            } else {
                "; here nothing was left idle for that"
            };
            section.findings.push(format!(
                "What limits cost: {most} neighbours used {} cores with limits and {} with weights only{idle}.",
                digits(limits),
                digits(weights)
            ));
        }
        let alone: Vec<f64> = Policy::ALL
            .iter()
            .filter_map(|policy| mean(&self.at(*policy, 0)?.times))
            .collect();
        let spread = alone.iter().copied().fold(0.0, f64::max)
            / alone.iter().copied().fold(f64::INFINITY, f64::min);
        if spread > ALIKE {
            section.findings.push(format!(
                "Alone, the three policies should be equal, and differ by {:.0} %: the machine did something else meanwhile, so that \
                 nothing is said of which is better. make eval ONLY=9 FRESH=1 measures again.",
                (spread - 1.0) * 100.0
            ));
            return;
        }
        let [Some(limits), Some(weights)] =
            [Policy::Limits, Policy::Weights].map(|policy| self.slower(policy, most, 0.95))
        else {
            return;
        };
        let ahead = |times: f64, of: f64| times > of * 1.1;
        section.findings.push(if ahead(weights, limits) {
            "By their 95 % values, limits protect the robot better than weights alone: neighbours that have used up their part leave their cores at once, while \
             weights let them run whenever the robot pauses, and a core is taken back from them only at the scheduler's next decision."
                .to_owned()
        } else if ahead(limits, weights) {
            "By their 95 % values, weights alone protect the robot better than limits in this run, which is worse than hoped: the robot itself, or its \
             neighbours all at once, begin each period of the limit with their whole part of it."
                .to_owned()
        } else {
            "By their 95 % values, limits and weights alone protect the robot equally well, within a tenth.".to_owned()
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn runs(limits: [f64; 2], weights: [f64; 2], none: [f64; 2]) -> Runs {
        let mut points = Vec::new();
        for (policy, times) in Policy::ALL.into_iter().zip([limits, weights, none]) {
            for (neighbours, time) in [0, 8].into_iter().zip(times) {
                let plan = Plan {
                    policy,
                    neighbours,
                    settles: 1.0,
                    lasts: 1.0,
                    work: 8,
                    cores: 2.0,
                };
                let beside = Beside {
                    times: vec![time; 3],
                    neighbours_cores: 1.5,
                };
                points.push((plan, Measured::Done(beside)));
            }
        }
        Runs(points)
    }

    #[test]
    fn the_three_policies_are_compared() {
        let mut section = Section::new(9, "a", "b");
        let measured = runs([0.01, 0.011], [0.01, 0.02], [0.01, 0.05]);
        tell(&measured, &mut section).expect("it is told");
        assert_eq!(
            section.findings[0],
            "Beside 8 greedy neighbours, limits: the median is 1.1 times that alone, the 95 % value 1.1 times; weights only: the \
             median is 2.0 times that alone, the 95 % value 2.0 times; none: the median is 5.0 times that alone, the 95 % value 5.0 times."
        );
        assert!(
            section.findings[2].starts_with("By their 95 % values, limits protect"),
            "{:?}",
            section.findings
        );
        assert_eq!(section.tables[0].rows[5][3..6], ["50.0", "50.0", "5.0"]);
        assert_eq!(section.figures.len(), 2);
    }

    #[test]
    fn what_is_worse_than_hoped_is_said() {
        let mut section = Section::new(9, "a", "b");
        let measured = runs([0.01, 0.03], [0.01, 0.02], [0.01, 0.05]);
        tell(&measured, &mut section).expect("it is told");
        assert!(
            section.findings[2].contains("worse than hoped"),
            "{:?}",
            section.findings
        );
    }

    #[test]
    fn policies_are_not_compared_on_a_machine_that_was_not_quiet() {
        let mut section = Section::new(9, "a", "b");
        let measured = runs([0.01, 0.03], [0.01, 0.02], [0.02, 0.05]);
        tell(&measured, &mut section).expect("it is told");
        assert!(
            section.findings[2].contains("differ by 100 %"),
            "{:?}",
            section.findings
        );
        assert_eq!(section.findings.len(), 3);
    }

    #[test]
    fn a_point_that_is_missing_is_named() {
        let mut measured = runs([0.01, 0.03], [0.01, 0.02], [0.02, 0.05]);
        measured.0[1].1 = Measured::Missing("no room".to_owned());
        let mut section = Section::new(9, "a", "b");
        tell(&measured, &mut section).expect("it is told");
        assert_eq!(section.missing[0].what, "8 neighbours, limits");
        assert!(
            !section.findings[0].contains("limits:"),
            "{:?}",
            section.findings
        );
    }
}
