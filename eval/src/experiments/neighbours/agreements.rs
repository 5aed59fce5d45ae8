//! Robots of one machine that accept different response times: the fraction of each robot's requests that are in time,
//! with the controller and with fixed limits as promised. All robots are promised an equal share of the machine. Every
//! other robot, beginning with the first, calls again as soon as it is answered and accepts a shorter response time
//! than its share allows; the others call rarely and accept a longer one.

use std::sync::Barrier;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use support::daemon::Daemon;

use crate::cells::{RunCache, Runs};
use crate::experiments::crowd::{self, Controller, CrowdDaemon, LONG};
use crate::plots::{self, Bar};
use crate::section::{Section, Table};
use crate::statistics::{Spread, mean, quantile};
use crate::words::{count, milliseconds, percent};

/// Fraction of a robot's requests that must be in time for the robot to count.
const IN_TIME: f64 = 0.95;
/// Seconds between an answer and the next request of robots that call rarely.
const SELDOM: f64 = 1.0;
/// Controller off and on, in the order of the tables.
const BOTH: [Controller; 2] = [Controller::Off, Controller::On];

/// Inputs of a run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct AgreementPlan {
    controller: Controller,
    robots: usize,
    settles: f64,
    lasts: f64,
    work: u32,
    cores: f64,
}

/// Measurements of a robot.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct RobotOutcome {
    /// T_max that it stated, in seconds.
    accepts: f64,
    /// True if it calls without a pause.
    eager: bool,
    /// Response times, in seconds.
    times: Vec<f64>,
}

impl RobotOutcome {
    /// Returns the fraction of its requests that were in time; `None` if it made none.
    fn share_in_time(&self) -> Option<f64> {
        let in_time = self.times.iter().filter(|time| **time <= self.accepts);
        (!self.times.is_empty()).then(|| in_time.count() as f64 / self.times.len() as f64)
    }

    fn is_in_time(&self) -> bool {
        self.share_in_time().is_some_and(|share| share >= IN_TIME)
    }
}

/// Results of all runs.
pub(super) struct AgreementRuns(Vec<(AgreementPlan, Runs<Vec<RobotOutcome>>)>);

pub(super) fn measure(cells: &RunCache, yard: &mut CrowdDaemon, quick: bool) -> Result<AgreementRuns> {
    let robots: &[usize] = if quick { &[4] } else { &[2, 3, 4, 5, 6, 7, 8] };
    // Once a second the controller examines the requests of the last ten seconds.
    let (settles, lasts) = if quick { (1.0, 1.5) } else { (12.0, 9.0) };
    let (work, cores) = (LONG.milliseconds, crowd::cores());
    let mut runs = Vec::new();
    for controller in BOTH {
        for robots in robots.iter().copied() {
            let plan = AgreementPlan { controller, robots, settles, lasts, work, cores };
            let name = format!("agreements {robots} controller {}", controller.name());
            let measured = cells.repeat(&name, &plan, || {
                let daemon = yard.without_servants(controller)?;
                crowd::publish(daemon, LONG)?;
                run_robots(daemon, &plan)
            })?;
            runs.push((plan, measured));
        }
    }
    Ok(AgreementRuns(runs))
}

/// Cores that each robot is promised, and seconds that eager and patient ones accept.
struct AgreementTerms {
    part: f64,
    eager: f64,
    patient: f64,
}

impl AgreementTerms {
    fn new(robots: usize, cores: f64, work: f64) -> Self {
        // Rounded down so that the promises never add up to more than the machine has.
        let part = (cores / robots as f64 * 1000.0).floor() / 1000.0;
        // With twice its share an eager robot is in time, unless that is more than its single thread can use.
        let eager = (work / (2.0 * part) * 1.4).max(work * 1.6);
        Self { part, eager, patient: work / part * 4.0 + 0.2 }
    }
}

fn run_robots(daemon: &Daemon, plan: &AgreementPlan) -> Result<Vec<RobotOutcome>> {
    let terms = AgreementTerms::new(plan.robots, plan.cores, f64::from(plan.work) / 1e3);
    // All start together: a robot measured while another's servant is still starting would have that servant's cores,
    // or lack them.
    let ready = Barrier::new(plan.robots);
    let (ready, terms) = (&ready, &terms);
    let one = |number: usize| -> Result<RobotOutcome> {
        let eager = number % 2 == 0;
        let (accepts, pause) = if eager { (terms.eager, 0.0) } else { (terms.patient, SELDOM) };
        let states = format!("&cpus={:.3}&max_rrt={:.0}ms", terms.part, accepts * 1e3);
        let joined = crowd::join(daemon, LONG, &format!("r{number}"), &states);
        let joined = joined.and_then(|mut robot| crowd::time_call(&mut robot).map(|_| robot));
        // Robots that failed have come as well.
        ready.wait();
        let mut robot = joined?;
        let from = Instant::now() + Duration::from_secs_f64(plan.settles);
        let to = from + Duration::from_secs_f64(plan.lasts);
        Ok(RobotOutcome { accepts, eager, times: crowd::time_calls(&mut robot, (from, to), || pause)? })
    };
    std::thread::scope(|scope| {
        let all: Vec<_> = (0..plan.robots).map(|number| scope.spawn(move || one(number))).collect();
        let joined = all.into_iter().map(|robot| robot.join().ok().context("a robot's thread broke")?);
        joined.collect()
    })
}

pub(super) fn add_to_section(runs: &AgreementRuns, section: &mut Section) {
    section.differs.push(format!(
        "Mixed agreements: robots with equal promises of cores ask for {} ms of one. Every other one asks again at \
         once and accepts less (max_rrt) than its promise gives; the others ask each second and accept more. A robot \
         is in time if {:.0} % of its requests are.",
        LONG.milliseconds,
        IN_TIME * 100.0
    ));
    let mut table = Table::new(
        "Requests in time, by robot",
        "robot | asks | accepts (ms) | in time, controller off | in time, controller on | \
         p50, off (ms) | p50, on (ms) | p95, off (ms) | p95, on (ms) | p99, off (ms) | p99, on (ms)",
    );
    let mut bars = Vec::new();
    for robots in runs.fleet_sizes() {
        let both = BOTH.map(|controller| runs.find_run(controller, robots));
        for number in 0..robots {
            let had = both.iter().flatten().find_map(|runs| runs.first()?.get(number));
            let Some(had) = had else { continue };
            let figure = |find: &dyn Fn(&RobotOutcome) -> Option<f64>| {
                both.map(|runs| runs.and_then(|runs| runs.figure(|all| find(all.get(number)?))))
            };
            let mut row = vec![format!("{} of {robots}", number + 1)];
            row.push(if had.eager { "at once" } else { "seldom" }.to_owned());
            row.push(milliseconds(Spread::from_values(&[had.accepts])));
            row.extend(figure(&RobotOutcome::share_in_time).map(percent));
            for fraction in crate::words::PERCENTILES {
                row.extend(figure(&|had| quantile(&had.times, fraction)).map(milliseconds));
            }
            table.push(row);
        }
        for (controller, runs) in BOTH.into_iter().zip(both) {
            let in_time = runs.and_then(|runs| runs.figure(|all| Some(count_in_time(all))));
            bars.extend(in_time.map(|in_time| {
                let (group, name) = (format!("{robots} robots"), format!("controller {}", controller.name()));
                Bar { spread: Some((in_time.low, in_time.high)), ..Bar::new(group, name, in_time.median) }
            }));
        }
    }
    for (plan, measured) in &runs.0 {
        let controller = plan.controller.name();
        measured.require(section, &format!("{} robots with mixed agreements, controller {controller}", plan.robots));
    }
    section.tables.push(table);
    let caption = "Robots that are served in time, with mixed agreements";
    section.add_drawing("agreements", caption, plots::bars(caption, "robots in time", &bars, false));
    section.findings.extend(runs.finding());
}

fn count_in_time(all: &[RobotOutcome]) -> f64 {
    all.iter().filter(|had| had.is_in_time()).count() as f64
}

impl AgreementRuns {
    fn fleet_sizes(&self) -> Vec<usize> {
        let mut numbers: Vec<usize> = self.0.iter().map(|(plan, _)| plan.robots).collect();
        numbers.sort_unstable();
        numbers.dedup();
        numbers
    }

    fn find_run(&self, controller: Controller, robots: usize) -> Option<&Runs<Vec<RobotOutcome>>> {
        let found = self.0.iter().find(|(plan, _)| plan.controller == controller && plan.robots == robots);
        Some(&found?.1).filter(|runs| !runs.done.is_empty())
    }

    /// Sums up the fleets that were measured both ways, run by run.
    fn finding(&self) -> Option<String> {
        let sizes = self.fleet_sizes();
        let both = |robots: &usize| BOTH.iter().all(|controller| self.find_run(*controller, *robots).is_some());
        let sizes: Vec<usize> = sizes.into_iter().filter(both).collect();
        let all: usize = sizes.iter().sum();
        let sum = |controller, find: &dyn Fn(&[&Vec<RobotOutcome>]) -> Option<f64>| {
            let fleets: Vec<&Runs<_>> = sizes.iter().filter_map(|robots| self.find_run(controller, *robots)).collect();
            let runs = fleets.iter().map(|runs| runs.done.len()).min()?;
            let each = (0..runs).filter_map(|run| find(&fleets.iter().map(|runs| &runs.done[run]).collect::<Vec<_>>()));
            Spread::from_values(&each.collect::<Vec<_>>())
        };
        let in_time =
            |fleets: &[&Vec<RobotOutcome>]| Some(fleets.iter().map(|fleet| count_in_time(fleet)).sum::<f64>());
        let eager = |fleets: &[&Vec<RobotOutcome>]| {
            let eager = fleets.iter().flat_map(|fleet| fleet.iter()).filter(|had| had.eager);
            mean(&eager.filter_map(RobotOutcome::share_in_time).collect::<Vec<_>>())
        };
        let [off, on] = BOTH.map(|controller| sum(controller, &in_time));
        let [eager_off, eager_on] = BOTH.map(|controller| percent(sum(controller, &eager)));
        let (off, on) = off.zip(on)?;
        let beside = if on.median > off.median { "" } else { ": no robot was won, which is worse than hoped" };
        Some(format!(
            "Of {all} robots with mixed agreements in all fleets, {} were served in time with fixed limits and {} with \
             the controller{beside}. Of the requests of eager robots, {eager_off} and {eager_on} were in time \
             (mean of the robots' shares).",
            count(Some(off)),
            count(Some(on))
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::words::assert_tells;

    fn outcome(accepts: f64, times: &[f64]) -> RobotOutcome {
        RobotOutcome { accepts, eager: true, times: times.to_vec() }
    }

    fn section_of(off: [&RobotOutcome; 2], on: [&RobotOutcome; 2]) -> Section {
        let run = |(controller, fleet): (Controller, [&RobotOutcome; 2])| {
            let plan = AgreementPlan { controller, robots: 2, settles: 1.0, lasts: 1.0, work: 50, cores: 2.0 };
            (plan, Runs::from(fleet.map(RobotOutcome::clone).to_vec()))
        };
        let mut section = Section::new(9, "a", "b");
        add_to_section(&AgreementRuns(BOTH.into_iter().zip([off, on]).map(run).collect()), &mut section);
        section
    }

    #[test]
    fn shares_are_of_what_was_asked() {
        assert_eq!(outcome(0.1, &[0.05, 0.1, 0.2, 0.3]).share_in_time(), Some(0.5));
        assert_eq!(outcome(0.1, &[]).share_in_time(), None);
        assert!(!outcome(0.1, &[]).is_in_time() && outcome(0.1, &[0.1]).is_in_time());
    }

    /// Two cores, eight robots: a quarter each, so that 50 ms take 200 ms, and 100 ms with twice the share; 40 % more
    /// are accepted.
    #[test]
    fn eager_robots_accept_less_than_their_part_gives() {
        let terms = AgreementTerms::new(8, 2.0, 0.05);
        assert_eq!(terms.part, 0.25);
        assert!((terms.eager - 0.14).abs() < 1e-9 && (terms.patient - 1.0).abs() < 1e-9);
        assert_eq!(AgreementTerms::new(3, 2.0, 0.05).part, 0.666);
    }

    #[test]
    fn the_controllers_gain_is_counted() {
        let (good, bad) = (&outcome(0.1, &[0.05]), &outcome(0.1, &[0.3]));
        let section = section_of([good, bad], [good, good]);
        assert_tells(&section.findings[0], "1 were served in time with fixed limits and 2 with the controller.");
        assert_tells(&section.findings[0], "50.0 % and 100.0 % were in time");
        assert_eq!(section.tables[0].rows[1][3..7], ["0.0 %", "100.0 %", "300", "50.0"]);
        assert_tells(&section_of([good, good], [bad, bad]).findings[0], "worse than hoped");
    }
}
