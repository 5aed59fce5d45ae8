//! Exit status of `cloudroidctl`, so that scripts can react without parsing messages.

use std::fmt;
use std::process::ExitCode;

use api::Problem;

use crate::client::DaemonUnreachable;

/// Exit status. The numbers are stable: scripts compare them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exit {
    /// Success.
    Done = 0,
    /// Failed for another reason.
    Failed = 1,
    /// Invalid command line.
    Usage = 2,
    /// The daemon cannot be reached.
    Unreachable = 3,
    /// The caller is not authorized: HTTP 401 and 403.
    Forbidden = 4,
    /// A named object does not exist: HTTP 404 and 410.
    Missing = 5,
    /// The request is invalid or cannot be fulfilled: any other HTTP status from 400 to 499.
    Refused = 6,
    /// No capacity now, or too many requests: HTTP 429, 503 and 507. A later attempt may succeed.
    Busy = 7,
    /// The condition of `--wait` was not met in time.
    TimedOut = 8,
}

/// All values, in numeric order.
pub const EXITS: [Exit; 9] = [
    Exit::Done,
    Exit::Failed,
    Exit::Usage,
    Exit::Unreachable,
    Exit::Forbidden,
    Exit::Missing,
    Exit::Refused,
    Exit::Busy,
    Exit::TimedOut,
];

impl Exit {
    /// Returns the description for the help and the manual.
    pub fn meaning(self) -> &'static str {
        match self {
            Exit::Done => "done",
            Exit::Failed => "failed for another reason",
            Exit::Usage => "invalid command line",
            Exit::Unreachable => "cannot reach the daemon",
            Exit::Forbidden => "not permitted, or no token given",
            Exit::Missing => "not found",
            Exit::Refused => "invalid or refused request",
            Exit::Busy => "no capacity now; try again later",
            Exit::TimedOut => "--wait timed out",
        }
    }

    /// Returns the exit status for an error.
    pub fn from_error(error: &anyhow::Error) -> Exit {
        if error.is::<DaemonUnreachable>() {
            return Exit::Unreachable;
        }
        if error.is::<WaitTimedOut>() {
            return Exit::TimedOut;
        }
        match error.downcast_ref::<Problem>().map(|problem| problem.status) {
            Some(401 | 403) => Exit::Forbidden,
            Some(404 | 410) => Exit::Missing,
            Some(429 | 503 | 507) => Exit::Busy,
            Some(400..=499) => Exit::Refused,
            _ => Exit::Failed,
        }
    }
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> ExitCode {
        ExitCode::from(exit as u8)
    }
}

/// Returns the table for the end of `--help` and for the manual.
pub fn table() -> String {
    let rows = EXITS.map(|exit| format!("  {}  {}", exit as u8, exit.meaning()));
    format!("Exit status:\n{}", rows.join("\n"))
}

/// The condition of `--wait` was not met in time.
#[derive(Debug)]
pub struct WaitTimedOut {
    /// Description of the condition and of the current state.
    pub words: String,
}

impl fmt::Display for WaitTimedOut {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(&self.words)
    }
}

impl std::error::Error for WaitTimedOut {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_refusal_has_its_number() {
        let refused = |status| Exit::from_error(&Problem { status, ..Problem::default() }.into());
        for (status, expected) in [
            (400, Exit::Refused),
            (401, Exit::Forbidden),
            (403, Exit::Forbidden),
            (404, Exit::Missing),
            (409, Exit::Refused),
            (413, Exit::Refused),
            (422, Exit::Refused),
            (429, Exit::Busy),
            (500, Exit::Failed),
            (503, Exit::Busy),
            (507, Exit::Busy),
        ] {
            assert_eq!(refused(status), expected, "{status}");
        }
        assert_eq!(Exit::from_error(&anyhow::anyhow!("anything")), Exit::Failed);
        let words = "late".to_owned();
        assert_eq!(Exit::from_error(&WaitTimedOut { words }.into()), Exit::TimedOut);
    }

    #[test]
    fn numbers_are_counted_without_a_gap_and_documented() {
        let documented = include_str!("../../../docs/commands.md");
        for (number, exit) in EXITS.into_iter().enumerate() {
            assert_eq!(exit as usize, number);
            let row = format!("| {number} | {} |", exit.meaning());
            assert!(documented.contains(&row), "docs/commands.md lacks: {row}");
        }
    }
}
