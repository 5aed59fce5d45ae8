//! Installable packages of an archive: one version of each, the one that apt would choose.

use std::fmt::Write;

use crate::debian_package::Deb;

/// About sixty thousand packages, stored as sorted lines of a single text, since they stay in memory as long as the
/// daemon runs.
#[derive(Debug, Clone, Default)]
pub struct Candidates {
    /// Lines of `NAME VERSION ARCHITECTURE`.
    text: String,
    /// Start of each line.
    starts: Vec<u32>,
}

impl Candidates {
    /// Parses the result of [`Candidates::as_text`]. Lines out of order are left out.
    pub(crate) fn from_lines(text: &str) -> Self {
        let mut candidates = Self::default();
        let mut before = "";
        for line in text.lines() {
            let name = line.split(' ').next().unwrap_or_default();
            if name > before {
                candidates.push(line);
                before = name;
            }
        }
        candidates
    }

    fn push(&mut self, line: &str) {
        if let Ok(start) = u32::try_from(self.text.len()) {
            self.starts.push(start);
            self.text.push_str(line);
            self.text.push('\n');
        }
    }

    /// Returns the text form, for a file.
    pub(crate) fn as_text(&self) -> &str {
        &self.text
    }

    fn line(&self, start: u32) -> &str {
        let rest = self.text.get(start as usize..).unwrap_or_default();
        rest.split('\n').next().unwrap_or_default()
    }

    fn name(&self, start: u32) -> &str {
        self.line(start).split(' ').next().unwrap_or_default()
    }

    /// Returns the candidate with this name.
    pub fn get(&self, name: &str) -> Option<Deb> {
        let found = self.starts.binary_search_by(|start| self.name(*start).cmp(name));
        let start = self.starts.get(found.ok()?)?;
        let mut fields = self.line(*start).split(' ').map(str::to_owned);
        Some(Deb { name: fields.next()?, version: fields.next()?, architecture: fields.next()? })
    }

    /// Returns whether a candidate has this name.
    pub fn contains(&self, name: &str) -> bool {
        self.get(name).is_some()
    }

    /// Returns all names, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.starts.iter().map(|start| self.name(*start))
    }
}

impl FromIterator<Deb> for Candidates {
    /// Collects candidates; of several with one name the first is used.
    fn from_iter<T: IntoIterator<Item = Deb>>(debs: T) -> Self {
        let mut debs: Vec<Deb> = debs.into_iter().collect();
        debs.sort_by(|a, b| a.name.cmp(&b.name));
        debs.dedup_by(|later, first| later.name == first.name);
        let mut candidates = Self::default();
        let mut line = String::new();
        for deb in debs {
            line.clear();
            // Writing to a string does not fail.
            let _ = write!(line, "{} {} {}", deb.name, deb.version, deb.architecture);
            candidates.push(&line);
        }
        candidates
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Returns candidates with these names.
    pub(crate) fn candidates_named(names: &[&str]) -> Candidates {
        let deb = |name: &&str| Deb { name: (*name).to_owned(), version: "1".into(), architecture: "all".into() };
        names.iter().map(deb).collect()
    }

    #[test]
    fn candidates_are_found_by_name_and_survive_a_file() {
        // As strings, `a+b` and `a-b` sort on both sides of `a b`; as names they sort after `a`.
        let names = ["zlib1g", "a-b", "a", "a+b", "a.b", "a0"];
        let made = candidates_named(&names);
        let read = Candidates::from_lines(made.as_text());
        for candidates in [made, read] {
            for name in names {
                assert_eq!(candidates.get(name).expect(name).to_string(), format!("{name}=1:all"));
            }
            assert!(!candidates.contains("b") && !candidates.contains("") && !candidates.contains("zlib"));
            let listed: Vec<&str> = candidates.names().collect();
            assert_eq!(listed, ["a", "a+b", "a-b", "a.b", "a0", "zlib1g"]);
        }
        assert!(!Candidates::default().contains("a"));
    }
}
