//! Section of the report on scaling.

mod model;

use std::collections::BTreeMap;

use super::{ABOUT, ScalePlan, ScalePoint, ScaleRuns};
use crate::cells::Runs;
use crate::plots::{self, Series};
use crate::section::{AGAIN, Section, Table};
use crate::statistics::{NodeModel, QueueObservation, Spread, mean, median};
use crate::words::{count, digits, milliseconds, or_dash, ratio, spread};

/// Ratio to the median of a single robot from which on response times count as risen.
const BENT: f64 = 2.0;
/// Use of the cores from which on they count as exhausted, and by other programs from which on a run counts as
/// disturbed.
const FULL: f64 = 0.85;
const OTHERS: f64 = 0.25;
const MEGA: f64 = 1e6;

/// A point, and its use in the model.
struct ReportedPoint<'a> {
    plan: &'a ScalePlan,
    runs: &'a Runs<ScalePoint>,
    /// True if the point was held back when the model was fitted.
    held_back: bool,
}

impl ReportedPoint<'_> {
    fn robots(&self) -> f64 {
        self.plan.robots as f64
    }

    fn figure(&self, find: impl Fn(&ScalePoint) -> f64) -> Option<Spread> {
        self.runs.figure(|point| Some(find(point)).filter(|value| value.is_finite()))
    }

    /// Returns the median of a figure that every run has.
    fn typical(&self, find: impl Fn(&ScalePoint) -> f64) -> f64 {
        self.figure(find).map_or(f64::NAN, |figure| figure.median)
    }

    fn mean_response(&self) -> Option<Spread> {
        self.runs.figure(|point| mean(&point.times))
    }

    /// Returns what the model is fitted to, run by run.
    fn observations(&self) -> impl Iterator<Item = QueueObservation> {
        self.runs.done.iter().filter_map(|point| {
            let busy = point.used.request_cores() / self.plan.cores;
            Some(QueueObservation { robots: self.plan.robots as u64, response: mean(&point.times)?, busy })
        })
    }

    /// Memory per robot in bytes: the decrease of available memory, or the servants' cgroups if that is more.
    fn memory_per_robot(&self) -> f64 {
        self.typical(|point| point.taken.max(point.servants_memory)) / self.robots()
    }

    fn busy_share(&self) -> f64 {
        self.typical(|point| point.used.machine) / self.plan.cores
    }

    /// Returns the fraction of core time used by other programs, and by the kernel on behalf of none.
    fn other_share(&self) -> f64 {
        self.typical(|point| point.used.machine - point.used.request_cores()) / self.plan.cores
    }
}

pub fn section(runs: &ScaleRuns) -> Section {
    let mut section = ABOUT.section();
    let mut told = Vec::new();
    for (index, (plan, runs)) in runs.0.iter().enumerate() {
        if runs.require(&mut section, &format!("{} robots", plan.robots)).is_some() {
            told.push(ReportedPoint { plan, runs, held_back: index % 2 == 1 });
        }
    }
    if told.is_empty() {
        return section;
    }
    let fitted = told.iter().filter(|one| !one.held_back);
    let is_enough = fitted.clone().count() > 1;
    let observations: Vec<QueueObservation> = fitted.flat_map(ReportedPoint::observations).collect();
    let node = NodeModel::fit(&observations, told[0].plan.cores, told[0].plan.think).filter(|_| is_enough);
    add_starts(&told, &mut section);
    add_points(&told, node.as_ref(), &mut section);
    add_costs(&told, &mut section);
    add_bend(&told, node.as_ref(), &mut section);
    match &node {
        Some(node) => model::add_model(&told, node, &mut section),
        None => {
            let why = "fewer than two of the points that determine it were measured";
            section.add_missing("the queueing model", why, AGAIN);
        }
    }
    section
}

/// Start times of each robot's servant, by the robot's number. After an interrupted evaluation all robots reconnect: of
/// two starts in a run, the first counts.
fn first_starts(told: &[ReportedPoint]) -> BTreeMap<usize, Vec<f64>> {
    let mut all: BTreeMap<usize, BTreeMap<usize, f64>> = BTreeMap::new();
    for one in told {
        for (run, point) in one.runs.done.iter().enumerate() {
            for (number, time) in &point.starts {
                all.entry(*number).or_default().entry(run).or_insert(*time);
            }
        }
    }
    all.into_iter().map(|(number, times)| (number, times.into_values().collect())).collect()
}

fn add_starts(told: &[ReportedPoint], section: &mut Section) {
    let all: Vec<(usize, f64)> =
        first_starts(told).into_iter().filter_map(|(number, times)| Some((number, median(&times)?))).collect();
    let times: Vec<f64> = all.iter().map(|(_, time)| *time).collect();
    let mut table = Table::new(
        "Start of a servant, until it has answered a first call (s): medians of the runs, over all servants",
        "figure | published | here | servants started",
    );
    let most = times.iter().copied().reduce(f64::max);
    for (name, value) in [("median", median(&times)), ("slowest", most)] {
        table.push([name.to_owned(), "over 5".to_owned(), or_dash(value, digits), times.len().to_string()]);
    }
    section.tables.push(table);
    let caption = "Start of the next servant";
    let series = [Series::new("", all.iter().map(|(number, time)| (*number as f64, *time)).collect())];
    section.add_drawing(
        "scale-starts",
        caption,
        plots::points(caption, "servants on the node", "start (s)", &series, false),
    );
    let tenth = (times.len() / 10).max(1);
    let [first, last] = [&times[..tenth], &times[times.len() - tenth..]].map(Spread::from_values);
    section.findings.push(format!(
        "A new servant has answered its robot's first call after {} ms on an empty node (the first {tenth}) and after \
         {} ms on a full one (the last {tenth}); over 5 s were published.",
        milliseconds(first),
        milliseconds(last)
    ));
}

fn add_points(told: &[ReportedPoint], node: Option<&NodeModel>, section: &mut Section) {
    let mut table = Table::new(
        "Response times",
        "robots | for the model | requests a second | p50 (ms) | p95 (ms) | p99 (ms) | mean (ms) | \
         the model's mean (ms) | its error (%) | machine busy (%)",
    );
    for one in told {
        let predicted = node.map(|node| node.predict(one.plan.robots as u64).response);
        let error = predicted.zip(one.mean_response()).map(|(predicted, mean)| predicted / mean.median - 1.0);
        let mut row = vec![one.plan.robots.to_string()];
        row.push(if one.held_back { "held back" } else { "fitted" }.to_owned());
        row.push(spread(one.figure(|point| point.times.len() as f64 / point.lasted), digits));
        row.extend(one.runs.percentiles(|point| point.times.clone()).map(milliseconds));
        row.push(milliseconds(one.mean_response()));
        row.push(or_dash(predicted, |predicted| digits(predicted * 1e3)));
        row.push(or_dash(error, |error| format!("{:+.1}", error * 100.0)));
        row.push(count(one.figure(|point| 100.0 * point.used.machine / one.plan.cores)));
        table.push(row);
    }
    section.tables.push(table);
}

fn add_costs(told: &[ReportedPoint], section: &mut Section) {
    let mut table = Table::new(
        "What a robot costs",
        "robots | memory of its servant (MB) | memory that the machine has less (MB) | \
         processor per request: servant (ms) | daemon (ms) | robot (ms)",
    );
    for one in told {
        let each = |cores: fn(&ScalePoint) -> f64| {
            milliseconds(one.figure(|point| cores(point) * point.lasted / point.times.len() as f64))
        };
        table.push([
            one.plan.robots.to_string(),
            spread(one.figure(|point| point.servants_memory / one.robots() / MEGA), digits),
            spread(one.figure(|point| point.taken / one.robots() / MEGA), digits),
            each(|point| point.used.servants),
            each(|point| point.used.daemon),
            each(|point| point.used.robots),
        ]);
    }
    section.tables.push(table);
    let line = |name: &str, bytes: fn(&ScalePoint) -> f64| {
        Series::new(name, told.iter().map(|one| (one.robots(), one.typical(bytes) / MEGA)).collect())
    };
    let caption = "Memory of all robots together";
    let series = [
        line("less on the machine", |point| point.taken),
        line("control groups of servants", |point| point.servants_memory),
    ];
    section.add_drawing("scale-memory", caption, plots::lines(caption, "robots", "memory (MB)", &series, false));
}

/// Reports where the response time begins to rise, and what is used up there.
fn add_bend(told: &[ReportedPoint], node: Option<&NodeModel>, section: &mut Section) {
    let times: Vec<Option<Spread>> = told.iter().map(|one| one.runs.figure(|point| median(&point.times))).collect();
    let Some(alone) = times[0] else { return };
    let bent = times.iter().position(|time| time.is_some_and(|time| time.median >= BENT * alone.median));
    let place = bent.unwrap_or(told.len() - 1);
    let (at, last) = (&told[place], &told[told.len() - 1]);
    let knee = node.map(|node| format!(" By the model robots begin to wait for one another at {:.0}.", node.knee()));
    section.findings.push(format!(
        "{} {} robots the median is {} times that of {}: the cores are {:.0} % busy, {:.0} % of the memory is used. \
         Memory, {} MB for each robot, would be enough for {} robots.{}",
        if bent.is_some() { "At" } else { "The curve does not bend: at" },
        at.plan.robots,
        ratio(times[place].and_then(|time| Spread::from_values(&[time.median / alone.median]))),
        told[0].plan.robots,
        at.busy_share() * 100.0,
        100.0 * (1.0 - at.typical(|point| point.left.0 / point.left.1)),
        digits(last.memory_per_robot() / MEGA),
        model::robots_in_memory(last),
        knee.unwrap_or_default()
    ));
    let most = told.iter().map(ReportedPoint::other_share).fold(0.0, f64::max);
    if most >= OTHERS {
        section.findings.push(format!(
            "Other programs used up to {:.0} % of the cores' time meanwhile: times and the model's error are worse \
             than on a quiet machine. make eval ONLY=10 FRESH=1 measures again.",
            most * 100.0
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::scale::THINK;
    use crate::experiments::scale::counters::CoreUsage;
    use crate::words::assert_tells;

    const ALL: [usize; 8] = [1, 2, 4, 8, 16, 32, 64, 100];
    /// A known node: 2 cores, 10 ms of a core per request, of which the robot uses 1 ms, and 2 ms of delay.
    const NODE: NodeModel = NodeModel { cores: 2.0, think: THINK, service: 0.010, delay: 0.002 };

    fn measured_point(robots: usize) -> (ScalePlan, Runs<ScalePoint>) {
        let plan = ScalePlan { robots, settles: 1.0, lasts: 10.0, think: THINK, work: 8, cores: 2.0 };
        let closed = NODE.predict(robots as u64);
        let used = closed.busy * 2.0;
        let point = ScalePoint {
            starts: vec![(robots, 0.3)],
            times: vec![closed.response; (closed.throughput * 10.0).round() as usize],
            lasted: 10.0,
            used: CoreUsage { machine: used, daemon: used * 0.1, servants: used * 0.8, robots: used * 0.1 },
            servants_memory: robots as f64 * 20e6,
            taken: robots as f64 * 25e6,
            left: (16e9 - robots as f64 * 25e6, 20e9),
            admits: 200,
        };
        (plan, Runs::from(point))
    }

    fn section_for(robots: &[usize]) -> Section {
        section(&ScaleRuns(robots.iter().map(|robots| measured_point(*robots)).collect()))
    }

    fn finding<'a>(section: &'a Section, word: &str) -> &'a str {
        let found = section.findings.iter().find(|finding| finding.contains(word));
        found.unwrap_or_else(|| panic!("{word}: {:#?}", section.findings))
    }

    #[test]
    fn the_model_is_checked_where_it_was_not_fitted() {
        let section = section_for(&ALL);
        let model = finding(&section, "closed queue");
        assert_tells(model, "of 2 cores, with 10.00 ms of a core and 2.00");
        assert_tells(model, "within 0.0 % on average, 0.0 % at most");
        assert_eq!([1, 2].map(|row| section.tables[1].rows[row][1].as_str()), ["held back", "fitted"]);
        assert!(section.missing.is_empty());
    }

    /// 9 ms of a core without the robots: 222 requests per second, of which each robot, with a request every 0.3 s,
    /// makes 3.3, so 66.7 robots; with random arrivals somewhat fewer.
    #[test]
    fn nodes_are_counted_by_what_is_scarce() {
        let section = section_for(&ALL);
        let table = section.tables.last().expect("nodes");
        let each: u64 = table.rows[0][1].parse().expect("a number");
        assert!((60..=67).contains(&each), "{each}");
        assert_eq!(table.rows[0][2..4], ["720", "200"]);
        assert_eq!(table.rows[1][4], 100_000u64.div_ceil(each).to_string());
        assert_tells(finding(&section, "100000 such robots"), "its processor serves");
    }

    #[test]
    fn the_bend_and_what_is_used_up_are_told() {
        let section = section_for(&ALL);
        let bend = finding(&section, "times that of");
        assert_tells(bend, "At 64 robots the median is 10.0 times that of 1: the cores are 100 % busy");
        // This number stands in the table of nodes, too.
        assert_tells(bend, "would be enough for 720 robots");
        assert_tells(finding(&section, "first call"), "after 300 ms on an empty node (the first 1) and");
        assert!(!section.findings.iter().any(|words| words.contains("Other programs")));
        let few = section_for(&[1, 2, 4]);
        assert_tells(finding(&few, "does not bend"), "at 4 robots");
        assert!(few.differs.iter().any(|words| words.contains("was not checked")));
    }

    #[test]
    fn a_machine_that_is_not_quiet_is_told_of() {
        let mut runs = ScaleRuns(ALL.map(measured_point).into());
        runs.0.iter_mut().for_each(|(_, runs)| runs.done[0].used.machine = 2.0);
        let section = section(&runs);
        assert!(finding(&section, "Other programs used up to 9").contains("FRESH=1"));
    }

    #[test]
    fn what_is_missing_is_named_and_the_rest_is_told() {
        let mut runs = ScaleRuns([1, 2, 4].map(measured_point).into());
        runs.0[2].1 = Runs::from_failure("no room");
        let section = section(&runs);
        let whats: Vec<&str> = section.missing.iter().map(|one| one.what.as_str()).collect();
        assert_eq!(whats, ["4 robots", "the queueing model"]);
        assert_eq!(section.tables[0].rows[0][1..3], ["over 5", "0.30"]);
    }

    /// As after an evaluation that was interrupted after the first two points.
    #[test]
    fn a_robot_that_came_anew_is_counted_once() {
        let mut runs = ScaleRuns([1, 2, 4].map(measured_point).into());
        let starts = [vec![(1, 0.1)], vec![(2, 0.2)], [1, 2, 3, 4].map(|number| (number, 0.5)).to_vec()];
        for ((_, runs), starts) in runs.0.iter_mut().zip(starts) {
            runs.done[0].starts = starts;
        }
        let section = section(&runs);
        assert_eq!(section.tables[0].rows[0][2..], ["0.35", "4"]);
        assert_eq!(section.tables[0].rows[1][2], "0.50");
    }
}
