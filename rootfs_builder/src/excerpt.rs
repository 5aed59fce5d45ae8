//! Excerpts of a build's output for error messages.

use crate::process::LastLines;
use crate::{advice, cause};

/// Excerpt of a build's output: its last lines, preceded by the first errors and by lines that name a missing
/// dependency.
#[derive(Debug, Default)]
pub(crate) struct Excerpt {
    /// First errors with the lines after them, and lines about missing dependencies, in the order of the output.
    early: Vec<String>,
    /// Number of lines about missing dependencies.
    missing: usize,
    /// Number of lines of errors.
    errors: usize,
    /// Number of lines that still belong to the last error.
    context: usize,
    last: LastLines,
}

impl Excerpt {
    /// Maximum number of lines about missing dependencies; more usually have the same cause.
    const MAX_MISSING_LINES: usize = 25;
    /// Maximum number of lines of the first errors, and number of lines after each that explain it.
    const MOST_ERRORS: usize = 12;
    const CONTEXT: usize = 3;

    /// Adds a line; irrelevant ones are left out.
    pub(crate) fn push(&mut self, line: &str) {
        if !is_worth_showing(line) {
            return;
        }
        let Some(dropped) = self.last.push(line) else {
            return;
        };
        if self.missing < Self::MAX_MISSING_LINES && advice::mentions_missing(&dropped) {
            self.missing += 1;
            self.early.push(dropped);
            return;
        }
        if cause::is_build_error(&dropped) {
            self.context = Self::CONTEXT + 1;
        }
        if self.context > 0 && self.errors < Self::MOST_ERRORS {
            self.context -= 1;
            self.errors += 1;
            self.early.push(dropped);
        }
    }

    /// Returns the lines of the excerpt.
    pub(crate) fn text(&self) -> String {
        let mut lines: Vec<&str> = self.early.iter().map(String::as_str).collect();
        let last = self.last.text();
        lines.push(&last);
        lines.join("\n")
    }
}

/// Returns whether a line is relevant: progress messages of make, Ninja, CMake and setuptools would displace the
/// compiler's errors.
fn is_worth_showing(line: &str) -> bool {
    const CHATTER: [&str; 9] =
        ["make[", "gmake[", "-- ", "copying ", "creating ", "running ", "writing ", "reading ", "byte-compiling "];
    let is_chatter = CHATTER.iter().any(|start| line.starts_with(start));
    let is_told = is_progress(line) && !line.contains("Error");
    (!is_chatter || advice::mentions_missing(line)) && !is_told && !line.trim().is_empty()
}

/// Returns whether a line is progress of make (`[ 50%] …`) or Ninja (`[3/12] …`).
fn is_progress(line: &str) -> bool {
    let Some((inside, _)) = line.strip_prefix('[').and_then(|rest| rest.split_once(']')) else {
        return false;
    };
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    match inside.split_once('/') {
        Some((done, all)) => is_number(done) && is_number(all),
        None => inside.strip_suffix('%').is_some_and(|part| is_number(part.trim())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::process::LAST_LINES;

    #[test]
    fn the_compilers_words_are_shown_and_makes_are_not() {
        for line in [
            "x.cpp:3:5: error: 'y' was not declared",
            "CMake Error at CMakeLists.txt:3",
            "  3 | y();",
            "[rosidl] cannot read Foo.msg",
            "FAILED: x.o",
            // Output of pkg-config, as passed on by CMake: the error after it names nothing.
            "--   No package 'csm' found",
            "--   Package 'csm', required by 'virtual:world', not found",
        ] {
            assert!(is_worth_showing(line), "{line}");
        }
        for line in [
            "make[2]: *** [x.o] Error 1",
            "[ 50%] Building CXX object x.o",
            "-- Found x",
            "",
            "[100%] Built",
            "[3/12] Building C object x.o",
            "copying node.py -> build/lib/p",
        ] {
            assert!(!is_worth_showing(line), "{line}");
        }
    }

    #[test]
    fn an_excerpt_keeps_what_names_something_missing() {
        let mut excerpt = Excerpt::default();
        excerpt.push("  Could not find a package configuration file provided by \"csm\" with");
        excerpt.push("an early line");
        for number in 0..LAST_LINES {
            excerpt.push(&format!("later line {number}"));
        }
        let text = excerpt.text();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), LAST_LINES + 1);
        assert!(lines[0].contains("\"csm\"") && lines[1] == "later line 0", "{text}");
    }

    #[test]
    fn an_excerpt_keeps_the_first_errors_of_a_long_log() {
        let mut excerpt = Excerpt::default();
        for number in 0..40 {
            excerpt.push(&format!("before {number}"));
        }
        excerpt.push("x.cpp:3:5: error: 'y' was not declared");
        excerpt.push("    3 | y();");
        for number in 0..1000 {
            excerpt.push(&format!("x.cpp:{number}:1: warning: unused"));
        }
        for number in 0..1000 {
            excerpt.push(&format!("x.cpp:{number}:1: error: more"));
        }
        let text = excerpt.text();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), Excerpt::MOST_ERRORS + LAST_LINES);
        assert_eq!(lines[0], "x.cpp:3:5: error: 'y' was not declared");
        assert!(lines[1].contains("y();") && lines[4] == "x.cpp:0:1: error: more", "{text}");
    }
}
