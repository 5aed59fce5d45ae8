//! The line of a program's output that says why it failed, for the headline of an error.

use foreign::terminal;

/// Maximum length of a headline's part in characters.
const LONGEST: usize = 240;

/// Beginnings of lines that end a Python traceback or are the last words of a program, besides `NAME: …` of an
/// exception.
const LAST_WORDS: [&str; 5] =
    ["what():", "fatal error:", "Segmentation fault", "[FATAL]", "error while loading shared libraries"];

/// Returns the line by which a program says why it exits: the last exception or fatal message, or else the last line;
/// `None` if there is none.
pub fn find_exit_cause<'a>(lines: impl DoubleEndedIterator<Item = &'a str> + Clone) -> Option<String> {
    let mut from_last = lines.clone().rev();
    let named =
        from_last.find(|line| is_exception(line.trim_start()) || LAST_WORDS.iter().any(|words| line.contains(words)));
    let last = || lines.rev().find(|line| !line.trim().is_empty());
    named.or_else(last).map(shorten)
}

/// Returns the first error in the output of a build; `None` if no line is recognized as one.
pub fn find_build_cause(text: &str) -> Option<String> {
    let lines: Vec<&str> = text.lines().collect();
    // Of a Python traceback the last line says what happened; errors of compilers and CMake come first.
    let at = lines.iter().position(|line| is_build_error(line))?;
    let line = lines[at];
    if !line.starts_with("CMake Error") {
        return Some(shorten(line));
    }
    // CMake's message is below the line that names its place.
    let below = lines[at + 1..].iter().take_while(|line| !line.starts_with("CMake"));
    let message = below.map(|line| line.trim()).find(|line| !line.is_empty()).unwrap_or_default();
    let place = line.trim_end_matches(':');
    Some(shorten(&if message.is_empty() { place.to_owned() } else { format!("{place}: {message}") }))
}

/// Returns whether a line is an error of a compiler, linker, CMake or Python.
pub(crate) fn is_build_error(line: &str) -> bool {
    const ERRORS: [&str; 6] =
        [": error: ", ": fatal error: ", "CMake Error", "undefined reference to", "cannot find -l", "No rule to make"];
    ERRORS.iter().any(|words| line.contains(words)) || is_exception(line)
}

/// Returns whether a line is the end of a traceback: `ModuleNotFoundError: No module named 'scipy'`. The name may have
/// a module before it, and a message behind it.
fn is_exception(line: &str) -> bool {
    let name = line.split(':').next().unwrap_or_default();
    let last = name.rsplit('.').next().unwrap_or_default();
    let is_name = !name.is_empty() && name.chars().all(|c| c.is_alphanumeric() || c == '_' || c == '.');
    is_name
        && (last.ends_with("Error") || last.ends_with("Exception"))
        && last.starts_with(|c: char| c.is_ascii_uppercase())
}

fn shorten(line: &str) -> String {
    let line = terminal::strip_colours(line);
    let line = line.trim();
    match line.char_indices().nth(LONGEST) {
        Some((end, _)) => format!("{}…", &line[..end]),
        None => line.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cause_of_an_exit_is_its_last_exception_or_last_line() {
        for (text, cause) in [
            (
                "Traceback (most recent call last):\n  File \"/x/node.py\", line 2, in <module>\n    import scipy\n\
                 ModuleNotFoundError: No module named 'scipy'",
                "ModuleNotFoundError: No module named 'scipy'",
            ),
            ("rclpy._rclpy_pybind11.RCLError: failed\n[INFO] bye", "rclpy._rclpy_pybind11.RCLError: failed"),
            ("terminate called after throwing\n  what():  no such port\n", "what():  no such port"),
            ("\u{1b}[31m[FATAL] [171]: no map\u{1b}[0m\nshutting down", "[FATAL] [171]: no map"),
            ("one\ntwo\n\n", "two"),
            ("Warning: low\nErrors: 3", "Errors: 3"),
        ] {
            assert_eq!(find_exit_cause(text.lines()).as_deref(), Some(cause), "{text}");
        }
        assert_eq!(find_exit_cause(" \n".lines()), None);
        let long = "x".repeat(1000);
        assert_eq!(find_exit_cause(long.lines()).expect("a line").chars().count(), LONGEST + 1);
    }

    #[test]
    fn the_cause_of_a_failed_build_is_its_first_error() {
        for (text, cause) in [
            (
                "a.cpp:1:2: warning: unused\na.cpp:3:5: error: 'y' was not declared\na.cpp:9:1: error: more",
                "a.cpp:3:5: error: 'y' was not declared",
            ),
            (
                "CMake Error at CMakeLists.txt:5 (find_package):\n  By not providing \"FindX.cmake\"\n\nmore",
                "CMake Error at CMakeLists.txt:5 (find_package): By not providing \"FindX.cmake\"",
            ),
            ("b.cpp:1:10: fatal error: x.h: No such file", "b.cpp:1:10: fatal error: x.h: No such file"),
            ("ld: a.o: undefined reference to `f()'", "ld: a.o: undefined reference to `f()'"),
            ("  File \"setup.py\"\nSyntaxError: invalid syntax", "SyntaxError: invalid syntax"),
        ] {
            assert_eq!(find_build_cause(text).as_deref(), Some(cause), "{text}");
        }
        assert_eq!(find_build_cause("make: *** [all] Error 2\n0 errors"), None);
    }
}
