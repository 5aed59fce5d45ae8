//! Parser for the command syntax of CMake; nothing is evaluated.

use std::collections::BTreeSet;

/// A command with its arguments, without quotes and with variables unexpanded.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Command {
    /// Name in lower case, since CMake ignores case.
    pub(crate) name: String,
    pub(crate) arguments: Vec<String>,
}

/// Parses the commands of a file. An unterminated command and everything after it are left out.
pub(crate) fn parse_commands(text: &str) -> Vec<Command> {
    let mut reader = CmakeParser { rest: text, unclosed: BTreeSet::new() };
    let mut found = Vec::new();
    loop {
        reader.skip_space();
        let name = reader.take_while(|c| c.is_ascii_alphanumeric() || c == '_');
        if name.is_empty() {
            // Valid CMake files contain nothing else here.
            if reader.next().is_none() {
                return found;
            }
            continue;
        }
        reader.skip_space();
        if !reader.skip("(") {
            continue;
        }
        let Some(arguments) = reader.arguments() else {
            return found;
        };
        found.push(Command { name: name.to_ascii_lowercase(), arguments });
    }
}

struct CmakeParser<'a> {
    rest: &'a str,
    /// Numbers of `=` in closing brackets that do not come any more: looked for at each opening one, a file of a
    /// mebibyte would take minutes.
    unclosed: BTreeSet<usize>,
}

impl<'a> CmakeParser<'a> {
    fn next(&mut self) -> Option<char> {
        let next = self.rest.chars().next()?;
        self.rest = &self.rest[next.len_utf8()..];
        Some(next)
    }

    fn skip(&mut self, word: &str) -> bool {
        let rest = self.rest.strip_prefix(word);
        self.rest = rest.unwrap_or(self.rest);
        rest.is_some()
    }

    fn take_while(&mut self, is_part: impl Fn(char) -> bool) -> &'a str {
        let end = self.rest.find(|c| !is_part(c)).unwrap_or(self.rest.len());
        let (taken, rest) = self.rest.split_at(end);
        self.rest = rest;
        taken
    }

    /// Skips white space and comments.
    fn skip_space(&mut self) {
        loop {
            self.take_while(char::is_whitespace);
            if !self.skip("#") {
                return;
            }
            if self.bracket_argument().is_none() {
                self.take_while(|c| c != '\n');
            }
        }
    }

    /// Parses `[[text]]` or `[=[text]=]`; returns `None` and consumes nothing if there is none.
    fn bracket_argument(&mut self) -> Option<&'a str> {
        let inside = self.rest.strip_prefix('[')?;
        let signs = inside.len() - inside.trim_start_matches('=').len();
        let inside = inside[signs..].strip_prefix('[')?;
        if self.unclosed.contains(&signs) {
            return None;
        }
        let end = format!("]{}]", "=".repeat(signs));
        let Some((text, rest)) = inside.split_once(end.as_str()) else {
            self.unclosed.insert(signs);
            return None;
        };
        self.rest = rest;
        Some(text)
    }

    /// Parses the arguments up to the closing parenthesis; `None` if it is missing. Inner parentheses are arguments.
    fn arguments(&mut self) -> Option<Vec<String>> {
        let mut found = Vec::new();
        let mut depth = 0;
        loop {
            self.skip_space();
            if let Some(text) = self.bracket_argument() {
                found.push(text.to_owned());
                continue;
            }
            match self.rest.chars().next()? {
                ')' if depth == 0 => {
                    self.next();
                    return Some(found);
                }
                parenthesis @ ('(' | ')') => {
                    self.next();
                    depth = if parenthesis == '(' { depth + 1 } else { depth - 1 };
                    found.push(parenthesis.to_string());
                }
                '"' => {
                    self.next();
                    found.push(self.word(|c| c == '"')?);
                    self.next();
                }
                _ => found.push(self.word(|c| c.is_whitespace() || "()\"#".contains(c))?),
            }
        }
    }

    /// Parses up to an unescaped end character.
    fn word(&mut self, is_end: impl Fn(char) -> bool) -> Option<String> {
        let mut word = String::new();
        loop {
            let c = self.rest.chars().next()?;
            if is_end(c) {
                return Some(word);
            }
            self.next();
            word.push(if c == '\\' { self.next()? } else { c });
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn whatever_is_read_ends(text in "[a(\\[\\]=)\"\\\\#\n ß$]{0,60}") {
            let read: usize = parse_commands(&text).iter().map(|command| command.name.len()).sum();
            prop_assert!(read <= text.len());
        }
    }

    #[test]
    fn commands_are_read_as_they_are_written() {
        let text = r#"
            # a comment with add_executable(nothing)
            PROJECT(demo) #[[ a long
            one ) ]] set(X "a \"b\" (c" d;e ${F})
            if((A OR B) AND NOT C) # why (
              add_library(x [=[ raw ] ) ]=] a\ b)
            endif()
            torn("never ends
        "#;
        let told: Vec<String> = parse_commands(text)
            .into_iter()
            .map(|command| format!("{}:{}", command.name, command.arguments.join("|")))
            .collect();
        assert_eq!(
            told,
            [
                "project:demo",
                "set:X|a \"b\" (c|d;e|${F}",
                "if:(|A|OR|B|)|AND|NOT|C",
                "add_library:x| raw ] ) |a b",
                "endif:",
            ]
        );
        for nothing in ["", "(", ")", "x", "x(", "# x(", "\u{fffd}(]", "[[", "a([["] {
            assert!(parse_commands(nothing).is_empty(), "{nothing}");
        }
    }

    #[test]
    fn closing_brackets_that_do_not_come_are_looked_for_once() {
        // Looked for at each of the opening ones, this would take minutes.
        let text = format!("set(X {}) done()", "[[ [=[ #[[\n".repeat(80_000));
        let found: Vec<(String, usize)> =
            parse_commands(&text).into_iter().map(|command| (command.name, command.arguments.len())).collect();
        assert_eq!(found, [("set".to_owned(), 160_001), ("done".to_owned(), 0)]);
    }
}
