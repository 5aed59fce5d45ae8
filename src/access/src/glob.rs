//! Patterns of names.

use std::fmt;
use std::str::FromStr;

use crate::{Error, as_text};

/// Maximum length of a pattern in bytes.
const LONGEST: usize = 255;

/// A glob pattern: `*` matches any characters except `/`, `**` matches any characters, everything else matches
/// itself. `/camera/**` matches everything below `/camera`, but not `/camera` itself.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Glob(String);

as_text!(Glob);

impl Glob {
    /// Creates the pattern of all absolute names.
    pub(crate) fn everything() -> Glob {
        Glob("/**".to_owned())
    }

    /// Returns true if the name matches. Takes at most time proportional to the product of both lengths, whatever the
    /// pattern.
    pub fn matches(&self, name: &str) -> bool {
        let name = name.as_bytes();
        // `reached[i]`: the pattern so far matches the first i bytes.
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

    /// Returns true if every name without `/` matches, as service names are.
    pub fn is_everything(&self) -> bool {
        self.0.bytes().all(|byte| byte == b'*')
    }

    /// Returns the pattern as written.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for Glob {
    type Err = Error;

    fn from_str(text: &str) -> Result<Glob, Error> {
        let plain = |c: char| !c.is_whitespace() && !c.is_control();
        if (1..=LONGEST).contains(&text.len()) && text.chars().all(plain) {
            Ok(Glob(text.to_owned()))
        } else {
            Err(Error::Glob(text.to_owned()))
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
            assert!(refused.contains("is not a pattern"), "{refused}");
        }
    }

    /// The definition, implemented without regard to speed.
    fn reference(pattern: &[u8], name: &[u8]) -> bool {
        match pattern {
            [] => name.is_empty(),
            [b'*', b'*', rest @ ..] => (0..=name.len()).any(|taken| reference(rest, &name[taken..])),
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
