//! Experiment 1: packages answer the same on the robot and through the stub, and nothing of the robot's application is changed for it.

use anyhow::Result;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::cells::{Cells, Measured};
use crate::examples::{ALL, Example, Where, Workshop};
use crate::place::{Class, Network, Place};
use crate::section::{Missing, Section, Table};
use crate::trace::Trace;
use crate::words::digits;

/// A robot that is not slowed down: what is compared is what is answered, not when.
const FAST: Class = Class {
    cores: 1.0,
    memory: 4 << 30,
};

/// One package, twice on the robot and once through the stub.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Compared {
    native: Trace,
    again: Trace,
    outsourced: Trace,
    /// Of the robot's own program, before and after (SHA-256).
    application: [String; 2],
}

/// By package.
pub struct Runs {
    compared: Vec<(Example, Measured<Compared>)>,
}

/// Measures them; so many requests each at the most.
pub fn measure(cells: &Cells, workshop: &Workshop, most: Option<usize>) -> Result<Runs> {
    let mut compared = Vec::new();
    for example in ALL {
        let most = most.unwrap_or(example.requests).min(example.requests);
        let measured = cells.measure(&format!("transparency {}", example.name), &most, || {
            workshop.publishes(&example)?;
            let before = checksum()?;
            let run = |at: Where| -> Result<Trace> {
                let directory = workshop.directory()?;
                let mut plan = workshop.plan(&example, at, directory.path())?;
                plan.most = most;
                let place = Place::new(&workshop.daemon.address, FAST, Network::Lan)?;
                Ok(place.runs(&plan, directory.path())?.0)
            };
            Ok(Compared {
                native: run(Where::Native)?,
                again: run(Where::Native)?,
                outsourced: run(Where::Outsourced)?,
                application: [before, checksum()?],
            })
        })?;
        compared.push((example, measured));
    }
    Ok(Runs { compared })
}

/// Of this program, which is the robot's application.
fn checksum() -> Result<String> {
    let program = std::fs::read(std::env::current_exe()?)?;
    Ok(format!("{:x}", Sha256::digest(program)))
}

/// How much two runs differ: requests that both answered, those whose answers were equal to the byte, and the largest distance of
/// positions, metres.
fn difference(one: &Trace, other: &Trace) -> (usize, usize, Option<f64>) {
    let pairs = one.requests.iter().zip(&other.requests);
    let both: Vec<_> = pairs
        .filter(|(one, other)| one.digest.is_some() && other.digest.is_some())
        .collect();
    let equal = both
        .iter()
        .filter(|(one, other)| one.digest == other.digest)
        .count();
    let distances = both.iter().filter_map(|(one, other)| {
        let (one, other) = (one.pose?, other.pose?);
        Some(f64::hypot(one[0] - other[0], one[1] - other[1]))
    });
    (both.len(), equal, distances.reduce(f64::max))
}

/// What the report says.
pub fn section(runs: &Runs) -> Section {
    let mut section = Section::new(1, "transparency", "Unmodified packages answer the same");
    section.published = "The publication's packages and robot applications were not modified; their results are said to be the same.".to_owned();
    section.differs = vec!["Each package is asked the same requests twice on the robot, and through the stub: what the two runs on the robot differ by is its own difference from run to run.".to_owned(), "The robot's application is the evaluation's own node: one program, which knows neither where the package runs nor that there are stubs. Its checksum shows that nothing was written into it meanwhile, and no more.".to_owned()];
    let mut table = Table::new(
        "Answers to the same requests",
        [
            "package",
            "compared",
            "answered by both",
            "equal to the byte",
            "largest distance of positions, m",
        ],
    );
    for (example, measured) in &runs.compared {
        let compared = match measured {
            Measured::Done(compared) => compared,
            Measured::Missing(why) => {
                section.missing.push(Missing {
                    what: example.name.to_owned(),
                    why: why.clone(),
                    next: "run make eval again: what was measured stays".to_owned(),
                });
                continue;
            }
        };
        let own = difference(&compared.native, &compared.again);
        let through = difference(&compared.native, &compared.outsourced);
        for (name, (both, equal, distance)) in [("native twice", own), ("native and stub", through)]
        {
            table.push([
                example.name.to_owned(),
                name.to_owned(),
                both.to_string(),
                equal.to_string(),
                distance.map_or_else(|| "–".to_owned(), digits),
            ]);
        }
        section.findings.push(finding(example.name, own, through));
        let [before, after] = &compared.application;
        section.findings.push(if before == after {
            format!(
                "The robot's application was the same program for {}: SHA-256 {before}.",
                example.name
            )
        } else {
            format!(
                "The robot's application CHANGED while {} was compared.",
                example.name
            )
        });
    }
    section.tables.push(table);
    section
}

fn finding(
    name: &str,
    own: (usize, usize, Option<f64>),
    through: (usize, usize, Option<f64>),
) -> String {
    let (both, equal, distance) = through;
    if both > 0 && both == equal {
        return format!(
            "{name}: all {both} answers through the stub are those of the robot, to the byte."
        );
    }
    let within = distance.unwrap_or(0.0) <= own.2.unwrap_or(0.0);
    let words = if within && equal >= own.1 {
        "within"
    } else {
        "NOT within"
    };
    format!(
        "{name}: {equal} of {both} answers through the stub are equal to the byte, which is {words} what two runs on the robot differ by ({} of {}).",
        own.1, own.0
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::Request;

    fn trace(answers: &[(u64, f64)]) -> Trace {
        let request = |(digest, x): &(u64, f64)| Request {
            digest: Some(*digest),
            pose: Some([*x, 0.0, 0.0]),
            ..Request::default()
        };
        Trace {
            requests: answers.iter().map(request).collect(),
            ..Trace::default()
        }
    }

    #[test]
    fn differences_are_counted_and_measured() {
        let one = trace(&[(1, 0.0), (2, 1.0), (3, 2.0)]);
        let other = trace(&[(1, 0.0), (5, 1.5), (3, 2.0)]);
        assert_eq!(difference(&one, &other), (3, 2, Some(0.5)));
    }

    #[test]
    fn a_stub_that_answers_otherwise_is_told() {
        let alike = (3, 3, Some(0.0));
        assert!(finding("a", alike, alike).contains("all 3"));
        assert!(finding("a", alike, (3, 1, Some(1.0))).contains("NOT within"));
        assert!(finding("a", (3, 1, Some(1.0)), (3, 1, Some(0.9))).contains("is within"));
    }
}
