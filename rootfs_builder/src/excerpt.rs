//! What an error shows of a build's output.

use crate::advice;
use crate::process::Tail;

/// What an error shows of a build's output: its last lines, and before them those that name something missing.
#[derive(Debug, Default)]
pub(crate) struct Excerpt {
    missing: Vec<String>,
    last: Tail,
}

impl Excerpt {
    /// More lines that name something are as many of one cause.
    const MOST: usize = 25;

    /// Takes one more line; what nobody needs to see is left out.
    pub(crate) fn push(&mut self, line: &str) {
        if !is_worth_showing(line) {
            return;
        }
        if let Some(dropped) = self.last.push(line)
            && self.missing.len() < Self::MOST
            && advice::names_missing(&dropped)
        {
            self.missing.push(dropped);
        }
    }

    /// Its lines.
    pub(crate) fn text(&self) -> String {
        let mut lines: Vec<&str> = self.missing.iter().map(String::as_str).collect();
        let last = self.last.text();
        lines.push(&last);
        lines.join("\n")
    }
}

/// make's, Ninja's, CMake's and setuptools' own chatter pushes what the compiler said out of the last lines.
fn is_worth_showing(line: &str) -> bool {
    const CHATTER: [&str; 9] = [
        "make[",
        "gmake[",
        "-- ",
        "copying ",
        "creating ",
        "running ",
        "writing ",
        "reading ",
        "byte-compiling ",
    ];
    let is_chatter = CHATTER.iter().any(|start| line.starts_with(start));
    let is_told = is_progress(line) && !line.contains("Error");
    (!is_chatter || advice::names_missing(line)) && !is_told && !line.trim().is_empty()
}

/// `[ 50%] …` as make says it, or `[3/12] …` as Ninja does.
fn is_progress(line: &str) -> bool {
    let Some((inside, _)) = line.strip_prefix('[').and_then(|rest| rest.split_once(']')) else {
        return false;
    };
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    match inside.split_once('/') {
        Some((done, all)) => is_number(done) && is_number(all),
        None => inside
            .strip_suffix('%')
            .is_some_and(|part| is_number(part.trim())),
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
            // pkg-config's words, as CMake passes them on: the error after them names nothing.
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
        assert!(
            lines[0].contains("\"csm\"") && lines[1] == "later line 0",
            "{text}"
        );
    }
}
