//! Time spent in each kind of step of a push.

use bench_report::{BenchReport, TimedPush};

/// Titles of steps, and the kind of step that each belongs to.
const KINDS: [(&str, &str); 10] = [
    ("fetching package lists", "lists"),
    ("downloading", "downloading"),
    ("looking up", "looking up"),
    ("installing", "installing"),
    ("adding files", "installing"),
    ("configuring", "configuring"),
    ("compiling", "compiling"),
    ("packing", "packing"),
    ("resolving", "resolving what to run"),
    ("starting it once", "probe"),
];

/// Adds a figure, in seconds, for each kind of step that the push had.
pub(crate) fn report_steps(report: &mut BenchReport, name: &str, pushed: &TimedPush) {
    let mut told = Vec::new();
    for (title, kind) in KINDS {
        let Some(time) = pushed.step_duration(title) else {
            continue;
        };
        match told.iter_mut().find(|(known, _)| *known == kind) {
            Some((_, seconds)) => *seconds += time.as_secs_f64(),
            None => told.push((kind, time.as_secs_f64())),
        }
    }
    for (kind, seconds) in told {
        report.figure(format!("{name}: {kind}"), "s", seconds);
    }
}
