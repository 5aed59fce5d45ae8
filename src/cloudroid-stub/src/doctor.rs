//! `cloudroid-stub doctor`: each thing that a stub needs, whether it is there, and the command that fixes it.

mod overlay;
mod server;

use std::process::ExitCode;

use foreign::terminal;

use crate::arguments::{Doctor, Part};

/// How a check came out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    Good,
    /// It works, but not as well as it could.
    Warning,
    Bad,
}

/// One thing that was looked at.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Check {
    name: &'static str,
    verdict: Verdict,
    /// What was found.
    found: String,
    /// The command that fixes it.
    fix: Option<String>,
}

impl Check {
    fn good(name: &'static str, found: impl Into<String>) -> Check {
        Check {
            name,
            verdict: Verdict::Good,
            found: found.into(),
            fix: None,
        }
    }

    fn bad(name: &'static str, found: impl Into<String>, fix: impl Into<String>) -> Check {
        Check {
            name,
            verdict: Verdict::Bad,
            found: found.into(),
            fix: Some(fix.into()),
        }
    }

    fn warning(name: &'static str, found: impl Into<String>, fix: impl Into<String>) -> Check {
        Check {
            verdict: Verdict::Warning,
            ..Check::bad(name, found, fix)
        }
    }

    /// As it is printed.
    fn lines(&self) -> String {
        let mark = match self.verdict {
            Verdict::Good => "ok  ",
            Verdict::Warning => "warn",
            Verdict::Bad => "FAIL",
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

/// Examines and prints; fails when something is bad.
pub fn examine(asked: &Doctor) -> anyhow::Result<ExitCode> {
    let stub = overlay::ExaminedStub::of(asked)?;
    let config = crate::config::read(&stub.share, std::env::vars())?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let mut checks = runtime.block_on(server::checks(&config, &stub));
    if asked.only != Some(Part::Server) {
        let variable = |name: &str| std::env::var(name).ok();
        checks.extend(runtime.block_on(overlay::checks(&stub, &config, &variable)));
    }
    for check in &checks {
        println!("{}", terminal::escape(&check.lines(), false));
    }
    let bad = checks.iter().any(|check| check.verdict == Verdict::Bad);
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
            check.lines(),
            "FAIL  token      the server wants one\n                 fix it:  sh install.sh --token TOKEN"
        );
        assert_eq!(
            Check::good("clock", "in step").lines(),
            "ok    clock      in step"
        );
    }
}
