//! A check and its result.

/// Result of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CheckVerdict {
    Good,
    /// It works, but not as well as it could.
    Warning,
    Bad,
}

/// A check and its result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Check {
    pub(super) name: &'static str,
    pub(super) verdict: CheckVerdict,
    /// Observed state.
    pub(super) found: String,
    /// Command that fixes the problem.
    pub(super) fix: Option<String>,
}

impl Check {
    pub(super) fn good(name: &'static str, found: impl Into<String>) -> Check {
        Check { name, verdict: CheckVerdict::Good, found: found.into(), fix: None }
    }

    pub(super) fn bad(name: &'static str, found: impl Into<String>, fix: impl Into<String>) -> Check {
        Check { name, verdict: CheckVerdict::Bad, found: found.into(), fix: Some(fix.into()) }
    }

    pub(super) fn warning(name: &'static str, found: impl Into<String>, fix: impl Into<String>) -> Check {
        Check { verdict: CheckVerdict::Warning, ..Check::bad(name, found, fix) }
    }

    /// Formats the check for printing.
    pub(super) fn render(&self) -> String {
        let mark = match self.verdict {
            CheckVerdict::Good => "ok  ",
            CheckVerdict::Warning => "warn",
            CheckVerdict::Bad => "FAIL",
        };
        let fix = self.fix.iter().map(|fix| format!("\n                 fix it:  {fix}"));
        format!("{mark}  {:<10} {}{}", self.name, self.found, fix.collect::<String>())
    }
}
