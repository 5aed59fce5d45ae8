use super::*;
use crate::cells::CachedResult;
use crate::experiments::scale::counters::CoreUsage;
use crate::words::assert_tells;

/// A known node: 2 cores, 10 ms of a core per request, of which the robot uses 1 ms, and 2 ms of delay.
const NODE: NodeModel = NodeModel { cores: 2.0, think: THINK, service: 0.010, delay: 0.002 };

fn measured_point(robots: usize) -> (ScalePlan, CachedResult<ScalePoint>) {
    let plan = ScalePlan { robots, settles: 1.0, lasts: 10.0, think: THINK, work: 8, cores: 2.0 };
    let closed = NODE.predict(robots as u64);
    let requests = (closed.throughput * 10.0).round() as usize;
    let point = ScalePoint {
        starts: vec![(robots, 0.3)],
        times: vec![closed.response; requests],
        lasted: 10.0,
        used: CoreUsage {
            machine: closed.busy * 2.0,
            daemon: closed.busy * 2.0 * 0.1,
            servants: closed.busy * 2.0 * 0.8,
            robots: closed.busy * 2.0 * 0.1,
        },
        servants_memory: robots as f64 * 20e6,
        taken: robots as f64 * 25e6,
        left: (16e9 - robots as f64 * 25e6, 20e9),
        admits: 200,
    };
    (plan, CachedResult::Done(point))
}

fn section_for(robots: &[usize]) -> Section {
    let runs = ScaleRuns(robots.iter().map(|robots| measured_point(*robots)).collect());
    section(&runs).expect("it is told")
}

fn finding<'a>(section: &'a Section, word: &str) -> &'a str {
    let found = section.findings.iter().find(|finding| finding.contains(word));
    found.unwrap_or_else(|| panic!("{word}: {:#?}", section.findings))
}

#[test]
fn the_model_is_checked_where_it_was_not_fitted() {
    let section = section_for(&[1, 2, 4, 8, 16, 32, 64, 100]);
    let model = finding(&section, "closed queue");
    assert_tells(model, "of 2 cores, with 10.00 ms of a core and 2.00");
    assert_tells(model, "within 0.0 % on average, 0.0 % at most");
    assert_eq!(section.tables[1].rows[1][1], "held back");
    assert_eq!(section.tables[1].rows[2][1], "fitted");
    assert!(section.missing.is_empty());
}

/// 9 ms of a core without the robots: 222 requests per second, of which each robot, with a request every 0.3 s, makes
/// 3.3, so 66.7 robots; with random arrivals somewhat fewer.
#[test]
fn nodes_are_counted_by_what_is_scarce() {
    let section = section_for(&[1, 2, 4, 8, 16, 32, 64, 100]);
    let table = section.tables.last().expect("nodes");
    let each: u64 = table.rows[0][1].parse().expect("a number");
    assert!((60..=67).contains(&each), "{each}");
    assert_eq!(table.rows[0][2..4], ["720", "200"]);
    assert_eq!(table.rows[1][4], 100_000u64.div_ceil(each).to_string());
    assert!(finding(&section, "100000 such robots").contains("its processor serves"));
}

#[test]
fn the_bend_and_its_reason_are_told() {
    let section = section_for(&[1, 2, 4, 8, 16, 32, 64, 100]);
    let bend = finding(&section, "times that alone");
    assert!(
        bend.starts_with("At 64 robots the median is 10.0 times that alone, because the processor is used up"),
        "{bend}"
    );
    // The same number as in the table of nodes.
    assert_tells(bend, "would be enough for 720 robots");
    let first = finding(&section, "first call");
    assert_tells(first, "after 300 ms on an empty node (the first one) and");
    let few = section_for(&[1, 2, 4]);
    let bend = finding(&few, "does not bend");
    assert!(bend.starts_with("Up to 4 robots"), "{bend}");
    assert!(few.differs.iter().any(|words| words.contains("was not checked")));
}

#[test]
fn a_machine_that_is_not_quiet_is_told_of() {
    let all = [1, 2, 4, 8, 16, 32, 64, 100];
    let quiet = section_for(&all);
    assert!(!quiet.findings.iter().any(|words| words.contains("Other programs")));
    let mut runs = ScaleRuns(all.map(measured_point).into());
    for (_, measured) in &mut runs.0 {
        let CachedResult::Done(point) = measured else {
            continue;
        };
        point.used.machine = 2.0;
        point.times.iter_mut().for_each(|time| *time *= 1.0 + point.starts[0].0 as f64 / 10.0);
    }
    let section = section(&runs).expect("it is told");
    assert!(finding(&section, "times that alone").contains("but other programs used"));
    assert!(finding(&section, "Other programs used up to 9").contains("FRESH=1"));
}

#[test]
fn what_is_missing_is_named_and_the_rest_is_told() {
    let mut runs = ScaleRuns([1, 2, 4].map(measured_point).into());
    runs.0[2].1 = CachedResult::Missing("no room".to_owned());
    let section = section(&runs).expect("it is told");
    let whats: Vec<&str> = section.missing.iter().map(|one| one.what.as_str()).collect();
    assert_eq!(whats, ["4 robots", "the queueing model"]);
    assert_eq!(section.tables[0].rows[0][1..3], ["over 5", "0.30"]);
}

/// As after an evaluation that was interrupted after the first two points.
#[test]
fn a_robot_that_came_anew_is_counted_once() {
    let mut runs = ScaleRuns([1, 2, 4].map(measured_point).into());
    for (at, (_, measured)) in runs.0.iter_mut().enumerate() {
        let CachedResult::Done(point) = measured else {
            continue;
        };
        point.starts = match at {
            0 => vec![(1, 0.1)],
            1 => vec![(2, 0.2)],
            _ => [1, 2, 3, 4].map(|number| (number, 0.5)).to_vec(),
        };
    }
    let section = section(&runs).expect("it is told");
    assert_eq!(section.tables[0].rows[0][2..], ["0.35", "4"]);
    assert_eq!(section.tables[0].rows[1][2], "0.50");
}
