//! What `cloudroidctl` ends with, so that a script can tell what to do next without reading words.

use std::fmt;
use std::process::ExitCode;

use api::Problem;

use crate::client::Unreachable;

/// How it ended. Numbers stay what they are: scripts compare them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exit {
    /// It was done.
    Done = 0,
    /// It was not done, for a reason that no other number names.
    Failed = 1,
    /// The command line cannot be understood.
    Usage = 2,
    /// No daemon answers.
    Unreachable = 3,
    /// Who asks may not: HTTP 401 and 403.
    Forbidden = 4,
    /// What is named is not there: HTTP 404 and 410.
    Missing = 5,
    /// What is asked for cannot be done as it is asked: every other HTTP status of 400 to 499.
    Refused = 6,
    /// There is no room now, or too much is asked at once: HTTP 429, 503 and 507. Later it may be done.
    Busy = 7,
    /// What `--wait` waits for did not come in time.
    TimedOut = 8,
}

/// All, in order.
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
    /// When it is, for the help and the manual.
    pub fn meaning(self) -> &'static str {
        match self {
            Exit::Done => "done",
            Exit::Failed => "not done, for a reason that has no number of its own",
            Exit::Usage => "the command line cannot be understood",
            Exit::Unreachable => "no daemon answers",
            Exit::Forbidden => "who asks may not do it, or has shown no token",
            Exit::Missing => "what is named is not there",
            Exit::Refused => "it cannot be done as it is asked for",
            Exit::Busy => "there is no room now, or too much at once; later it may be done",
            Exit::TimedOut => "what --wait waits for did not come in time",
        }
    }

    /// Of what went wrong.
    pub fn of(error: &anyhow::Error) -> Exit {
        if error.is::<Unreachable>() {
            return Exit::Unreachable;
        }
        if error.is::<TimeUp>() {
            return Exit::TimedOut;
        }
        match error
            .downcast_ref::<Problem>()
            .map(|problem| problem.status)
        {
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

/// The table at the end of `--help` and in the manual.
pub fn table() -> String {
    let rows = EXITS.map(|exit| format!("  {}  {}", exit as u8, exit.meaning()));
    format!("Exit status:\n{}", rows.join("\n"))
}

/// What was waited for did not come in time.
#[derive(Debug)]
pub struct TimeUp {
    /// What did not come, and what was so instead.
    pub words: String,
}

impl fmt::Display for TimeUp {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(&self.words)
    }
}

impl std::error::Error for TimeUp {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_refusal_has_its_number() {
        let refused = |status| {
            Exit::of(
                &Problem {
                    status,
                    ..Problem::default()
                }
                .into(),
            )
        };
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
        assert_eq!(Exit::of(&anyhow::anyhow!("anything")), Exit::Failed);
        let words = "late".to_owned();
        assert_eq!(Exit::of(&TimeUp { words }.into()), Exit::TimedOut);
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
