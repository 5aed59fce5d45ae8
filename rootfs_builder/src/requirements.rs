//! Pinned Python packages: a pip requirements file in which only names, versions and hashes are allowed.
//!
//! The file does not state where packages come from: that is configured in the host's pip. In any case, the content is
//! determined by the hashes.

use std::collections::{BTreeMap, BTreeSet};

use crate::base_file_error::{RequirementProblem, RequirementsError};
use crate::key::{self, Key};

/// Content of a requirements file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Requirements {
    text: String,
    /// Packages by normalized name.
    pinned: BTreeMap<String, PinnedPackage>,
}

/// A pinned package.
#[derive(Debug, Clone, PartialEq, Eq)]
struct PinnedPackage {
    version: String,
    /// SHA-256 in hexadecimal of each acceptable wheel, usually one for each architecture.
    hashes: BTreeSet<String>,
}

impl Requirements {
    /// Parses lines of `NAME==VERSION --hash=sha256:HEX…`, continued after a backslash; comments are on separate lines.
    pub(crate) fn parse(text: &str) -> Result<Self, RequirementsError> {
        let mut pinned = BTreeMap::new();
        let mut lines = text.lines().enumerate();
        while let Some((index, line)) = lines.next() {
            let mut whole = line.trim().to_owned();
            while let Some(begun) = whole.strip_suffix('\\') {
                let more = lines.next().map_or("", |(_, line)| line.trim());
                whole = format!("{} {more}", begun.trim_end());
            }
            if whole.is_empty() || whole.starts_with('#') {
                continue;
            }
            let at = |problem| RequirementsError { line: index + 1, problem };
            let (name, one) = PinnedPackage::parse(&whole).map_err(at)?;
            if pinned.insert(name.clone(), one).is_some() {
                return Err(at(RequirementProblem::Repeated(name)));
            }
        }
        Ok(Self { text: text.to_owned(), pinned })
    }

    /// Returns the text, for pip.
    pub(crate) fn text(&self) -> &str {
        &self.text
    }

    /// Returns the number of packages.
    pub(crate) fn len(&self) -> usize {
        self.pinned.len()
    }

    /// Returns a fingerprint of the requirements that ignores comments and order.
    pub(crate) fn key(&self) -> String {
        let mut key = Key::new("requirements");
        for (name, one) in &self.pinned {
            key = key.input("package", format!("{name}=={}", one.version));
            key = key.inputs("hash", &one.hashes);
        }
        key.finish()
    }

    /// Returns `NAME==VERSION` of each package, sorted.
    pub(crate) fn versions(&self) -> impl Iterator<Item = String> + '_ {
        let pinned = self.pinned.iter();
        pinned.map(|(name, one)| format!("{name}=={}", one.version))
    }

    /// Returns the normalized name of the requirement that a file with this name and content satisfies.
    pub(crate) fn matching_name(&self, file: &str, bytes: &[u8]) -> Option<&str> {
        let (name, version) = parse_wheel_name(file)?;
        let (name, one) = self.pinned.get_key_value(&name)?;
        let same = one.version == version && one.hashes.contains(&key::sha256(bytes));
        same.then_some(name)
    }
}

impl PinnedPackage {
    fn parse(line: &str) -> Result<(String, Self), RequirementProblem> {
        let mut words = line.split_whitespace();
        let first = words.next().unwrap_or_default();
        let not_pinned = || RequirementProblem::NotPinned(first.to_owned());
        let (name, version) = first.split_once("==").ok_or_else(not_pinned)?;
        let plain = |text: &str, more: &[u8]| {
            let good = |byte: u8| byte.is_ascii_alphanumeric() || more.contains(&byte);
            !text.is_empty() && text.bytes().all(good)
        };
        if !plain(name, b"-_.") || !plain(version, b".+!") {
            return Err(not_pinned());
        }
        let mut hashes = BTreeSet::new();
        for word in words {
            let hash = word.strip_prefix("--hash=sha256:");
            let hash = hash.filter(|hash| hash.len() == 64 && plain(hash, b""));
            let Some(hash) = hash else {
                return Err(RequirementProblem::NotAHash(word.to_owned()));
            };
            hashes.insert(hash.to_ascii_lowercase());
        }
        if hashes.is_empty() {
            return Err(RequirementProblem::NoHash(first.to_owned()));
        }
        let version = version.to_owned();
        Ok((normalize_name(name), Self { version, hashes }))
    }
}

/// Parses the name and version in the file name of a wheel: `NAME-VERSION[-BUILD]-PYTHON-ABI-PLATFORM.whl`
/// (<https://packaging.python.org/en/latest/specifications/binary-distribution-format/>).
fn parse_wheel_name(file: &str) -> Option<(String, &str)> {
    let parts: Vec<&str> = file.strip_suffix(".whl")?.split('-').collect();
    match *parts {
        [name, version, _, _, _] | [name, version, _, _, _, _] => Some((normalize_name(name), version)),
        _ => None,
    }
}

/// Normalizes a name (<https://packaging.python.org/en/latest/specifications/name-normalization/>).
fn normalize_name(name: &str) -> String {
    let parts = name.split(['-', '_', '.']).filter(|part| !part.is_empty());
    let parts: Vec<String> = parts.map(str::to_ascii_lowercase).collect();
    parts.join("-")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(name: &str, bytes: &[u8]) -> String {
        format!("{name} \\\n    --hash=sha256:{}\n", key::sha256(bytes))
    }

    #[test]
    fn files_are_known_by_name_version_and_content() {
        let text = format!("# a comment\n\n{}{}", line("ros-std-msgs==5.3.6", b"one"), line("PyYAML==6.0.3", b"two"));
        let asked = Requirements::parse(&text).expect("valid");
        assert_eq!(asked.len(), 2);
        let file = "ros_std_msgs-5.3.6-cp311-cp311-manylinux_2_28_x86_64.whl";
        assert_eq!(asked.matching_name(file, b"one"), Some("ros-std-msgs"));
        assert_eq!(asked.matching_name(file, b"other"), None);
        let newer = "ros_std_msgs-5.5.1-cp311-cp311-manylinux_2_28_x86_64.whl";
        assert_eq!(asked.matching_name(newer, b"one"), None);
        let yaml = "pyyaml-6.0.3-cp311-cp311-manylinux2014_x86_64.whl";
        assert_eq!(asked.matching_name(yaml, b"two"), Some("pyyaml"));
        assert_eq!(asked.matching_name("pyyaml-6.0.3.tar.gz", b"two"), None);
        let versions: Vec<String> = asked.versions().collect();
        assert_eq!(versions, ["pyyaml==6.0.3", "ros-std-msgs==5.3.6"]);
    }

    #[test]
    fn the_key_is_of_what_is_asked_for() {
        let (one, two) = (line("a==1", b"x"), line("b==1", b"y"));
        let key = |text: &str| Requirements::parse(text).expect("valid").key();
        assert_eq!(key(&format!("{one}{two}")), key(&format!("# z\n{two}{one}")));
        assert_ne!(key(&one), key(&two));
        assert_ne!(key(&one), key(&line("a==2", b"x")));
        assert_ne!(key(&one), key(&line("a==1", b"y")));
    }

    #[test]
    fn addresses_and_what_is_not_pinned_are_refused_with_their_line() {
        let good = line("a==1", b"x");
        for (bad, words) in [
            ("--index-url https://example.invalid/simple", "NAME==VERSION"),
            ("a @ https://example.invalid/a.whl", "NAME==VERSION"),
            ("b>=1", "NAME==VERSION"),
            ("b==1", "has no --hash"),
            ("b==1 --hash=md5:abc", "--hash=sha256"),
            ("b==1 ; python_version > '3'", "--hash=sha256"),
            ("-r other.txt", "NAME==VERSION"),
            ("a==2 --hash=sha256:0000000000000000000000000000000000000000000000000000000000000000", "twice"),
        ] {
            let text = format!("{good}{bad}\n");
            let problem = Requirements::parse(&text).expect_err(bad).to_string();
            assert!(problem.starts_with("line 3: ") && problem.contains(words), "{bad}: {problem}");
        }
    }
}
