//! `.cloudroidignore`: files that are not pushed, in the syntax of gitignore(5).

use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use anyhow::{Context, ensure};

/// Name of the files, in any directory that is pushed.
pub const IGNORE_FILE: &str = ".cloudroidignore";
/// Largest such file in bytes.
const MAX_BYTES: u64 = 1 << 20;

/// The ignore files that apply to a directory: its own and those of the directories above.
#[derive(Debug, Clone, Default)]
pub struct IgnoreRules {
    /// Ignore files from the root downwards.
    files: Vec<Rc<IgnoreFile>>,
}

#[derive(Debug)]
struct IgnoreFile {
    /// Directory of the file, relative to what is pushed.
    base: PathBuf,
    patterns: Vec<IgnorePattern>,
}

impl IgnoreRules {
    /// Adds the ignore file of the directory `inside`, a path relative to what is pushed, if it has one; `directory` is
    /// its path on this machine.
    ///
    /// # Errors
    /// The file cannot be read, is larger than a mebibyte, or has a pattern with an unfinished `[`.
    pub fn with_file_of(&self, directory: &Path, inside: &Path) -> anyhow::Result<IgnoreRules> {
        let path = directory.join(IGNORE_FILE);
        let mut rules = self.clone();
        let text = match std::fs::metadata(&path) {
            Ok(about) if about.is_file() => {
                ensure!(about.len() <= MAX_BYTES, "{} is larger than 1 MiB; shorten it", path.display());
                std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?
            }
            _ => return Ok(rules),
        };
        let lines = text.split(|byte| *byte == b'\n');
        let patterns = lines.map(IgnorePattern::parse).collect::<anyhow::Result<Vec<_>>>();
        let patterns = patterns.with_context(|| format!("cannot use {}", path.display()))?;
        let patterns = patterns.into_iter().flatten().collect();
        rules.files.push(Rc::new(IgnoreFile { base: inside.to_owned(), patterns }));
        Ok(rules)
    }

    /// Returns whether a file or directory, given by its path relative to what is pushed, is left out. The last pattern
    /// that matches decides, and files of deeper directories come later.
    pub fn is_ignored(&self, inside: &Path, is_directory: bool) -> bool {
        let decides = |file: &Rc<IgnoreFile>| {
            let below = inside.strip_prefix(&file.base).ok()?.as_os_str().as_bytes();
            let mut matching = file.patterns.iter().rev();
            let found = matching.find(|pattern| pattern.matches(below, is_directory));
            found.map(|pattern| !pattern.is_negated)
        };
        self.files.iter().rev().find_map(decides).unwrap_or(false)
    }
}

/// One line of an ignore file.
#[derive(Debug, Clone, PartialEq, Eq)]
struct IgnorePattern {
    tokens: Vec<Token>,
    /// The line begins with `!`: matching files are pushed.
    is_negated: bool,
    /// The line ends with `/`: only directories match.
    is_of_directories: bool,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Token {
    Byte(u8),
    /// `?`: one byte of a name.
    One,
    /// `*`: any part of a name.
    Run,
    /// `[a-z]`: one byte of a name, within (or, negated, outside of) these ranges.
    Class {
        is_negated: bool,
        ranges: Vec<(u8, u8)>,
    },
    /// `**/`: any number of whole directories.
    Directories,
    /// `**` at the end: everything below.
    Rest,
}

impl IgnorePattern {
    /// Parses a line; `None` for a comment or a blank one.
    fn parse(line: &[u8]) -> anyhow::Result<Option<IgnorePattern>> {
        let mut line = trim_end(line);
        if line.is_empty() || line.starts_with(b"#") {
            return Ok(None);
        }
        let is_negated = line.starts_with(b"!");
        if is_negated {
            line = &line[1..];
        }
        let is_of_directories = line.ends_with(b"/");
        if is_of_directories {
            line = &line[..line.len() - 1];
        }
        // With a slash at the beginning or in the middle, a pattern is relative to the file's directory.
        let is_anchored = line.contains(&b'/');
        let line = line.strip_prefix(b"/").unwrap_or(line);
        if line.is_empty() {
            return Ok(None);
        }
        let mut tokens = if is_anchored { Vec::new() } else { vec![Token::Directories] };
        parse_tokens(line, &mut tokens)?;
        Ok(Some(IgnorePattern { tokens, is_negated, is_of_directories }))
    }

    /// Returns whether a path relative to the file's directory matches. All ways to match are followed at once, so the
    /// time is bounded by the product of the lengths.
    fn matches(&self, path: &[u8], is_directory: bool) -> bool {
        if path.is_empty() || self.is_of_directories && !is_directory {
            return false;
        }
        let mut reached = vec![false; self.tokens.len() + 1];
        reached[0] = true;
        self.skip_empty(&mut reached, true);
        for byte in path {
            let mut next = vec![false; reached.len()];
            for (at, token) in self.tokens.iter().enumerate().filter(|(at, _)| reached[*at]) {
                let (stays, goes_on) = token.take(*byte);
                next[at] |= stays;
                next[at + 1] |= goes_on;
            }
            self.skip_empty(&mut next, *byte == b'/');
            reached = next;
        }
        reached[self.tokens.len()]
    }

    /// Goes on after tokens that may match nothing; `begins_name` is set at the start of a path's component.
    fn skip_empty(&self, reached: &mut [bool], begins_name: bool) {
        for (at, token) in self.tokens.iter().enumerate() {
            let is_skipped = match token {
                Token::Run => true,
                Token::Directories => begins_name,
                _ => false,
            };
            reached[at + 1] |= reached[at] && is_skipped;
        }
    }
}

impl Token {
    /// Returns whether this token may go on matching after a byte, and whether the next one begins after it.
    fn take(&self, byte: u8) -> (bool, bool) {
        match self {
            Token::Byte(own) => (false, *own == byte),
            Token::One => (false, byte != b'/'),
            Token::Run => (byte != b'/', false),
            Token::Class { is_negated, ranges } => {
                let is_within = ranges.iter().any(|(first, last)| (*first..=*last).contains(&byte));
                (false, byte != b'/' && is_within != *is_negated)
            }
            Token::Directories => (true, false),
            Token::Rest => (true, true),
        }
    }
}

fn parse_tokens(mut line: &[u8], tokens: &mut Vec<Token>) -> anyhow::Result<()> {
    loop {
        let begins_name =
            !matches!(tokens.last(), Some(last) if *last != Token::Directories && *last != Token::Byte(b'/'));
        line = match line {
            [] => return Ok(()),
            [b'*', b'*'] if begins_name => {
                tokens.push(Token::Rest);
                return Ok(());
            }
            [b'*', b'*', b'/', rest @ ..] if begins_name => {
                tokens.push(Token::Directories);
                rest
            }
            [b'*', rest @ ..] => {
                tokens.push(Token::Run);
                rest
            }
            [b'?', rest @ ..] => {
                tokens.push(Token::One);
                rest
            }
            [b'[', rest @ ..] => parse_class(rest, tokens)?,
            [b'\\', byte, rest @ ..] | [byte, rest @ ..] => {
                tokens.push(Token::Byte(*byte));
                rest
            }
        };
    }
}

/// Parses a class after its `[`; returns what follows it.
fn parse_class<'a>(text: &'a [u8], tokens: &mut Vec<Token>) -> anyhow::Result<&'a [u8]> {
    let negated = text.strip_prefix(b"!").or_else(|| text.strip_prefix(b"^"));
    let (is_negated, inside) = (negated.is_some(), negated.unwrap_or(text));
    // A `]` right at the beginning is a member.
    let end = inside.iter().skip(1).position(|byte| *byte == b']').map(|at| at + 1);
    let end = end.with_context(|| format!("[{} has no ]", String::from_utf8_lossy(text)))?;
    let (mut members, mut ranges) = (&inside[..end], Vec::new());
    while let [first, rest @ ..] = members {
        members = match rest {
            [b'-', last, rest @ ..] => {
                ranges.push((*first, *last));
                rest
            }
            rest => {
                ranges.push((*first, *first));
                rest
            }
        };
    }
    tokens.push(Token::Class { is_negated, ranges });
    Ok(&inside[end + 1..])
}

/// Removes the line's end and trailing spaces that are not escaped.
fn trim_end(line: &[u8]) -> &[u8] {
    let mut line = line.strip_suffix(b"\r").unwrap_or(line);
    while let Some(shorter) = line.strip_suffix(b" ") {
        if shorter.ends_with(b"\\") {
            break;
        }
        line = shorter;
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rules(files: &[(&str, &str)]) -> IgnoreRules {
        let root = tempfile::tempdir().expect("a directory");
        files.iter().fold(IgnoreRules::default(), |rules, (inside, text)| {
            let directory = root.path().join(inside);
            std::fs::create_dir_all(&directory).expect("made");
            std::fs::write(directory.join(IGNORE_FILE), text).expect("written");
            rules.with_file_of(&directory, Path::new(inside)).expect(text)
        })
    }

    #[test]
    fn patterns_match_as_those_of_git() {
        for (pattern, path, is_directory, is_ignored) in [
            ("*.bag", "a/b/run.bag", false, true),
            ("*.bag", "run.bag.txt", false, false),
            ("bags/", "a/bags", true, true),
            ("bags/", "a/bags", false, false),
            ("/bags", "bags", true, true),
            ("/bags", "a/bags", true, false),
            ("a/bags", "a/bags", false, true),
            ("a/bags", "b/a/bags", false, false),
            ("a/*", "a/b", false, true),
            ("a/*", "a/b/c", false, false),
            ("**/bags", "bags", false, true),
            ("**/bags", "a/b/bags", false, true),
            ("a/**", "a/b/c", false, true),
            ("a/**", "a", true, false),
            ("a/**/c", "a/c", false, true),
            ("a/**/c", "a/b/b/c", false, true),
            ("a/**/c", "ab/c", false, false),
            ("run?.bag", "run1.bag", false, true),
            ("run?.bag", "run/.bag", false, false),
            ("run[0-9].bag", "run7.bag", false, true),
            ("run[!0-9].bag", "run7.bag", false, false),
            ("run[]a].bag", "run].bag", false, true),
            ("\\#x", "#x", false, true),
            ("\\!x", "!x", false, true),
            ("# x", "# x", false, false),
            ("x  ", "x", false, true),
            ("x\\ ", "x ", false, true),
            ("", "x", false, false),
            ("/", "x", true, false),
            ("*a*a*a*a*a*b", "aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa", false, false),
        ] {
            let found = rules(&[("", pattern)]).is_ignored(Path::new(path), is_directory);
            assert_eq!(found, is_ignored, "{pattern:?} {path}");
        }
    }

    #[test]
    fn the_last_pattern_and_the_deepest_file_decide() {
        let rules = rules(&[("", "*.bag\n!keep.bag\r\n"), ("src/a", "keep.bag\n!/other.bag\n")]);
        for (path, is_ignored) in [
            ("x.bag", true),
            ("keep.bag", false),
            ("src/b/keep.bag", false),
            ("src/a/keep.bag", true),
            ("src/a/other.bag", false),
            ("src/a/deep/other.bag", true),
        ] {
            assert_eq!(rules.is_ignored(Path::new(path), false), is_ignored, "{path}");
        }
    }

    #[test]
    fn an_unfinished_class_is_named() {
        let root = tempfile::tempdir().expect("a directory");
        std::fs::write(root.path().join(IGNORE_FILE), "ok\n[a-z\n").expect("written");
        let refused = IgnoreRules::default().with_file_of(root.path(), Path::new("")).expect_err("unfinished");
        assert!(format!("{refused:#}").contains("[a-z has no ]"), "{refused:#}");
    }
}
