//! A robot that calls now and then, next to neighbours that compute without end.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use support::daemon::Daemon;

use super::AGAIN;
use crate::cells::{CachedResult, RunCache};
use crate::experiments::crowd::{self, Controller, CrowdDaemon, ENDLESS, SHORT, WorkerService};
use crate::plots::{self, Series};
use crate::section::{Section, Table};
use crate::statistics::{mean, quantile};
use crate::words::{digits, milliseconds, ratio};

/// Fraction of the machine that the robot is promised, and that of each neighbour; with eight neighbours they add up to
/// nearly all of it.
const PARTS: (f64, f64) = (0.45, 0.06);
/// `cpu.weight` per promised core, as the daemon sets it.
const WEIGHT: f64 = 1000.0;
/// Ratio up to which means without neighbours count as equal; there the policies should not differ.
const ALIKE: f64 = 1.25;
/// Seconds between an answer and the robot's next request.
const PAUSE: f64 = 0.02;

/// How servants are isolated from each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum IsolationPolicy {
    /// Each may use what it was promised, with a corresponding weight: the treatment of robots that state cores.
    Limits,
    /// Weights as with `Limits`, but no limits.
    Weights,
    /// Equal weights without limits.
    None,
}

impl IsolationPolicy {
    const ALL: [Self; 3] = [Self::Limits, Self::Weights, Self::None];

    fn name(self) -> &'static str {
        match self {
            Self::Limits => "limits",
            Self::Weights => "weights only",
            Self::None => "none",
        }
    }
}

/// Inputs of a point.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct IsolationPlan {
    policy: IsolationPolicy,
    neighbours: usize,
    settles: f64,
    lasts: f64,
    work: u32,
    cores: f64,
}

/// Measurements of a point of the figure.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct IsolationPoint {
    /// Response times of the robot, in seconds.
    times: Vec<f64>,
    /// Cores that all neighbours together used meanwhile.
    neighbours_cores: f64,
}

/// Results of all points.
pub(super) struct IsolationRuns(Vec<(IsolationPlan, CachedResult<IsolationPoint>)>);

pub(super) fn measure(cells: &RunCache, yard: &mut CrowdDaemon, quick: bool) -> Result<IsolationRuns> {
    let neighbours: &[usize] = if quick { &[0, 2] } else { &[0, 1, 2, 4, 8] };
    let (settles, lasts) = if quick { (0.3, 1.2) } else { (1.5, 7.0) };
    let mut points = Vec::new();
    for policy in IsolationPolicy::ALL {
        for neighbours in neighbours.iter().copied() {
            let plan =
                IsolationPlan { policy, neighbours, settles, lasts, work: SHORT.milliseconds, cores: crowd::cores() };
            let name = format!("neighbours {} {neighbours}", policy.name());
            let measured = cells.measure(&name, &plan, || {
                let daemon = yard.without_servants(Controller::Off)?;
                crowd::publish(daemon, SHORT)?;
                crowd::publish(daemon, ENDLESS)?;
                measure_point(daemon, &plan)
            })?;
            points.push((plan, measured));
        }
    }
    Ok(IsolationRuns(points))
}

fn measure_point(daemon: &Daemon, plan: &IsolationPlan) -> Result<IsolationPoint> {
    let joins = |service: WorkerService, name: &str, part: f64| {
        let promised = part * plan.cores;
        let states = match plan.policy {
            IsolationPolicy::Limits => format!("&cpus={promised:.3}"),
            IsolationPolicy::Weights | IsolationPolicy::None => String::new(),
        };
        let robot = crowd::join(daemon, service, name, &states)?;
        if plan.policy == IsolationPolicy::Weights {
            let servant = daemon.servant_of(service.name, name)?;
            let id = servant["id"].as_str().context("a servant's id")?;
            let weight = format!("{:.0}", promised * WEIGHT);
            let set = ["set", id, "--cpu-weight", &weight];
            daemon.deployer().run(&set)?.expect_success()?;
        }
        Ok(robot)
    };
    let mut measured = joins(SHORT, "measured", PARTS.0)?;
    crowd::time_call(&mut measured)?;
    let mut neighbours = (0..plan.neighbours)
        .map(|number| joins(ENDLESS, &format!("greedy{number}"), PARTS.1))
        .collect::<Result<Vec<_>>>()?;
    // Starts once all are connected, because servants start slowly next to busy ones.
    for neighbour in &mut neighbours {
        crowd::begin_call(neighbour)?;
    }
    let lasts = |seconds: f64| {
        let now = Instant::now();
        (now, now + Duration::from_secs_f64(seconds))
    };
    crowd::time_calls(&mut measured, lasts(plan.settles), || PAUSE)?;
    let (before, begun) = (crowd::usage(daemon, ENDLESS)?, Instant::now());
    let times = crowd::time_calls(&mut measured, lasts(plan.lasts), || PAUSE)?;
    let used = crowd::usage(daemon, ENDLESS)?.0 - before.0;
    Ok(IsolationPoint { times, neighbours_cores: used / begun.elapsed().as_secs_f64() })
}

pub(super) fn add_to_section(runs: &IsolationRuns, section: &mut Section) -> Result<()> {
    let plan = &runs.0[0].0;
    section.differs.push(format!(
        "Greedy neighbours: the robot asks for {} ms of a core, {:.0} ms after each answer; each neighbour's node \
         computes without end. \
         Limits: the robot is promised {:.2} cores and each neighbour {:.2}, and none may use more. Weights only: the \
         same cpu.weight \
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
        "policy | neighbours | requests | RRT, median (ms) | RRT, 95 % (ms) | median, times that alone | \
         cores that neighbours used",
    );
    for (plan, measured) in &runs.0 {
        let what = format!("{} neighbours, {}", plan.neighbours, plan.policy.name());
        if let Some(beside) = measured.require(section, what, AGAIN) {
            table.push([
                plan.policy.name().to_owned(),
                plan.neighbours.to_string(),
                beside.times.len().to_string(),
                milliseconds(quantile(&beside.times, 0.5)),
                milliseconds(quantile(&beside.times, 0.95)),
                ratio(runs.slowdown(plan.policy, plan.neighbours, 0.5)),
                digits(beside.neighbours_cores),
            ]);
        }
    }
    section.tables.push(table);
    for (id, fraction, name) in [("neighbours-median", 0.5, "median"), ("neighbours-95", 0.95, "95 %")] {
        let series =
            IsolationPolicy::ALL.map(|policy| Series::new(policy.name(), runs.quantile_line(policy, fraction)));
        let caption = format!("Response time of a robot beside greedy neighbours, {name}");
        let drawing = plots::lines(&caption, "greedy neighbours", "response time (ms)", &series, false)?;
        section.add_drawing(id, caption, drawing);
    }
    runs.add_findings(section);
    Ok(())
}

impl IsolationRuns {
    fn find_point(&self, policy: IsolationPolicy, neighbours: usize) -> Option<&IsolationPoint> {
        let mut all = self.0.iter();
        let found = all.find(|(plan, _)| plan.policy == policy && plan.neighbours == neighbours);
        found?.1.value()
    }

    /// Returns a quantile of the response time in milliseconds by number of neighbours.
    fn quantile_line(&self, policy: IsolationPolicy, fraction: f64) -> Vec<(f64, f64)> {
        let of_policy = self.0.iter().filter(|(plan, _)| plan.policy == policy);
        let points = of_policy.filter_map(|(plan, measured)| {
            let time = quantile(&measured.value()?.times, fraction)?;
            Some((plan.neighbours as f64, time * 1e3))
        });
        points.collect()
    }

    /// Returns the ratio to the response time without neighbours.
    fn slowdown(&self, policy: IsolationPolicy, neighbours: usize, fraction: f64) -> Option<f64> {
        let time = |neighbours| quantile(&self.find_point(policy, neighbours)?.times, fraction);
        Some(time(neighbours)? / time(0)?)
    }

    fn add_findings(&self, section: &mut Section) {
        let most = self.0.iter().map(|(plan, _)| plan.neighbours).max();
        let Some(most) = most.filter(|most| *most > 0) else {
            return;
        };
        let mut parts = Vec::new();
        for policy in IsolationPolicy::ALL {
            let times = [0.5, 0.95].map(|fraction| self.slowdown(policy, most, fraction));
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
            section.findings.push(format!("Beside {most} greedy neighbours, {}.", parts.join("; ")));
        }
        let used = |policy| self.find_point(policy, most).map(|beside| beside.neighbours_cores);
        if let (Some(limits), Some(weights)) = (used(IsolationPolicy::Limits), used(IsolationPolicy::Weights)) {
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
        let alone: Vec<f64> =
            IsolationPolicy::ALL.iter().filter_map(|policy| mean(&self.find_point(*policy, 0)?.times)).collect();
        let spread = alone.iter().copied().fold(0.0, f64::max) / alone.iter().copied().fold(f64::INFINITY, f64::min);
        if spread > ALIKE {
            section.findings.push(format!(
                "Alone, the three policies should be equal, and differ by {:.0} %: the machine did something else \
                 meanwhile, so that \
                 nothing is said of which is better. make eval ONLY=9 FRESH=1 measures again.",
                (spread - 1.0) * 100.0
            ));
            return;
        }
        let [Some(limits), Some(weights)] =
            [IsolationPolicy::Limits, IsolationPolicy::Weights].map(|policy| self.slowdown(policy, most, 0.95))
        else {
            return;
        };
        let ahead = |times: f64, of: f64| times > of * 1.1;
        section.findings.push(if ahead(weights, limits) {
            "By their 95 % values, limits protect the robot better than weights alone: neighbours that have used up \
             their part leave their cores at once, while \
             weights let them run whenever the robot pauses, and a core is taken back from them only at the \
             scheduler's next decision."
                .to_owned()
        } else if ahead(limits, weights) {
            "By their 95 % values, weights alone protect the robot better than limits in this run, which is worse than \
             hoped: the robot itself, or its \
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
    use crate::words::assert_tells;

    fn test_runs(limits: [f64; 2], weights: [f64; 2], none: [f64; 2]) -> IsolationRuns {
        let mut points = Vec::new();
        for (policy, times) in IsolationPolicy::ALL.into_iter().zip([limits, weights, none]) {
            for (neighbours, time) in [0, 8].into_iter().zip(times) {
                let plan = IsolationPlan { policy, neighbours, settles: 1.0, lasts: 1.0, work: 8, cores: 2.0 };
                let beside = IsolationPoint { times: vec![time; 3], neighbours_cores: 1.5 };
                points.push((plan, CachedResult::Done(beside)));
            }
        }
        IsolationRuns(points)
    }

    #[test]
    fn the_three_policies_are_compared() {
        let mut section = Section::new(9, "a", "b");
        let measured = test_runs([0.01, 0.011], [0.01, 0.02], [0.01, 0.05]);
        add_to_section(&measured, &mut section).expect("it is told");
        assert_eq!(
            section.findings[0],
            "Beside 8 greedy neighbours, limits: the median is 1.1 times that alone, the 95 % value 1.1 times; weights \
             only: the \
             median is 2.0 times that alone, the 95 % value 2.0 times; none: the median is 5.0 times that alone, the \
             95 % value 5.0 times."
        );
        assert!(section.findings[2].starts_with("By their 95 % values, limits protect"), "{:?}", section.findings);
        assert_eq!(section.tables[0].rows[5][3..6], ["50.0", "50.0", "5.0"]);
        assert_eq!(section.figures.len(), 2);
    }

    #[test]
    fn what_is_worse_than_hoped_is_said() {
        let mut section = Section::new(9, "a", "b");
        let measured = test_runs([0.01, 0.03], [0.01, 0.02], [0.01, 0.05]);
        add_to_section(&measured, &mut section).expect("it is told");
        assert_tells(&section.findings[2], "worse than hoped");
    }

    #[test]
    fn policies_are_not_compared_on_a_machine_that_was_not_quiet() {
        let mut section = Section::new(9, "a", "b");
        let measured = test_runs([0.01, 0.03], [0.01, 0.02], [0.02, 0.05]);
        add_to_section(&measured, &mut section).expect("it is told");
        assert_tells(&section.findings[2], "differ by 100 %");
        assert_eq!(section.findings.len(), 3);
    }

    #[test]
    fn a_point_that_is_missing_is_named() {
        let mut measured = test_runs([0.01, 0.03], [0.01, 0.02], [0.02, 0.05]);
        measured.0[1].1 = CachedResult::Missing("no room".to_owned());
        let mut section = Section::new(9, "a", "b");
        add_to_section(&measured, &mut section).expect("it is told");
        assert_eq!(section.missing[0].what, "8 neighbours, limits");
        assert!(!section.findings[0].contains("limits:"), "{:?}", section.findings);
    }
}
