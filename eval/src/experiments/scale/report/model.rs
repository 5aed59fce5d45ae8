//! Part of the section on scaling: the queueing model fitted to some of the points, and the number of nodes computed
//! from it.

use super::{FULL, ReportedPoint};
use crate::plots::{self, Series};
use crate::section::{Section, Table};
use crate::statistics::{NodeModel, mean};
use crate::words::digits;

/// Mean response time that robots accept when nodes are counted, in seconds.
const T_MAX: f64 = 0.1;
/// Numbers of robots for which nodes are counted.
const MANY: [u64; 2] = [1_000, 100_000];
/// Fraction of a node's memory for servants, the daemon's default.
const MEMORY_PART: f64 = 0.9;

pub(super) fn add_model(told: &[ReportedPoint], node: &NodeModel, section: &mut Section) {
    let most = told.iter().map(|one| one.plan.robots).max().unwrap_or(1);
    let curve = (1..=most as u64).map(|robots| (robots as f64, node.predict(robots).response * 1e3));
    let measured = |name: &str, held_back: bool| {
        let some = told.iter().filter(|one| one.held_back == held_back);
        Series::new(name, some.filter_map(|one| Some((one.robots(), one.mean_response()?.median * 1e3))).collect())
    };
    let caption = "Mean response time by robots, and the queue that was fitted";
    let curves = [Series::new("model", curve.collect())];
    let points = [measured("measured, the model was fitted to", false), measured("measured, held back", true)];
    let drawing = plots::curves(caption, "robots", "mean response time (ms)", &curves, &points, false);
    section.add_drawing("scale-model", caption, drawing);
    section.findings.push(format!(
        "A closed queue (machine repair, M/M/c//N) of {} cores, with {} ms of a core and {} ms of other waiting for \
         each request and {} ms of pause, predicts {}.",
        node.cores,
        digits(node.service * 1e3),
        digits(node.delay * 1e3),
        digits(node.think * 1e3),
        held_back_error(told, node)
    ));
    add_node_counts(told, node, section);
}

/// Reports the error of the model at the points that were held back.
fn held_back_error(told: &[ReportedPoint], node: &NodeModel) -> String {
    let held_back = told.iter().filter(|one| one.held_back).filter_map(|one| {
        let predicted = node.predict(one.plan.robots as u64).response;
        Some((one.plan.robots, (predicted / one.mean_response()?.median - 1.0) * 100.0))
    });
    let errors: Vec<(usize, f64)> = held_back.collect();
    let sizes: Vec<f64> = errors.iter().map(|error| error.1.abs()).collect();
    let (Some(mean), Some(most)) = (mean(&sizes), sizes.iter().copied().reduce(f64::max)) else {
        return "what was not checked: no point that was held back was measured".to_owned();
    };
    let each: Vec<String> = errors.iter().map(|(robots, error)| format!("{error:+.1} % at {robots}")).collect();
    format!(
        "the mean response times that were held back within {mean:.1} % on average, {most:.1} % at most ({})",
        each.join(", ")
    )
}

/// Returns the number of robots whose servants fit into the memory reserved for servants.
pub(super) fn robots_in_memory(last: &ReportedPoint) -> u64 {
    (MEMORY_PART * last.typical(|point| point.left.1) / last.memory_per_robot()) as u64
}

/// Adds the number of nodes like this one that more robots need.
fn add_node_counts(told: &[ReportedPoint], node: &NodeModel, section: &mut Section) {
    let last = &told[told.len() - 1];
    // Those robots run on other machines.
    let beside = last.typical(|point| point.used.robots / point.used.request_cores());
    let alone = NodeModel { service: node.service * (1.0 - beside), ..*node };
    let (memory, admits) = (robots_in_memory(last), last.typical(|point| point.admits as f64) as u64);
    let milliseconds = T_MAX * 1e3;
    let mut table = Table::new(
        format!(
            "Nodes like this one ({} cores, {:.0} GB) for a mean response time of {milliseconds:.0} ms at most",
            node.cores,
            last.typical(|point| point.left.1) / 1e9
        ),
        "robots | robots per node by the model | by memory | by what the daemon reserves | nodes needed",
    );
    for robots in MANY {
        let served = alone.robots_served(robots, T_MAX);
        let each = served.min(memory).min(admits);
        let needed = if each == 0 { "no number of".to_owned() } else { robots.div_ceil(each).to_string() };
        table.push([robots.to_string(), served.to_string(), memory.to_string(), admits.to_string(), needed.clone()]);
        let scarce = match each {
            0 => "even one robot alone waits longer".to_owned(),
            each if each == served => format!("its processor serves {each} each"),
            each if each == memory => format!("its memory has room for {each} each"),
            each => format!("its daemon makes room for {each} each, although its processor would serve {served}"),
        };
        section.findings.push(format!(
            "{robots} such robots need {needed} nodes like this one for {milliseconds:.0} ms at most on average: \
             {scarce}."
        ));
    }
    section.tables.push(table);
    section.differs.push(format!(
        "Nodes are counted without the robots' own part of the processor ({:.0} % here), without a network, and as if \
         robots were spread evenly.",
        beside * 100.0
    ));
    if last.busy_share() < FULL {
        section.differs.push(format!(
            "The cores were at most {:.0} % busy in this run: what the model says of more robots was not checked.",
            last.busy_share() * 100.0
        ));
    }
}
