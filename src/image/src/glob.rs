//! The patterns that leave files out of a layer.

/// Patterns over paths relative to a root.
#[derive(Debug, Default)]
pub(crate) struct Globs {
    /// With a slash: matched against the whole path.
    paths: Vec<Vec<u8>>,
    /// Without: matched against the last name.
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

    /// Whether `path`, whose last part is `name`, is left out.
    pub(crate) fn matches(&self, path: &[u8], name: &[u8]) -> bool {
        self.names.iter().any(|pattern| matches(pattern, name))
            || self.paths.iter().any(|pattern| matches(pattern, path))
    }
}

/// `*` and `?` stop at a slash, `**` does not.
fn matches(pattern: &[u8], text: &[u8]) -> bool {
    match pattern {
        [] => text.is_empty(),
        [b'*', b'*', rest @ ..] => {
            // `a/**/b` also means `a/b`.
            let without_slash = rest
                .strip_prefix(b"/")
                .is_some_and(|rest| matches(rest, text));
            without_slash || (0..=text.len()).any(|at| matches(rest, &text[at..]))
        }
        [b'*', rest @ ..] => {
            let end = text
                .iter()
                .position(|&byte| byte == b'/')
                .unwrap_or(text.len());
            (0..=end).any(|at| matches(rest, &text[at..]))
        }
        [b'?', rest @ ..] => {
            text.first().is_some_and(|&byte| byte != b'/') && matches(rest, &text[1..])
        }
        [byte, rest @ ..] => text.first() == Some(byte) && matches(rest, &text[1..]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hits(pattern: &str, path: &str) -> bool {
        let name = path.rsplit('/').next().unwrap();
        Globs::new(&[pattern.to_owned()]).matches(path.as_bytes(), name.as_bytes())
    }

    #[test]
    fn bare_names_match_at_any_depth_and_paths_from_the_root() {
        assert!(hits("*.pyc", "usr/lib/a.pyc"));
        assert!(hits("__pycache__", "opt/x/__pycache__"));
        assert!(!hits("*.pyc", "usr/lib/a.py"));
        assert!(hits("/tmp", "tmp"));
        assert!(!hits("/tmp", "var/tmp"));
        assert!(hits("var/log/*", "var/log/dpkg.log"));
        assert!(!hits("var/log/*", "var/log"));
        assert!(!hits("var/log/*", "var/log/apt/term.log"));
        assert!(hits("var/**/old", "var/old") && hits("var/**/old", "var/a/b/old"));
        assert!(hits("usr/share/doc/**", "usr/share/doc/a/b"));
        assert!(hits("a?c/", "abc"));
        assert!(!hits("x/a?c", "x/a/c"));
    }
}
