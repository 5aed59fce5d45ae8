//! The hostile package: what it is asked to try, and what came of it.

use anyhow::ensure;
use serde_json::json;

use crate::robot::Robot;

/// What came of an attempt.
#[derive(Debug, Clone)]
pub struct Attempt {
    /// The kernel let it happen.
    pub succeeded: bool,
    /// In the burglar's words.
    pub report: String,
}

/// Attempts that are tried on something: what, and whatever they reached is told by their story.
pub const WITH_ARGUMENT: [&str; 8] = [
    "abstract-socket",
    "connect",
    "datagram",
    "foreign-process",
    "host-path",
    "host-shared-memory",
    "other-interfaces",
    "text-in-file",
];

/// Tries everything that needs no argument, and gives what succeeded.
pub fn breaks_out(robot: &mut Robot) -> anyhow::Result<Vec<String>> {
    let names = tries(robot, "", "")?.report;
    let names: Vec<&str> = names.lines().collect();
    ensure!(names.len() > 60, "the burglar knows only {names:?}");
    let mut broken = Vec::new();
    for name in names.iter().filter(|name| !WITH_ARGUMENT.contains(name)) {
        let attempt = tries(robot, name, "")?;
        if attempt.succeeded {
            broken.push(format!("{name}: {}", attempt.report));
        }
    }
    Ok(broken)
}

/// Asks the burglar to try something; with no name, for the list of what there is.
pub fn tries(robot: &mut Robot, what: &str, argument: &str) -> anyhow::Result<Attempt> {
    let answer = robot.calls("/burglar/try", json!({"what": what, "argument": argument}))?;
    ensure!(answer["result"] == true, "{what} {argument}: {answer}");
    let values = &answer["values"];
    Ok(Attempt {
        succeeded: values["succeeded"] == true,
        report: values["report"].as_str().unwrap_or_default().to_owned(),
    })
}
