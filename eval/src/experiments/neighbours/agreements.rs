//! Robots of one machine that accept different response times: what share of each one's requests is in time, with the controller and
//! with the limits that were promised. All are promised the same part of the machine. Every other robot, beginning with the first, asks
//! again as soon as it is answered and accepts less than its part gives; the others ask seldom and accept more.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use support::daemon::Daemon;

use super::AGAIN;
use crate::cells::{Cells, Measured};
use crate::deadline::Meeting;
use crate::experiments::crowd::{self, Controller, LONG, Yard};
use crate::plots::{self, Bar};
use crate::section::{Missing, Section, Table};
use crate::statistics::{mean, quantile};
use crate::words::{known, milliseconds, ratio};

/// The part of its requests that must be in time for a robot to count.
const IN_TIME: f64 = 0.95;
/// Seconds between an answer and the next request of those that ask seldom.
const SELDOM: f64 = 1.0;
/// For servants that start beside one another, each within the two minutes of its daemon.
const START: Duration = Duration::from_secs(300);
/// Both ways, in the order of the tables.
const BOTH: [Controller; 2] = [Controller::Off, Controller::On];

/// What a run depends on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Plan {
    controller: Controller,
    robots: usize,
    settles: f64,
    lasts: f64,
    work: u32,
    cores: f64,
}

/// What a robot had.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Had {
    /// T_max that it stated, seconds.
    accepts: f64,
    /// Whether it asked without a pause.
    eager: bool,
    /// Of its requests, seconds.
    times: Vec<f64>,
}

impl Had {
    /// The share of its requests that was in time; none where it made none.
    fn share(&self) -> Option<f64> {
        let in_time = self.times.iter().filter(|time| **time <= self.accepts);
        (!self.times.is_empty()).then(|| in_time.count() as f64 / self.times.len() as f64)
    }

    fn in_time(&self) -> bool {
        self.share().is_some_and(|share| share >= IN_TIME)
    }
}

/// All runs.
pub(super) struct Runs(Vec<(Plan, Measured<Vec<Had>>)>);

pub(super) fn measure(cells: &Cells, yard: &mut Yard, quick: bool) -> Result<Runs> {
    let robots: &[usize] = if quick { &[4] } else { &[2, 4, 8] };
    // The controller looks once a second, at what requests took in the last ten.
    let (settles, lasts) = if quick { (1.0, 1.5) } else { (12.0, 9.0) };
    let mut runs = Vec::new();
    for controller in BOTH {
        for robots in robots.iter().copied() {
            let plan = Plan {
                controller,
                robots,
                settles,
                lasts,
                work: LONG.milliseconds,
                cores: crowd::cores(),
            };
            let name = format!("agreements {robots} controller {}", controller.name());
            let measured = cells.measure(&name, &plan, || {
                let daemon = yard.cleared(controller)?;
                crowd::publishes(daemon, LONG)?;
                beside_each_other(daemon, &plan)
            })?;
            runs.push((plan, measured));
        }
    }
    Ok(Runs(runs))
}

/// What one robot is promised, and what eager and patient ones accept, seconds.
fn terms(robots: usize, cores: f64, work: f64) -> (f64, f64, f64) {
    // Rounded down: together no more is promised than there is.
    let part = (cores / robots as f64 * 1000.0).floor() / 1000.0;
    // With twice its part an eager one is in time, if that is not more than its one thread can use.
    let eager = (work / (2.0 * part) * 1.4).max(work * 1.6);
    (part, eager, work / part * 4.0 + 0.2)
}

fn beside_each_other(daemon: &Daemon, plan: &Plan) -> Result<Vec<Had>> {
    let (part, eager, patient) = terms(plan.robots, plan.cores, f64::from(plan.work) / 1e3);
    // All begin together: one that is measured while another's servant still starts has its cores, or lacks them.
    let ready = Meeting::of(plan.robots);
    let one = |number: usize| -> Result<Had> {
        let is_eager = number % 2 == 0;
        let (accepts, pause) = if is_eager {
            (eager, 0.0)
        } else {
            (patient, SELDOM)
        };
        let states = format!("&cpus={part:.3}&max_rrt={:.0}ms", accepts * 1e3);
        let joined = crowd::joins(daemon, LONG, &format!("r{number}"), &states);
        let joined = joined.and_then(|mut robot| crowd::call(&mut robot).map(|_| robot));
        let met = ready.waits(START);
        // Why one has failed tells more than that the others waited for it.
        let mut robot = joined?;
        met?;
        let from = Instant::now() + Duration::from_secs_f64(plan.settles);
        let to = from + Duration::from_secs_f64(plan.lasts);
        Ok(Had {
            accepts,
            eager: is_eager,
            times: crowd::calls(&mut robot, (from, to), || pause)?,
        })
    };
    std::thread::scope(|scope| {
        let all: Vec<_> = (0..plan.robots)
            .map(|number| scope.spawn(move || one(number)))
            .collect();
        let joined = all
            .into_iter()
            .map(|robot| robot.join().ok().context("a robot's thread broke")?);
        joined.collect()
    })
}

pub(super) fn tell(runs: &Runs, section: &mut Section) -> Result<()> {
    section.differs.push(format!(
        "Mixed agreements: robots with equal promises of cores ask for {} ms of one. Every other one asks again at once and accepts \
         less (max_rrt) than its promise gives; the others ask each second and accept more. A robot counts as served in time if {:.0} % \
         of its requests are.",
        LONG.milliseconds,
        IN_TIME * 100.0
    ));
    let mut table = Table::new(
        "Requests in time, by robot",
        [
            "robot",
            "asks",
            "accepts (ms)",
            "in time, controller off (%)",
            "in time, controller on (%)",
            "95 %, off (ms)",
            "95 %, on (ms)",
        ],
    );
    let mut bars = Vec::new();
    for robots in runs.numbers() {
        let both = BOTH.map(|controller| runs.of(controller, robots));
        for number in 0..robots {
            let each = both.map(|all| all.and_then(|all| all.get(number)));
            let Some(had) = each.iter().copied().flatten().next() else {
                continue;
            };
            let share = |had: Option<&Had>| {
                let share = had.and_then(Had::share);
                known(share, |share| format!("{:.0}", share * 100.0))
            };
            let long =
                |had: Option<&Had>| milliseconds(had.and_then(|had| quantile(&had.times, 0.95)));
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
                value: counted(all) as f64,
                spread: None,
            });
        }
    }
    for (plan, measured) in &runs.0 {
        if let Measured::Missing(why) = measured {
            let what = format!(
                "{} robots with mixed agreements, controller {}",
                plan.robots,
                plan.controller.name()
            );
            section.missing.push(Missing::new(what, why, AGAIN));
        }
    }
    section.tables.push(table);
    let caption = "Robots that are served in time, with mixed agreements";
    let drawing = plots::bars(caption, "robots in time", &bars, false)?;
    section.drawing("agreements", caption, drawing);
    runs.find(section);
    Ok(())
}

/// Robots in time.
fn counted(all: &[Had]) -> usize {
    all.iter().filter(|had| had.in_time()).count()
}

impl Runs {
    fn numbers(&self) -> Vec<usize> {
        let mut numbers: Vec<usize> = self.0.iter().map(|(plan, _)| plan.robots).collect();
        numbers.sort_unstable();
        numbers.dedup();
        numbers
    }

    fn of(&self, controller: Controller, robots: usize) -> Option<&Vec<Had>> {
        let mut all = self.0.iter();
        let found = all.find(|(plan, _)| plan.controller == controller && plan.robots == robots);
        found?.1.done()
    }

    fn find(&self, section: &mut Section) {
        let (mut counts, mut of) = ([0; 2], 0);
        let mut eager: [Vec<f64>; 2] = Default::default();
        for robots in self.numbers() {
            let [Some(off), Some(on)] = BOTH.map(|controller| self.of(controller, robots)) else {
                continue;
            };
            counts = [counts[0] + counted(off), counts[1] + counted(on)];
            of += robots;
            for (shares, all) in eager.iter_mut().zip([off, on]) {
                shares.extend(all.iter().filter(|had| had.eager).filter_map(Had::share));
            }
        }
        if of == 0 {
            return;
        }
        let [off, on] = counts;
        section.findings.push(format!(
            "Of {of} robots with mixed agreements in all runs, {off} were served in time with fixed limits and {on} with the controller{}",
            match on.cmp(&off) {
                std::cmp::Ordering::Greater if off > 0 => format!(
                    ": {} times as many, because what those that ask seldom leave is given to those that are near what they accept.",
                    ratio(Some(on as f64 / off as f64))
                ),
                std::cmp::Ordering::Greater =>
                    ": what those that ask seldom leave is given to those that are near what they accept.".to_owned(),
                std::cmp::Ordering::Equal if on == of =>
                    ": there was nothing to be gained, because each robot's promise was enough.".to_owned(),
                std::cmp::Ordering::Equal =>
                    ": the controller won no robot here, which is worse than hoped.".to_owned(),
                std::cmp::Ordering::Less =>
                    ", which is worse than hoped: robots lost what they had while cores were moved to others.".to_owned(),
            }
        ));
        if let [Some(off), Some(on)] = eager.map(|shares| mean(&shares)) {
            section.findings.push(format!(
                "Of the requests of those that ask at once and accept less than they were promised, {:.0} % were in time with fixed \
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

    fn had(accepts: f64, times: &[f64]) -> Had {
        Had {
            accepts,
            eager: true,
            times: times.to_vec(),
        }
    }

    fn runs(off: Vec<Had>, on: Vec<Had>) -> Runs {
        let plan = |controller| Plan {
            controller,
            robots: 2,
            settles: 1.0,
            lasts: 1.0,
            work: 50,
            cores: 2.0,
        };
        Runs(vec![
            (plan(Controller::Off), Measured::Done(off)),
            (plan(Controller::On), Measured::Done(on)),
        ])
    }

    #[test]
    fn shares_are_of_what_was_asked() {
        assert_eq!(had(0.1, &[0.05, 0.1, 0.2, 0.3]).share(), Some(0.5));
        assert_eq!(had(0.1, &[]).share(), None);
        assert!(!had(0.1, &[]).in_time() && had(0.1, &[0.1]).in_time());
    }

    /// Two cores, eight robots: a quarter each, so that 50 ms take 200 ms; with twice that 100 ms, and 40 % more are accepted.
    #[test]
    fn eager_robots_accept_less_than_their_part_gives() {
        let (part, eager, patient) = terms(8, 2.0, 0.05);
        assert_eq!(part, 0.25);
        assert!((eager - 0.14).abs() < 1e-9 && (patient - 1.0).abs() < 1e-9);
        assert_eq!(terms(3, 2.0, 0.05).0, 0.666);
    }

    #[test]
    fn the_controllers_gain_is_counted() {
        let (good, bad) = (had(0.1, &[0.05]), had(0.1, &[0.3]));
        let mut section = Section::new(9, "a", "b");
        let gained = runs(
            vec![good.clone(), bad.clone()],
            vec![good.clone(), good.clone()],
        );
        tell(&gained, &mut section).expect("it is told");
        let found = &section.findings[0];
        assert!(
            found.contains("1 were served") && found.contains("2.0 times as many"),
            "{found}"
        );
        assert_eq!(section.tables[0].rows[1][3..5], ["0", "100"]);
        assert!(
            section.findings[1].contains("50 % were in time")
                && section.findings[1].contains("100 % with"),
            "{:?}",
            section.findings
        );
        let mut section = Section::new(9, "a", "b");
        tell(
            &runs(vec![good.clone(), good], vec![bad.clone(), bad]),
            &mut section,
        )
        .expect("it is told");
        assert!(
            section.findings[0].contains("worse than hoped"),
            "{:?}",
            section.findings
        );
    }
}
