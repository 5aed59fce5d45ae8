//! Section of the report on scaling.

mod model;

use std::collections::BTreeMap;

use anyhow::Result;

use super::{ScalePlan, ScalePoint, ScaleRuns, THINK};
use crate::experiments::crowd::SHORT;
use crate::plots::{self, Series};
use crate::section::{MissingMeasurement, Section, Table};
use crate::statistics::{NodeModel, QueueObservation, mean, median, quantile};
use crate::words::{digits, milliseconds, or_dash, ratio};

/// Ratio to the median of a single robot from which on response times count as risen.
const BENT: f64 = 2.0;
/// Use of a resource from which on it counts as exhausted.
const FULL: f64 = 0.85;
/// Use of the cores by other programs from which on a run counts as disturbed.
const OTHERS: f64 = 0.25;
const MEGA: f64 = 1e6;

/// A point, and its use in the model.
struct ReportedPoint<'a> {
    plan: &'a ScalePlan,
    point: &'a ScalePoint,
    /// True if the point was held back when the model was fitted.
    held_back: bool,
}

impl ReportedPoint<'_> {
    fn robots(&self) -> f64 {
        self.plan.robots as f64
    }

    fn mean_response(&self) -> Option<f64> {
        mean(&self.point.times)
    }

    fn observation(&self) -> Option<QueueObservation> {
        Some(QueueObservation {
            robots: self.plan.robots as u64,
            response: self.mean_response()?,
            busy: self.point.used.request_cores() / self.plan.cores,
        })
    }

    /// Memory per robot in bytes: the decrease of available memory, or the servants' cgroups if that is more.
    fn memory_per_robot(&self) -> f64 {
        self.point.taken.max(self.point.servants_memory) / self.robots()
    }

    fn milliseconds_each(&self, cores: f64) -> f64 {
        cores * self.point.lasted / self.point.times.len() as f64 * 1e3
    }

    /// Returns the fraction of core time in use.
    fn busy_share(&self) -> f64 {
        self.point.used.machine / self.plan.cores
    }

    /// Returns the fraction of core time used by other programs, and by the kernel on behalf of none.
    fn other_share(&self) -> f64 {
        (self.point.used.machine - self.point.used.request_cores()) / self.plan.cores
    }
}

/// Creates the section of the report.
pub fn section(runs: &ScaleRuns) -> Result<Section> {
    let mut section = Section::new(10, "scale", "How many robots a node serves");
    section.published = "Starting a servant took over 5 s.".to_owned();
    section.differs = vec![
        format!(
            "Each robot is a connection of one process on the same machine, pauses for {:.0} ms on average after each \
             answer, and has a \
             servant of its own, of a node that computes for {} ms of a core at each call and needs little memory.",
            THINK * 1e3,
            SHORT.milliseconds
        ),
        "Every other point was held back from the model's fit; the others determine its two parameters.".to_owned(),
    ];
    let mut told = Vec::new();
    for (index, (plan, measured)) in runs.0.iter().enumerate() {
        let what = format!("{} robots", plan.robots);
        let next = "make eval ONLY=10 tries it again";
        if let Some(point) = measured.require(&mut section, what, next) {
            let held_back = index % 2 == 1;
            told.push(ReportedPoint { plan, point, held_back });
        }
    }
    if told.is_empty() {
        return Ok(section);
    }
    let fitted = told.iter().filter(|one| !one.held_back);
    let fitted: Option<Vec<QueueObservation>> = fitted.map(ReportedPoint::observation).collect();
    let node = fitted.and_then(|all| NodeModel::fit(&all, told[0].plan.cores, told[0].plan.think));
    add_starts(&told, &mut section)?;
    add_points(&told, node.as_ref(), &mut section);
    add_costs(&told, &mut section)?;
    add_bend(&told, node.as_ref(), &mut section);
    add_disturbance(&told, &mut section);
    match &node {
        Some(node) => model::add_model(&told, node, &mut section)?,
        None => section.missing.push(MissingMeasurement::new(
            "the queueing model",
            "fewer than two of the points that determine it were measured",
            "make eval ONLY=10",
        )),
    }
    Ok(section)
}

/// Start time of each robot's servant, by the robot's number. After an interrupted evaluation all robots reconnect: of
/// two starts, the first counts.
fn first_starts(told: &[ReportedPoint]) -> BTreeMap<usize, f64> {
    let mut all = BTreeMap::new();
    for (number, time) in told.iter().flat_map(|one| &one.point.starts) {
        all.entry(*number).or_insert(*time);
    }
    all
}

fn add_starts(told: &[ReportedPoint], section: &mut Section) -> Result<()> {
    let all = first_starts(told);
    let times: Vec<f64> = all.values().copied().collect();
    let mut table = Table::new(
        "Start of a servant, until it has answered a first call (s)",
        "figure | published | here | servants started",
    );
    for (name, value) in [("median", median(&times)), ("slowest", quantile(&times, 1.0))] {
        table.push([name.to_owned(), "over 5".to_owned(), or_dash(value, digits), times.len().to_string()]);
    }
    section.tables.push(table);
    let caption = "Start of the next servant";
    let series = [Series::new("", all.iter().map(|(number, time)| (*number as f64, *time)).collect())];
    let drawing = plots::points(caption, "servants on the node", "start (s)", &series, false)?;
    section.add_drawing("scale-starts", caption, drawing);
    let tenth = (times.len() / 10).max(1);
    let which = match tenth {
        1 => "one".to_owned(),
        many => format!("{many}, median"),
    };
    let (first, last) = (median(&times[..tenth]), median(&times[times.len() - tenth..]));
    if let (Some(first), Some(last)) = (first, last) {
        section.findings.push(format!(
            "A new servant has answered its robot's first call after {} ms on an empty node (the first {which}) and \
             after {} ms on a full one (the last {which}), {} times as long; over 5 s were published.",
            milliseconds(Some(first)),
            milliseconds(Some(last)),
            ratio(Some(last / first))
        ));
    }
    Ok(())
}

fn add_points(told: &[ReportedPoint], node: Option<&NodeModel>, section: &mut Section) {
    let mut table = Table::new(
        "Response times",
        "robots | for the model | requests a second | RRT, median (ms) | RRT, 95 % (ms) | RRT, mean (ms) | \
         the model's mean (ms) | its error (%) | machine busy (%)",
    );
    for one in told {
        let predicted = node.map(|node| node.predict(one.plan.robots as u64).response);
        let error = predicted.zip(one.mean_response()).map(|(predicted, mean)| predicted / mean - 1.0);
        table.push([
            one.plan.robots.to_string(),
            if one.held_back { "held back" } else { "fitted" }.to_owned(),
            digits(one.point.times.len() as f64 / one.point.lasted),
            milliseconds(median(&one.point.times)),
            milliseconds(quantile(&one.point.times, 0.95)),
            milliseconds(one.mean_response()),
            milliseconds(predicted),
            or_dash(error, |error| format!("{:+.1}", error * 100.0)),
            format!("{:.0}", one.busy_share() * 100.0),
        ]);
    }
    section.tables.push(table);
}

fn add_costs(told: &[ReportedPoint], section: &mut Section) -> Result<()> {
    let mut table = Table::new(
        "What a robot costs",
        "robots | memory of its servant (MB) | memory that the machine has less (MB) | \
         processor per request: servant (ms) | daemon (ms) | robot (ms)",
    );
    for one in told {
        let used = &one.point.used;
        table.push([
            one.plan.robots.to_string(),
            digits(one.point.servants_memory / one.robots() / MEGA),
            digits(one.point.taken / one.robots() / MEGA),
            digits(one.milliseconds_each(used.servants)),
            digits(one.milliseconds_each(used.daemon)),
            digits(one.milliseconds_each(used.robots)),
        ]);
    }
    section.tables.push(table);
    let line = |name: &str, bytes: fn(&ScalePoint) -> f64| {
        let points = told.iter().map(|one| (one.robots(), bytes(one.point) / MEGA));
        Series::new(name, points.collect())
    };
    let caption = "Memory of all robots together";
    let series = [
        line("less on the machine", |point| point.taken),
        line("control groups of servants", |point| point.servants_memory),
    ];
    let drawing = plots::lines(caption, "robots", "memory (MB)", &series, false)?;
    section.add_drawing("scale-memory", caption, drawing);
    Ok(())
}

/// Reports where the response time begins to rise, and which resource is exhausted there.
fn add_bend(told: &[ReportedPoint], node: Option<&NodeModel>, section: &mut Section) {
    let times: Vec<Option<f64>> = told.iter().map(|one| median(&one.point.times)).collect();
    let Some(alone) = times[0] else { return };
    let bent = times.iter().position(|time| time.is_some_and(|time| time >= BENT * alone));
    let at = &told[bent.unwrap_or(told.len() - 1)];
    let memory = 1.0 - at.point.left.0 / at.point.left.1;
    let state = format!(
        "the cores are {:.0} % busy, and {:.0} % of the memory is used",
        at.busy_share() * 100.0,
        memory * 100.0
    );
    let knee = node
        .map(NodeModel::knee)
        .map(|knee| format!(" By the model robots begin to wait for one another at {knee:.0} robots."));
    let knee = knee.unwrap_or_default();
    let last = &told[told.len() - 1];
    let room = format!(
        "memory, {} MB for each robot, would be enough for {} robots",
        digits(last.memory_per_robot() / MEGA),
        model::robots_in_memory(last)
    );
    let times_alone = ratio(times[bent.unwrap_or(0)].map(|time| time / alone));
    let robots = at.plan.robots;
    section.findings.push(if bent.is_none() {
        format!(
            "Up to {robots} robots the curve does not bend: the median is {} times that of {}; {state}, and \
             {room}.{knee}",
            ratio(times[times.len() - 1].map(|time| time / alone)),
            told[0].plan.robots,
        )
    } else if at.busy_share() >= FULL && at.other_share() >= OTHERS {
        format!(
            "At {robots} robots the median is {times_alone} times that alone, but other programs used {:.0} % of the \
             cores' time: {state}.{knee}",
            at.other_share() * 100.0
        )
    } else if at.busy_share() >= FULL {
        format!(
            "At {robots} robots the median is {times_alone} times that alone, because the processor is used up: \
             {state}; {room}.{knee}"
        )
    } else if memory >= FULL {
        format!(
            "At {robots} robots the median is {times_alone} times that alone, because memory is used up: {state}.{knee}"
        )
    } else {
        format!(
            "At {robots} robots the median is {times_alone} times that alone, although {state}: requests come by \
             chance and wait for \
             each other before the cores are used up; {room}.{knee}"
        )
    });
}

/// Adds a remark if the machine was not quiet.
fn add_disturbance(told: &[ReportedPoint], section: &mut Section) {
    let most = told.iter().map(ReportedPoint::other_share).fold(0.0, f64::max);
    if most >= OTHERS {
        section.findings.push(format!(
            "Other programs used up to {:.0} % of the cores' time meanwhile: response times, the memory that the \
             machine has less and \
             the model's error are worse than on a quiet machine. make eval ONLY=10 FRESH=1 measures again.",
            most * 100.0
        ));
    }
}

#[cfg(test)]
mod tests;
