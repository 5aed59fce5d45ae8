//! Where the time of a push goes.

use bench_report::Report;
use bench_servant::Pushed;

/// Titles that mean one kind of step, whatever they count.
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

/// Adds the seconds of each kind of step that a push had.
pub(crate) fn tell(report: &mut Report, name: &str, pushed: &Pushed) {
    let mut told = Vec::new();
    for (title, kind) in KINDS {
        let Some(time) = pushed.step(title) else {
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
