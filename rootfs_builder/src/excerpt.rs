//! Excerpts of a build's output for error messages.

use crate::advice;
use crate::process::LastLines;

/// Excerpt of a build's output: its last lines, preceded by those that name a missing dependency.
#[derive(Debug, Default)]
pub(crate) struct Excerpt {
    missing: Vec<String>,
    last: LastLines,
}

impl Excerpt {
    /// Maximum number of lines about missing dependencies; more usually have the same cause.
    const MOST: usize = 25;

    /// Adds a line; irrelevant ones are left out.
    pub(crate) fn push(&mut self, line: &str) {
        if !is_worth_showing(line) {
            return;
        }
        if let Some(dropped) = self.last.push(line)
            && self.missing.len() < Self::MOST
            && advice::mentions_missing(&dropped)
        {
            self.missing.push(dropped);
        }
    }

    /// Returns the lines of the excerpt.
    pub(crate) fn text(&self) -> String {
        let mut lines: Vec<&str> = self.missing.iter().map(String::as_str).collect();
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
}
