//! Patterns of names.

use std::fmt;
use std::str::FromStr;

use crate::{Error, as_text};

/// Longest pattern, in bytes.
const LONGEST: usize = 255;

/// A pattern: `*` stands for any characters but `/`, `**` for any at all, everything else for itself. `/camera/**` holds what is
/// below `/camera`, not `/camera` itself.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Glob(String);

as_text!(Glob);

impl Glob {
    /// All absolute names.
    pub(crate) fn everything() -> Glob {
        Glob("/**".to_owned())
    }

    /// Whether a name is one of the pattern. Time is at most the product of both lengths, whatever the pattern.
    pub fn matches(&self, name: &str) -> bool {
        let name = name.as_bytes();
        // `reached[i]`: the pattern so far stands for the first i bytes.
        let mut reached = vec![false; name.len() + 1];
        reached[0] = true;
        let mut pattern = self.0.as_bytes();
        while let Some((&first, rest)) = pattern.split_first() {
            let any = first == b'*';
            let deep = any && rest.first() == Some(&b'*');
            pattern = if deep { &rest[1..] } else { rest };
            if any {
                for at in 0..name.len() {
                    reached[at + 1] |= reached[at] && (deep || name[at] != b'/');
                }
            } else {
                for at in (0..name.len()).rev() {
                    reached[at + 1] = reached[at] && name[at] == first;
                }
                reached[0] = false;
            }
        }
        reached[name.len()]
    }

    /// Whether it holds every name that has no `/`, as names of services have none.
    pub fn is_everything(&self) -> bool {
        self.0.bytes().all(|byte| byte == b'*')
    }

    /// As it was written.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for Glob {
    type Err = Error;

    fn from_str(text: &str) -> Result<Glob, Error> {
        let plain = |c: char| !c.is_whitespace() && !c.is_control();
        match (1..=LONGEST).contains(&text.len()) && text.chars().all(plain) {
            true => Ok(Glob(text.to_owned())),
            false => Err(Error::Glob(text.to_owned())),
        }
    }
}

impl fmt::Display for Glob {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn glob(text: &str) -> Glob {
        text.parse().expect("a pattern")
    }

    #[test]
    fn names_match_by_segments() {
        let table = [
            ("/camera/**", "/camera/rgb/image", true),
            ("/camera/**", "/camera/x", true),
            ("/camera/**", "/camera", false),
            ("/camera/**", "/camera2/x", false),
            ("/camera**", "/camera2/x", true),
            ("/camera/*", "/camera/rgb", true),
            ("/camera/*", "/camera/rgb/image", false),
            ("/*/image", "/left/image", true),
            ("/*/image", "/left/rect/image", false),
            ("/**/image", "/left/rect/image", true),
            ("/detect", "/detect", true),
            ("/detect", "/detect2", false),
            ("/detect", "/detec", false),
            ("*", "opencv_apps", true),
            ("*", "a/b", false),
            ("**", "/a/b", true),
            ("***", "/a/b", true),
            ("*_apps", "opencv_apps", true),
            ("*_apps", "opencv_app", false),
            ("*", "", true),
            ("a", "", false),
        ];
        for (pattern, name, expected) in table {
            assert_eq!(glob(pattern).matches(name), expected, "{pattern} {name}");
        }
    }

    #[test]
    fn what_is_no_pattern_is_refused_by_name() {
        for text in ["", "a b", "a\n", &"x".repeat(256)] {
            let refused = text.parse::<Glob>().expect_err(text).to_string();
            assert!(refused.contains("is no pattern"), "{refused}");
        }
    }

    /// By definition, without regard to time.
    fn reference(pattern: &[u8], name: &[u8]) -> bool {
        match pattern {
            [] => name.is_empty(),
            [b'*', b'*', rest @ ..] => {
                (0..=name.len()).any(|taken| reference(rest, &name[taken..]))
            }
            [b'*', rest @ ..] => (0..=name.len())
                .take_while(|taken| !name[..*taken].contains(&b'/'))
                .any(|taken| reference(rest, &name[taken..])),
            [first, rest @ ..] => name.first() == Some(first) && reference(rest, &name[1..]),
        }
    }

    proptest! {
        #[test]
        fn it_matches_as_it_is_defined(pattern in "[a/*]{1,7}", name in "[a/b]{0,9}") {
            let expected = reference(pattern.as_bytes(), name.as_bytes());
            prop_assert_eq!(glob(&pattern).matches(&name), expected);
        }
    }
}
