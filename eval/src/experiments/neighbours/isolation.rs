//! A robot that calls now and then, next to neighbours that compute without end.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use support::daemon::Daemon;
use support::robot::Robot;

use crate::cells::{RunCache, Runs};
use crate::experiments::crowd::{self, Controller, CrowdDaemon, ENDLESS, SHORT, WorkerService};
use crate::plots::{self, Series};
use crate::section::{Section, Table};
use crate::statistics::{Spread, quantile};
use crate::words::{PERCENTILES, count, digits, milliseconds, ratio, spread};

/// Fraction of the machine that the robot is promised, and that of each neighbour; with eight neighbours they add up to
/// nearly all of it.
const PARTS: (f64, f64) = (0.45, 0.06);
/// `cpu.weight` per promised core, as the daemon sets it.
const WEIGHT: f64 = 1000.0;
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
pub(super) struct IsolationRuns(Vec<(IsolationPlan, Runs<IsolationPoint>)>);

pub(super) fn measure(cells: &RunCache, yard: &mut CrowdDaemon, quick: bool) -> Result<IsolationRuns> {
    let neighbours: &[usize] = if quick { &[0, 2] } else { &[0, 1, 2, 4, 8] };
    let (settles, lasts) = if quick { (0.3, 1.2) } else { (1.5, 7.0) };
    let (work, cores) = (SHORT.milliseconds, crowd::cores());
    let mut points = Vec::new();
    for policy in IsolationPolicy::ALL {
        for neighbours in neighbours.iter().copied() {
            let plan = IsolationPlan { policy, neighbours, settles, lasts, work, cores };
            let measured = cells.repeat(&format!("neighbours {} {neighbours}", policy.name()), &plan, || {
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
        let is_limited = plan.policy == IsolationPolicy::Limits;
        let states = if is_limited { format!("&cpus={promised:.3}") } else { String::new() };
        let robot = crowd::join(daemon, service, name, &states)?;
        if plan.policy == IsolationPolicy::Weights {
            let servant = daemon.servant_of(service.name, name)?;
            let id = servant["id"].as_str().context("a servant's id")?;
            let weight = format!("{:.0}", promised * WEIGHT);
            daemon.deployer().run(&["set", id, "--cpu-weight", &weight])?.expect_success()?;
        }
        Ok(robot)
    };
    let mut measured = joins(SHORT, "measured", PARTS.0)?;
    crowd::time_call(&mut measured)?;
    let join = |number| joins(ENDLESS, &format!("greedy{number}"), PARTS.1);
    let mut neighbours: Vec<Robot> = (0..plan.neighbours).map(join).collect::<Result<_>>()?;
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

pub(super) fn add_to_section(runs: &IsolationRuns, section: &mut Section) {
    let plan = &runs.0[0].0;
    let [own, theirs] = [PARTS.0, PARTS.1].map(|part| part * plan.cores);
    section.differs.push(format!(
        "Greedy neighbours: the robot asks for {} ms of a core, {:.0} ms after each answer; each neighbour computes \
         without end. Limits: the robot is promised {own:.2} cores and each neighbour {theirs:.2}, and none may use \
         more. Weights only: the same cpu.weight ({:.0} and {:.0}), without limits. None: all are equal.",
        plan.work,
        PAUSE * 1e3,
        own * WEIGHT,
        theirs * WEIGHT,
    ));
    let mut table = Table::new(
        "A robot beside greedy neighbours",
        "policy | neighbours | requests | p50 (ms) | p95 (ms) | p99 (ms) | p50, times that alone | \
         p95, times that alone | cores that neighbours used",
    );
    for (plan, measured) in &runs.0 {
        let what = format!("{} neighbours, {}", plan.neighbours, plan.policy.name());
        if measured.require(section, &what).is_none() {
            continue;
        }
        let mut row = vec![plan.policy.name().to_owned(), plan.neighbours.to_string()];
        row.push(count(measured.figure(|point| Some(point.times.len() as f64))));
        row.extend(measured.percentiles(|point| point.times.clone()).map(milliseconds));
        row.extend([0.5, 0.95].map(|fraction| ratio(runs.slowdown(plan.policy, plan.neighbours, fraction))));
        row.push(spread(measured.figure(|point| Some(point.neighbours_cores)), digits));
        table.push(row);
    }
    section.tables.push(table);
    for (fraction, name) in PERCENTILES.into_iter().zip(["p50", "p95", "p99"]) {
        let series = IsolationPolicy::ALL.map(|policy| {
            let points = runs.0.iter().filter(|(plan, _)| plan.policy == policy).filter_map(|(plan, measured)| {
                let time = measured.figure(|point| quantile(&point.times, fraction))?;
                Some((plan.neighbours as f64, time.median * 1e3))
            });
            Series::new(policy.name(), points.collect())
        });
        let caption = format!("Response time of a robot beside greedy neighbours, {name}");
        let drawing = plots::lines(&caption, "greedy neighbours", "response time (ms)", &series, false);
        section.add_drawing(format!("neighbours-{name}"), caption, drawing);
    }
    runs.add_findings(section);
}

impl IsolationRuns {
    fn find_point(&self, policy: IsolationPolicy, neighbours: usize) -> Option<&Runs<IsolationPoint>> {
        let found = self.0.iter().find(|(plan, _)| plan.policy == policy && plan.neighbours == neighbours);
        found.map(|(_, runs)| runs)
    }

    /// Returns the ratio to the response time without neighbours.
    fn slowdown(&self, policy: IsolationPolicy, neighbours: usize, fraction: f64) -> Option<Spread> {
        let alone = self.find_point(policy, 0)?;
        let time = |point: &IsolationPoint| quantile(&point.times, fraction);
        alone.compare(self.find_point(policy, neighbours)?, |alone, beside| Some(time(beside)? / time(alone)?))
    }

    fn add_findings(&self, section: &mut Section) {
        let most = self.0.iter().map(|(plan, _)| plan.neighbours).max();
        let Some(most) = most.filter(|most| *most > 0) else {
            return;
        };
        let parts = IsolationPolicy::ALL.into_iter().filter_map(|policy| {
            let [median, long] = [0.5, 0.95].map(|fraction| self.slowdown(policy, most, fraction));
            median.and(long)?;
            Some(format!("{}: p50 is {} times that alone, p95 {} times", policy.name(), ratio(median), ratio(long)))
        });
        let parts: Vec<String> = parts.collect();
        if !parts.is_empty() {
            section.findings.push(format!("Beside {most} greedy neighbours, {}.", parts.join("; ")));
        }
        let [limits, weights] = [IsolationPolicy::Limits, IsolationPolicy::Weights];
        let used = |policy| {
            spread(self.find_point(policy, most).and_then(|runs| runs.figure(|one| Some(one.neighbours_cores))), digits)
        };
        section.findings.push(format!(
            "What limits cost: {most} neighbours used {} cores with limits and {} with weights only.",
            used(limits),
            used(weights)
        ));
        let p95 = |policy| self.slowdown(policy, most, 0.95);
        section.findings.extend(p95(limits).zip(p95(weights)).map(|(limits, weights)| {
            let which = if weights.is_above(limits) {
                "limits protect the robot better than weights alone"
            } else if limits.is_above(weights) {
                "weights alone protect the robot better than limits, which is worse than hoped"
            } else {
                "limits and weights alone do not differ by more than the runs"
            };
            format!("By their p95, {which}.")
        }));
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
                points.push((plan, Runs::from(IsolationPoint { times: vec![time; 3], neighbours_cores: 1.5 })));
            }
        }
        IsolationRuns(points)
    }

    fn section_of(runs: &IsolationRuns) -> Section {
        let mut section = Section::new(9, "a", "b");
        add_to_section(runs, &mut section);
        section
    }

    #[test]
    fn the_three_policies_are_compared() {
        let section = section_of(&test_runs([0.01, 0.011], [0.01, 0.02], [0.01, 0.05]));
        assert_eq!(
            section.findings[0],
            "Beside 8 greedy neighbours, limits: p50 is 1.1 times that alone, p95 1.1 times; weights only: p50 is 2.0 \
             times that alone, p95 2.0 times; none: p50 is 5.0 times that alone, p95 5.0 times."
        );
        assert_tells(&section.findings[2], "limits protect");
        assert_eq!(section.tables[0].rows[5][3..7], ["50.0", "50.0", "50.0", "5.0"]);
        assert_eq!(section.figures.len(), 3);
        let section = section_of(&test_runs([0.01, 0.03], [0.01, 0.02], [0.01, 0.05]));
        assert_tells(&section.findings[2], "worse than hoped");
    }

    #[test]
    fn a_point_that_is_missing_is_named() {
        let mut measured = test_runs([0.01, 0.03], [0.01, 0.02], [0.02, 0.05]);
        measured.0[1].1 = Runs::from_failure("no room");
        let section = section_of(&measured);
        assert_eq!(section.missing[0].what, "8 neighbours, limits");
        assert!(!section.findings[0].contains("limits:"), "{:?}", section.findings);
    }
}
