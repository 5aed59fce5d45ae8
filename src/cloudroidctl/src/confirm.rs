//! Asks at the terminal before something is lost or written.

use std::io::{BufRead, IsTerminal, Write, stderr, stdin};

use anyhow::Context;
use foreign::terminal;

/// Longest answer that is read, in bytes.
const LONGEST: u64 = 256;

/// Flag to answer the question beforehand.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct YesFlag {
    /// Do not ask. Without a terminal, nothing is asked.
    #[arg(short, long)]
    yes: bool,
}

impl YesFlag {
    /// Returns whether to ask: a person sits at the terminal and has not answered yet.
    pub fn is_to_ask(self) -> bool {
        !self.yes && stdin().is_terminal() && stderr().is_terminal()
    }
}

/// Asks a question at the terminal; false unless the answer is yes, or if there is no terminal.
pub async fn ask(question: String) -> anyhow::Result<bool> {
    if !stdin().is_terminal() {
        return Ok(false);
    }
    let asking = tokio::task::spawn_blocking(move || -> std::io::Result<String> {
        eprint!("{}", prompt(&question));
        stderr().flush()?;
        let mut answer = String::new();
        std::io::Read::take(stdin().lock(), LONGEST).read_line(&mut answer)?;
        Ok(answer)
    });
    let answer = asking.await.context("asking at the terminal")?.context("cannot read the answer")?;
    Ok(is_yes(&answer))
}

/// Returns a question as it is printed: without control sequences, since it names what the daemon sent.
fn prompt(question: &str) -> String {
    format!("{} [y/N] ", terminal::escape(question, false))
}

fn is_yes(answer: &str) -> bool {
    ["y", "yes"].contains(&answer.trim().to_lowercase().as_str())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_question_draws_nothing() {
        let asked = prompt("remove \u{1b}[2Jadder\u{7} with 1 revision?");
        assert!(!asked.contains(char::is_control) && asked.ends_with("with 1 revision? [y/N] "), "{asked:?}");
    }

    #[test]
    fn only_yes_is_yes() {
        for (answer, expected) in [("y\n", true), (" YES ", true), ("", false), ("\n", false), ("yep", false)] {
            assert_eq!(is_yes(answer), expected, "{answer:?}");
        }
    }
}
