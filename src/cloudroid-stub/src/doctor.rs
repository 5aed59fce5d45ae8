//! `cloudroid-stub doctor`: checks everything that a stub needs, and shows the commands that fix problems.

mod overlay;
mod server;

use std::process::ExitCode;

use foreign::terminal;

use crate::arguments::{DoctorPart, StubDoctorArgs};

/// Result of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum CheckVerdict {
    Good,
    /// It works, but not as well as it could.
    Warning,
    Bad,
}

/// A check and its result.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Check {
    name: &'static str,
    verdict: CheckVerdict,
    /// Observed state.
    found: String,
    /// Command that fixes the problem.
    fix: Option<String>,
}

impl Check {
    fn good(name: &'static str, found: impl Into<String>) -> Check {
        Check {
            name,
            verdict: CheckVerdict::Good,
            found: found.into(),
            fix: None,
        }
    }

    fn bad(name: &'static str, found: impl Into<String>, fix: impl Into<String>) -> Check {
        Check {
            name,
            verdict: CheckVerdict::Bad,
            found: found.into(),
            fix: Some(fix.into()),
        }
    }

    fn warning(name: &'static str, found: impl Into<String>, fix: impl Into<String>) -> Check {
        Check {
            verdict: CheckVerdict::Warning,
            ..Check::bad(name, found, fix)
        }
    }

    /// Formats the check for printing.
    fn render(&self) -> String {
        let mark = match self.verdict {
            CheckVerdict::Good => "ok  ",
            CheckVerdict::Warning => "warn",
            CheckVerdict::Bad => "FAIL",
        };
        let fix = self
            .fix
            .iter()
            .map(|fix| format!("\n                 fix it:  {fix}"));
        format!(
            "{mark}  {:<10} {}{}",
            self.name,
            self.found,
            fix.collect::<String>()
        )
    }
}

/// Runs the checks and prints them; fails if any is bad.
pub fn examine(asked: &StubDoctorArgs) -> anyhow::Result<ExitCode> {
    let stub = overlay::ExaminedStub::from_args(asked)?;
    let config = crate::config::load(&stub.share, std::env::vars())?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let mut checks = runtime.block_on(server::checks(&config, &stub));
    if asked.only != Some(DoctorPart::Server) {
        let variable = |name: &str| std::env::var(name).ok();
        checks.extend(runtime.block_on(overlay::checks(&stub, &config, &variable)));
    }
    for check in &checks {
        println!("{}", terminal::escape(&check.render(), false));
    }
    let bad = checks
        .iter()
        .any(|check| check.verdict == CheckVerdict::Bad);
    Ok(if bad {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_check_names_the_command_that_mends_it() {
        let check = Check::bad(
            "token",
            "the server wants one",
            "sh install.sh --token TOKEN",
        );
        assert_eq!(
            check.render(),
            "FAIL  token      the server wants one\n                 fix it:  sh install.sh --token TOKEN"
        );
        assert_eq!(
            Check::good("clock", "in step").render(),
            "ok    clock      in step"
        );
    }
}
