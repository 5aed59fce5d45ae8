//! Time that the controller needs per decision for a thousand servants, beside a single pass over the same facts.

use std::hint::black_box;
use std::time::{Duration, Instant};

use anyhow::Result;
use bench_report::{BenchReport, Race, Target};
use choreographer::controller::{ControlFacts, MeasuredTimes, ResponseGoal, control};

const SERVANTS: u64 = 1000;
/// Capacity in thousandths of a core; two cores per servant would leave far too few.
const CORES: u64 = 256_000;
const ROUNDS: usize = 200;

pub(crate) fn measure(report: &mut BenchReport) -> Result<()> {
    let ids: Vec<String> = (0..SERVANTS).map(|number| format!("servant-{number}")).collect();
    let mut facts: Vec<ControlFacts<'_>> = ids.iter().zip(0..).map(|(id, number)| servant_facts(id, number)).collect();
    let began = Instant::now();
    let (pass, once) = (facts.clone(), facts.clone());
    let mut race = Race::new(ROUNDS);
    // In the first decision nearly every servant changes; in later ones few do.
    race.add("at first", || {
        black_box(control(CORES, black_box(&once), began));
    });
    let mut look = 0u32;
    race.add("later", || {
        look += 1;
        let outcomes = control(CORES, &facts, began + Duration::from_secs(1) * look);
        for (one, outcome) in facts.iter_mut().zip(outcomes) {
            one.quota = outcome.quota.unwrap_or(one.quota);
            one.weight = outcome.weight.unwrap_or(one.weight);
            one.history = outcome.history;
        }
    });
    race.add("one pass", || {
        let sum =
            |sum: u64, one: &ControlFacts<'_>| sum + one.quota + one.weight + one.used.unwrap_or(0) + one.promised;
        black_box(black_box(&pass).iter().fold(0, sum));
    });
    let times = race.run();
    let milliseconds = |index: usize| times[index].best_micros() / 1000.0;
    for (index, what) in ["nearly all change", "few change"].into_iter().enumerate() {
        let figure = report.figure(format!("decide on {SERVANTS} servants, {what}"), "ms", milliseconds(index));
        figure.relative_to("one pass over the facts", milliseconds(2)).require(Target::AtMost(1.0));
    }
    Ok(())
}

/// Facts of one servant. Of three servants, one is promised cores, one has response times, one is best effort.
fn servant_facts(id: &str, number: u64) -> ControlFacts<'_> {
    let promised = if number % 3 == 2 { 0 } else { 100 + number % 200 };
    let limit = if promised == 0 { CORES } else { promised };
    ControlFacts {
        id,
        promised,
        limit,
        plain: promised.max(100),
        ceiling: CORES,
        weighed: false,
        quota: limit,
        weight: promised.max(100),
        used: Some(number * 37 % 400),
        throttled: (number % 5) as f64 / 10.0,
        waited: 0.0,
        goal: (number % 3 == 1).then_some(ResponseGoal { desire: Some(100.0), max: Some(300.0) }),
        measured: (number % 2 == 0)
            .then_some(MeasuredTimes { total: (number % 40) as f64 * 10.0, cloud: (number % 40) as f64 * 8.0 }),
        history: Default::default(),
    }
}
