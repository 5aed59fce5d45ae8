//! The hostile package: what it can attempt, and the results.

use anyhow::ensure;
use serde_json::json;

use crate::robot::Robot;

/// Result of an attempt.
#[derive(Debug, Clone)]
pub struct BurglarAttempt {
    /// True if the kernel allowed it.
    pub succeeded: bool,
    /// Report of the package.
    pub report: String,
}

/// Attempts that need an argument; the stories that use them check the result.
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

/// Makes all attempts that need no argument; returns those that succeeded.
pub fn try_all(robot: &mut Robot) -> anyhow::Result<Vec<String>> {
    let names = try_attempt(robot, "", "")?.report;
    let names: Vec<&str> = names.lines().collect();
    ensure!(names.len() > 60, "the burglar knows only {names:?}");
    let mut broken = Vec::new();
    for name in names.iter().filter(|name| !WITH_ARGUMENT.contains(name)) {
        let attempt = try_attempt(robot, name, "")?;
        if attempt.succeeded {
            broken.push(format!("{name}: {}", attempt.report));
        }
    }
    Ok(broken)
}

/// Asks the package to make an attempt; with an empty name, for the list of attempts.
pub fn try_attempt(robot: &mut Robot, what: &str, argument: &str) -> anyhow::Result<BurglarAttempt> {
    let answer = robot.call("/burglar/try", json!({"what": what, "argument": argument}))?;
    ensure!(answer["result"] == true, "{what} {argument}: {answer}");
    let values = &answer["values"];
    Ok(BurglarAttempt {
        succeeded: values["succeeded"] == true,
        report: values["report"].as_str().unwrap_or_default().to_owned(),
    })
}
