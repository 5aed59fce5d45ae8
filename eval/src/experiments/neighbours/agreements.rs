//! Robots of one machine that accept different response times: the fraction of each robot's requests that are in time,
//! with the controller and with fixed limits as promised. All robots are promised an equal share of the machine. Every
//! other robot, beginning with the first, calls again as soon as it is answered and accepts a shorter response time
//! than its share allows; the others call rarely and accept a longer one.

use std::sync::Barrier;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use support::daemon::Daemon;

use super::AGAIN;
use crate::cells::{CachedResult, RunCache};
use crate::experiments::crowd::{self, Controller, CrowdDaemon, LONG};
use crate::plots::{self, Bar};
use crate::section::{Section, Table};
use crate::statistics::{mean, quantile};
use crate::words::{milliseconds, or_dash, ratio};

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
pub(super) struct AgreementRuns(Vec<(AgreementPlan, CachedResult<Vec<RobotOutcome>>)>);

pub(super) fn measure(cells: &RunCache, yard: &mut CrowdDaemon, quick: bool) -> Result<AgreementRuns> {
    let robots: &[usize] = if quick { &[4] } else { &[2, 3, 4, 5, 6, 7, 8] };
    // Once a second the controller examines the requests of the last ten seconds.
    let (settles, lasts) = if quick { (1.0, 1.5) } else { (12.0, 9.0) };
    let mut runs = Vec::new();
    for controller in BOTH {
        for robots in robots.iter().copied() {
            let plan =
                AgreementPlan { controller, robots, settles, lasts, work: LONG.milliseconds, cores: crowd::cores() };
            let name = format!("agreements {robots} controller {}", controller.name());
            let measured = cells.measure(&name, &plan, || {
                let daemon = yard.without_servants(controller)?;
                crowd::publish(daemon, LONG)?;
                run_robots(daemon, &plan)
            })?;
            runs.push((plan, measured));
        }
    }
    Ok(AgreementRuns(runs))
}

/// Returns the cores that each robot is promised, and the seconds that eager and patient robots accept.
fn agreement_terms(robots: usize, cores: f64, work: f64) -> (f64, f64, f64) {
    // Rounded down so that the promises never add up to more than the machine has.
    let part = (cores / robots as f64 * 1000.0).floor() / 1000.0;
    // With twice its share an eager robot is in time, unless that is more than its single thread can use.
    let eager = (work / (2.0 * part) * 1.4).max(work * 1.6);
    (part, eager, work / part * 4.0 + 0.2)
}

fn run_robots(daemon: &Daemon, plan: &AgreementPlan) -> Result<Vec<RobotOutcome>> {
    let (part, eager, patient) = agreement_terms(plan.robots, plan.cores, f64::from(plan.work) / 1e3);
    // All start together: a robot measured while another's servant is still starting would have that servant's cores,
    // or lack them.
    let ready = Barrier::new(plan.robots);
    let one = |number: usize| -> Result<RobotOutcome> {
        let is_eager = number % 2 == 0;
        let (accepts, pause) = if is_eager { (eager, 0.0) } else { (patient, SELDOM) };
        let states = format!("&cpus={part:.3}&max_rrt={:.0}ms", accepts * 1e3);
        let joined = crowd::join(daemon, LONG, &format!("r{number}"), &states);
        let joined = joined.and_then(|mut robot| crowd::time_call(&mut robot).map(|_| robot));
        // Robots that failed have come as well.
        ready.wait();
        let mut robot = joined?;
        let from = Instant::now() + Duration::from_secs_f64(plan.settles);
        let to = from + Duration::from_secs_f64(plan.lasts);
        Ok(RobotOutcome { accepts, eager: is_eager, times: crowd::time_calls(&mut robot, (from, to), || pause)? })
    };
    std::thread::scope(|scope| {
        let all: Vec<_> = (0..plan.robots).map(|number| scope.spawn(move || one(number))).collect();
        let joined = all.into_iter().map(|robot| robot.join().ok().context("a robot's thread broke")?);
        joined.collect()
    })
}

pub(super) fn add_to_section(runs: &AgreementRuns, section: &mut Section) -> Result<()> {
    section.differs.push(format!(
        "Mixed agreements: robots with equal promises of cores ask for {} ms of one. Every other one asks again at \
         once and accepts \
         less (max_rrt) than its promise gives; the others ask each second and accept more. A robot counts as served \
         in time if {:.0} % \
         of its requests are.",
        LONG.milliseconds,
        IN_TIME * 100.0
    ));
    let mut table = Table::new(
        "Requests in time, by robot",
        "robot | asks | accepts (ms) | in time, controller off (%) | in time, controller on (%) | \
         95 %, off (ms) | 95 %, on (ms)",
    );
    let mut bars = Vec::new();
    for robots in runs.fleet_sizes() {
        let both = BOTH.map(|controller| runs.find_run(controller, robots));
        for number in 0..robots {
            let each = both.map(|all| all.and_then(|all| all.get(number)));
            let Some(had) = each.iter().copied().flatten().next() else {
                continue;
            };
            let share = |had: Option<&RobotOutcome>| {
                let share = had.and_then(RobotOutcome::share_in_time);
                or_dash(share, |share| format!("{:.0}", share * 100.0))
            };
            let long = |had: Option<&RobotOutcome>| milliseconds(had.and_then(|had| quantile(&had.times, 0.95)));
            table.push([
                format!("{} of {robots}", number + 1),
                if had.eager { "at once" } else { "seldom" }.to_owned(),
                milliseconds(Some(had.accepts)),
                share(each[0]),
                share(each[1]),
                long(each[0]),
                long(each[1]),
            ]);
        }
        for (controller, all) in BOTH.into_iter().zip(both) {
            let Some(all) = all else { continue };
            bars.push(Bar {
                group: format!("{robots} robots"),
                name: format!("controller {}", controller.name()),
                value: count_in_time(all) as f64,
                spread: None,
            });
        }
    }
    for (plan, measured) in &runs.0 {
        let what = format!("{} robots with mixed agreements, controller {}", plan.robots, plan.controller.name());
        measured.require(section, what, AGAIN);
    }
    section.tables.push(table);
    let caption = "Robots that are served in time, with mixed agreements";
    let drawing = plots::bars(caption, "robots in time", &bars, false)?;
    section.add_drawing("agreements", caption, drawing);
    runs.add_findings(section);
    Ok(())
}

/// Counts the robots in time.
fn count_in_time(all: &[RobotOutcome]) -> usize {
    all.iter().filter(|had| had.is_in_time()).count()
}

impl AgreementRuns {
    fn fleet_sizes(&self) -> Vec<usize> {
        let mut numbers: Vec<usize> = self.0.iter().map(|(plan, _)| plan.robots).collect();
        numbers.sort_unstable();
        numbers.dedup();
        numbers
    }

    fn find_run(&self, controller: Controller, robots: usize) -> Option<&Vec<RobotOutcome>> {
        let mut all = self.0.iter();
        let found = all.find(|(plan, _)| plan.controller == controller && plan.robots == robots);
        found?.1.value()
    }

    fn add_findings(&self, section: &mut Section) {
        let (mut counts, mut of) = ([0; 2], 0);
        let mut eager: [Vec<f64>; 2] = Default::default();
        for robots in self.fleet_sizes() {
            let [Some(off), Some(on)] = BOTH.map(|controller| self.find_run(controller, robots)) else {
                continue;
            };
            counts = [counts[0] + count_in_time(off), counts[1] + count_in_time(on)];
            of += robots;
            for (shares, all) in eager.iter_mut().zip([off, on]) {
                shares.extend(all.iter().filter(|had| had.eager).filter_map(RobotOutcome::share_in_time));
            }
        }
        if of == 0 {
            return;
        }
        let [off, on] = counts;
        section.findings.push(format!(
            "Of {of} robots with mixed agreements in all runs, {off} were served in time with fixed limits and {on} \
             with the controller{}",
            match on.cmp(&off) {
                std::cmp::Ordering::Greater if off > 0 => format!(
                    ": {} times as many, because what those that ask seldom leave is given to those that are near what \
                     they accept.",
                    ratio(Some(on as f64 / off as f64))
                ),
                std::cmp::Ordering::Greater =>
                    ": what those that ask seldom leave is given to those that are near what they accept.".to_owned(),
                std::cmp::Ordering::Equal if on == of =>
                    ": there was nothing to be gained, because each robot's promise was enough.".to_owned(),
                std::cmp::Ordering::Equal =>
                    ": the controller won no robot here, which is worse than hoped.".to_owned(),
                std::cmp::Ordering::Less =>
                    ", which is worse than hoped: robots lost what they had while cores were moved to \
                     others."
                        .to_owned(),
            }
        ));
        if let [Some(off), Some(on)] = eager.map(|shares| mean(&shares)) {
            section.findings.push(format!(
                "Of the requests of those that ask at once and accept less than they were promised, {:.0} % were in \
                 time with fixed \
                 limits and {:.0} % with the controller (mean of the robots' shares).",
                off * 100.0,
                on * 100.0
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::words::assert_tells;

    fn outcome(accepts: f64, times: &[f64]) -> RobotOutcome {
        RobotOutcome { accepts, eager: true, times: times.to_vec() }
    }

    fn test_runs(off: Vec<RobotOutcome>, on: Vec<RobotOutcome>) -> AgreementRuns {
        let plan = |controller| AgreementPlan { controller, robots: 2, settles: 1.0, lasts: 1.0, work: 50, cores: 2.0 };
        AgreementRuns(vec![
            (plan(Controller::Off), CachedResult::Done(off)),
            (plan(Controller::On), CachedResult::Done(on)),
        ])
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
        let (part, eager, patient) = agreement_terms(8, 2.0, 0.05);
        assert_eq!(part, 0.25);
        assert!((eager - 0.14).abs() < 1e-9 && (patient - 1.0).abs() < 1e-9);
        assert_eq!(agreement_terms(3, 2.0, 0.05).0, 0.666);
    }

    #[test]
    fn the_controllers_gain_is_counted() {
        let (good, bad) = (outcome(0.1, &[0.05]), outcome(0.1, &[0.3]));
        let mut section = Section::new(9, "a", "b");
        let gained = test_runs(vec![good.clone(), bad.clone()], vec![good.clone(), good.clone()]);
        add_to_section(&gained, &mut section).expect("it is told");
        let found = &section.findings[0];
        assert!(found.contains("1 were served") && found.contains("2.0 times as many"), "{found}");
        assert_eq!(section.tables[0].rows[1][3..5], ["0", "100"]);
        assert!(
            section.findings[1].contains("50 % were in time") && section.findings[1].contains("100 % with"),
            "{:?}",
            section.findings
        );
        let mut section = Section::new(9, "a", "b");
        add_to_section(&test_runs(vec![good.clone(), good], vec![bad.clone(), bad]), &mut section).expect("it is told");
        assert_tells(&section.findings[0], "worse than hoped");
    }
}
