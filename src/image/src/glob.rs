//! Glob patterns that exclude files from a layer.

/// Patterns for paths relative to a root.
#[derive(Debug, Default)]
pub(crate) struct Globs {
    /// Patterns with a slash: matched against the whole path.
    paths: Vec<Vec<u8>>,
    /// Patterns without a slash: matched against the last component.
    names: Vec<Vec<u8>>,
}

impl Globs {
    pub(crate) fn new(patterns: &[String]) -> Self {
        let mut globs = Self::default();
        for pattern in patterns {
            let bare = pattern.trim_end_matches('/').as_bytes().to_vec();
            match bare.strip_prefix(b"/") {
                Some(anchored) => globs.paths.push(anchored.to_vec()),
                None if bare.contains(&b'/') => globs.paths.push(bare),
                None => globs.names.push(bare),
            }
        }
        globs
    }

    /// Returns whether `path`, whose last component is `name`, is excluded.
    pub(crate) fn matches(&self, path: &[u8], name: &[u8]) -> bool {
        self.names.iter().any(|pattern| matches(pattern, name))
            || self.paths.iter().any(|pattern| matches(pattern, path))
    }
}

/// Matches a pattern; `*` and `?` stop at a slash, `**` does not.
fn matches(pattern: &[u8], text: &[u8]) -> bool {
    match pattern {
        [] => text.is_empty(),
        [b'*', b'*', rest @ ..] => {
            // `a/**/b` also matches `a/b`.
            let without_slash = rest.strip_prefix(b"/").is_some_and(|rest| matches(rest, text));
            without_slash || (0..=text.len()).any(|at| matches(rest, &text[at..]))
        }
        [b'*', rest @ ..] => {
            let end = text.iter().position(|&byte| byte == b'/').unwrap_or(text.len());
            (0..=end).any(|at| matches(rest, &text[at..]))
        }
        [b'?', rest @ ..] => text.first().is_some_and(|&byte| byte != b'/') && matches(rest, &text[1..]),
        [byte, rest @ ..] => text.first() == Some(byte) && matches(rest, &text[1..]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn is_match(pattern: &str, path: &str) -> bool {
        let name = path.rsplit('/').next().unwrap();
        Globs::new(&[pattern.to_owned()]).matches(path.as_bytes(), name.as_bytes())
    }

    #[test]
    fn bare_names_match_at_any_depth_and_paths_from_the_root() {
        assert!(is_match("*.pyc", "usr/lib/a.pyc"));
        assert!(is_match("__pycache__", "opt/x/__pycache__"));
        assert!(!is_match("*.pyc", "usr/lib/a.py"));
        assert!(is_match("/tmp", "tmp"));
        assert!(!is_match("/tmp", "var/tmp"));
        assert!(is_match("var/log/*", "var/log/dpkg.log"));
        assert!(!is_match("var/log/*", "var/log"));
        assert!(!is_match("var/log/*", "var/log/apt/term.log"));
        assert!(is_match("var/**/old", "var/old") && is_match("var/**/old", "var/a/b/old"));
        assert!(is_match("usr/share/doc/**", "usr/share/doc/a/b"));
        assert!(is_match("a?c/", "abc"));
        assert!(!is_match("x/a?c", "x/a/c"));
    }
}
