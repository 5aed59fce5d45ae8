//! Request for an exec session: program, environment and terminal.

use std::collections::BTreeMap;

use api::exec::TerminalSize;
use servant::exec::ExecSpec;
use utoipa::IntoParams;

use crate::errors::Error;
use crate::query::query_pairs;

/// Limits on a command: few enough to pass to the shim at once.
const MOST_ARGUMENTS: usize = 1024;
const MOST_BYTES: usize = 32 << 10;
/// Size of a terminal whose client does not tell it.
const COLUMNS: u16 = 80;
const ROWS: u16 = 24;
/// Type of a terminal whose client does not tell it.
const TERM: &str = "xterm";
/// Longest type of a terminal.
const LONGEST_TERM: usize = 64;

/// A shell, where nothing else is asked for.
const SHELL: &str = "cd 2>/dev/null; command -v bash >/dev/null && exec bash; exec sh";
/// Runs a command that is found as a shell finds it, with a shell's exit status if there is none.
const COMMAND: &str = "cd 2>/dev/null; exec \"$@\"";

/// Query of an exec session.
#[derive(Debug, Default, PartialEq, Eq, IntoParams)]
pub struct ExecQuery {
    /// Program and its arguments, each a parameter of its own (default: a shell).
    #[param(required = false)]
    argument: Vec<String>,
    /// Give the program a terminal; otherwise it has separate streams.
    #[param(required = false)]
    terminal: bool,
    /// Columns of the terminal (default: 80).
    columns: Option<u16>,
    /// Rows of the terminal (default: 24).
    rows: Option<u16>,
    /// Type of the terminal, as in the environment variable TERM (default: xterm).
    term: Option<String>,
}

impl ExecQuery {
    /// Parses a query. Other parameters, such as `token`, are ignored.
    pub fn parse(query: Option<&str>) -> Result<ExecQuery, Error> {
        let mut asked = ExecQuery::default();
        for (name, value) in query_pairs(query) {
            let unreadable = |what: &str| Error::BadRequest(format!("{name}={value:?} is not {what}"));
            let count = || value.parse::<u16>().ok().filter(|count| *count > 0);
            match &*name {
                "argument" if value.contains('\0') => return Err(unreadable("an argument without a zero byte")),
                "argument" => asked.argument.push(value.into_owned()),
                "terminal" => asked.terminal = value.parse().map_err(|_| unreadable("true or false"))?,
                "columns" => asked.columns = Some(count().ok_or_else(|| unreadable("a number from 1 to 65535"))?),
                "rows" => asked.rows = Some(count().ok_or_else(|| unreadable("a number from 1 to 65535"))?),
                "term" => asked.term = Some(check_term(&value).ok_or_else(|| unreadable("a type of terminal"))?),
                _ => {}
            }
        }
        let bytes: usize = asked.argument.iter().map(String::len).sum();
        if asked.argument.len() > MOST_ARGUMENTS || bytes > MOST_BYTES {
            return Err(Error::BadRequest(format!(
                "the command is longer than {MOST_ARGUMENTS} arguments or {MOST_BYTES} bytes; pass a script by \
                    standard input: sh -s"
            )));
        }
        if asked.argument.first().is_some_and(String::is_empty) {
            return Err(Error::BadRequest("the command's first argument is empty".to_owned()));
        }
        Ok(asked)
    }

    /// Returns the size of the terminal, if one is asked for.
    pub fn terminal_size(&self) -> Option<TerminalSize> {
        let size = TerminalSize { columns: self.columns.unwrap_or(COLUMNS), rows: self.rows.unwrap_or(ROWS) };
        self.terminal.then_some(size)
    }

    /// Returns the program to run.
    pub fn spec(&self) -> ExecSpec {
        let words = |words: &[&str]| words.iter().map(|word| (*word).to_owned()).collect::<Vec<_>>();
        let argv = if self.argument.is_empty() {
            words(&["/bin/sh", "-c", SHELL])
        } else {
            [words(&["/bin/sh", "-c", COMMAND, "sh"]), self.argument.clone()].concat()
        };
        let term = self.term.clone().unwrap_or_else(|| TERM.to_owned());
        let environment = self.terminal.then(|| ("TERM".to_owned(), term));
        ExecSpec { argv, environment: BTreeMap::from_iter(environment), terminal: self.terminal }
    }

    /// Describes the command for the audit log. It may contain anything, so control characters are escaped.
    pub fn describe(&self) -> String {
        if self.argument.is_empty() {
            return "a shell".to_owned();
        }
        let plain = |word: &&String| {
            !word.is_empty() && word.chars().all(|c| c.is_ascii_alphanumeric() || "/._-+=:,@%".contains(c))
        };
        let words = self.argument.iter();
        words.map(|word| if plain(&word) { word.clone() } else { format!("{word:?}") }).collect::<Vec<_>>().join(" ")
    }
}

fn check_term(term: &str) -> Option<String> {
    let is_plain = term.chars().all(|c| c.is_ascii_alphanumeric() || "._+-".contains(c));
    (is_plain && (1..=LONGEST_TERM).contains(&term.len())).then(|| term.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_comes_in_the_query() {
        let asked = ExecQuery::parse(Some("argument=ls&argument=-l&argument=a%20b&token=x")).expect("valid");
        let spec = asked.spec();
        assert_eq!(spec.argv, ["/bin/sh", "-c", COMMAND, "sh", "ls", "-l", "a b"]);
        assert!(!spec.terminal && spec.environment.is_empty() && asked.terminal_size().is_none());
        assert_eq!(asked.describe(), "ls -l \"a b\"");
        let hostile = ExecQuery::parse(Some("argument=%1b%5d0%3bx%07")).expect("valid");
        assert_eq!(hostile.describe(), "\"\\u{1b}]0;x\\u{7}\"", "nothing reaches the terminal of who reads the log");
    }

    #[test]
    fn without_a_command_it_is_a_shell_at_a_terminal_of_the_client_s_size() {
        let asked = ExecQuery::parse(Some("terminal=true&columns=211&rows=50&term=xterm-256color")).expect("valid");
        assert_eq!(asked.terminal_size(), Some(TerminalSize { columns: 211, rows: 50 }));
        let spec = asked.spec();
        assert_eq!(spec.argv, ["/bin/sh", "-c", SHELL]);
        assert_eq!(spec.environment["TERM"], "xterm-256color");
        assert_eq!(asked.describe(), "a shell");
        let asked = ExecQuery::parse(Some("terminal=true")).expect("valid");
        assert_eq!(asked.terminal_size(), Some(TerminalSize { columns: 80, rows: 24 }));
        assert_eq!(asked.spec().environment["TERM"], "xterm");
    }

    #[test]
    fn what_cannot_be_run_is_refused() {
        let many = "argument=x&".repeat(MOST_ARGUMENTS + 1);
        let long = format!("argument={}", "x".repeat(MOST_BYTES + 1));
        for query in [
            "argument=",
            "argument=a%00b",
            "terminal=yes",
            "columns=0",
            "columns=70000",
            "rows=-1",
            "term=",
            "term=x%3bid",
            many.as_str(),
            long.as_str(),
        ] {
            let refused = ExecQuery::parse(Some(query)).expect_err(query);
            assert_eq!(refused.problem().status, 400, "{query}");
        }
    }
}
