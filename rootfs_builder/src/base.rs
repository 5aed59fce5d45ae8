//! Base definitions: what a distribution and its ROS are like, as data (`images/NAME.toml`).

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use ros::flavour::{Flavour, Version};
use serde::{Deserialize, Serialize};

use crate::error::{Error, IoAt};

/// A base image definition.
#[derive(Debug, Clone, PartialEq)]
pub struct Base {
    /// The file's name without `.toml`.
    pub name: String,
    /// All the rest.
    pub definition: Definition,
}

impl Base {
    /// What a revision records of it.
    pub fn flavour(&self) -> Flavour {
        Flavour {
            base: self.name.clone(),
            ros: self.ros,
            distribution: self.ros_distribution.clone(),
        }
    }

    /// What makes a difference to installed trees: part of their keys. A new rosdep key does not.
    pub(crate) fn system_key(&self) -> String {
        let parts = (&self.distribution, &self.suite, &self.runtime, &self.strip);
        serde_json::to_string(&parts).unwrap_or_default()
    }

    /// What makes a difference to compiled packages.
    pub(crate) fn build_key(&self) -> String {
        serde_json::to_string(&(&self.build, &self.environment)).unwrap_or_default()
    }
}

impl std::ops::Deref for Base {
    type Target = Definition;

    fn deref(&self) -> &Definition {
        &self.definition
    }
}

/// The content of a definition.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Definition {
    /// One line for people.
    pub summary: String,
    /// As in os-release: `debian`.
    pub distribution: String,
    /// The archive's name of the release: `bookworm`.
    pub suite: String,
    /// Which ROS its packages speak.
    pub ros: Version,
    /// What `$ROS_DISTRO` stands for in the conditions of a package.xml: `noetic`.
    pub ros_distribution: String,
    /// What every image has.
    pub runtime: Runtime,
    /// Environment of every process.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
    /// What never gets into a layer.
    #[serde(default)]
    pub strip: Strip,
    /// The toolchain.
    pub build: Build,
    /// What is particular to some ROS packages.
    #[serde(default)]
    pub ros_packages: RosPackages,
    /// rosdep key → Debian packages.
    #[serde(default)]
    pub keys: BTreeMap<String, Vec<String>>,
}

/// What every image has.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Runtime {
    /// Debian packages.
    pub packages: Vec<String>,
}

/// What never gets into a layer.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Strip {
    /// dpkg's `path-exclude=` and `path-include=` lines.
    pub unpacked: Vec<String>,
    /// Globs of absolute paths, or bare names at any depth, left out of the finished tree.
    pub paths: Vec<String>,
}

/// The toolchain.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Build {
    /// Debian packages, present only while a package is compiled.
    pub packages: Vec<String>,
    /// Where compiled packages are installed.
    pub prefix: PathBuf,
    /// Arguments of every cmake.
    #[serde(default)]
    pub cmake: Vec<String>,
    /// Added to the environment while compiling.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
    /// Files that are there while compiling: absolute path → content.
    #[serde(default)]
    pub files: BTreeMap<PathBuf, String>,
}

/// What is particular to some ROS packages.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RosPackages {
    /// Not needed at run time: neither installed for it nor missed.
    pub ignore: BTreeSet<String>,
}

/// Reads the definition `name` of a directory.
pub fn load(directory: &Path, name: &str) -> Result<Base, Error> {
    let plain = !name.is_empty()
        && name
            .bytes()
            .all(|b| b.is_ascii_alphanumeric() || b"-_.".contains(&b));
    let path = directory.join(format!("{name}.toml"));
    if !plain || !path.is_file() {
        let known = names(directory)?;
        return Err(Error::UnknownBase {
            name: name.to_owned(),
            directory: directory.to_owned(),
            known: if known.is_empty() {
                "none".into()
            } else {
                known.join(", ")
            },
        });
    }
    let text = fs::read_to_string(&path).at("reading", &path)?;
    let definition = parse(&text).map_err(|problem| Error::BadBase { path, problem })?;
    Ok(Base {
        name: name.to_owned(),
        definition,
    })
}

/// Names of all definitions in a directory, sorted.
pub fn names(directory: &Path) -> Result<Vec<String>, Error> {
    let mut names = Vec::new();
    for entry in fs::read_dir(directory).at("reading", directory)? {
        let path = entry.at("reading", directory)?.path();
        if path.extension().is_some_and(|e| e == "toml")
            && let Some(stem) = path.file_stem().and_then(|s| s.to_str())
        {
            names.push(stem.to_owned());
        }
    }
    names.sort();
    Ok(names)
}

/// Parses and validates; the error has no file name yet.
fn parse(text: &str) -> Result<Definition, String> {
    let definition: Definition = toml::from_str(text).map_err(|error| {
        let line = error
            .span()
            .map(|span| text[..span.start.min(text.len())].matches('\n').count() + 1);
        match line {
            Some(line) => format!("line {line}: {}", error.message()),
            None => error.message().to_owned(),
        }
    })?;
    let line_of = |needle: &str| match text.lines().position(|line| line.contains(needle)) {
        Some(index) => format!("line {}: ", index + 1),
        None => String::new(),
    };
    let packages = [&definition.runtime.packages, &definition.build.packages];
    for package in packages
        .into_iter()
        .flatten()
        .chain(definition.keys.values().flatten())
    {
        if !is_debian_name(package) {
            return Err(format!(
                "{}{package:?} is not a Debian package name",
                line_of(&format!("{package:?}"))
            ));
        }
    }
    if definition.runtime.packages.is_empty() {
        return Err(format!(
            "{}runtime.packages is empty: name what a node needs",
            line_of("[runtime]")
        ));
    }
    for rule in &definition.strip.unpacked {
        if !rule.starts_with("path-exclude=/") && !rule.starts_with("path-include=/") {
            return Err(format!(
                "{}{rule:?} is neither path-exclude=/… nor path-include=/…",
                line_of(&format!("{rule:?}"))
            ));
        }
    }
    let absolute = definition
        .build
        .files
        .keys()
        .chain([&definition.build.prefix]);
    for path in absolute {
        let climbs = path
            .components()
            .any(|part| part == std::path::Component::ParentDir);
        if !path.is_absolute() || climbs || path == Path::new("/") {
            let shown = path.display().to_string();
            return Err(format!(
                "{}{shown:?} is not an absolute path below /",
                line_of(&shown)
            ));
        }
    }
    Ok(definition)
}

/// Debian policy 5.6.1: lower-case letters, digits, `+-.`, at least two characters, beginning alphanumeric.
pub(crate) fn is_debian_name(name: &str) -> bool {
    name.len() >= 2
        && name.as_bytes()[0].is_ascii_alphanumeric()
        && name
            .bytes()
            .all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b"+-.".contains(&b))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALLEST: &str = "summary = \"x\"\ndistribution = \"debian\"\nsuite = \"bookworm\"\nros = \"ros1\"\nros_distribution = \"noetic\"\n\
        [runtime]\npackages = [\"libroscpp4d\"]\n[build]\npackages = []\nprefix = \"/opt/x\"\n";

    fn ours() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../images")
    }

    #[test]
    fn every_definition_of_the_repository_is_valid() {
        let names = names(&ours()).expect("the directory is there");
        assert!(names.contains(&"bookworm-ros1".to_owned()), "{names:?}");
        for name in names {
            let base = load(&ours(), &name).expect("valid");
            assert!(base.keys.contains_key("eigen"), "{name} knows rosdep keys");
        }
    }

    #[test]
    fn directories_of_man_pages_stay_for_the_links_that_scripts_make_in_them() {
        let base = load(&ours(), "bookworm-ros1").expect("valid");
        // As dpkg matches (fnmatch without flags): a star goes over slashes.
        fn matches(pattern: &[u8], path: &[u8]) -> bool {
            match (pattern.first(), path.first()) {
                (None, None) => true,
                (Some(b'*'), _) => {
                    matches(&pattern[1..], path)
                        || (!path.is_empty() && matches(pattern, &path[1..]))
                }
                (Some(a), Some(b)) if a == b => matches(&pattern[1..], &path[1..]),
                _ => false,
            }
        }
        let excluded = |path: &str| {
            let rules = base.strip.unpacked.iter();
            rules
                .filter_map(|rule| rule.strip_prefix("path-exclude="))
                .any(|rule| matches(rule.as_bytes(), path.as_bytes()))
        };
        assert!(!excluded("/usr/share/man/man1"));
        assert!(excluded("/usr/share/man/man1/java.1.gz"));
        assert!(excluded("/usr/share/man/de/man1/apt.1.gz"));
    }

    #[test]
    fn what_packages_of_strangers_asked_for_is_known() {
        let base = load(&ours(), "bookworm-ros1").expect("valid");
        for key in [
            "bfl",
            "liborocos-bfl-dev",
            "libgsl",
            "libcairo2-dev",
            "python3-cairosvg",
            "python3-joblib",
            "lm-sensors",
        ] {
            assert!(base.keys.contains_key(key), "{key}");
        }
    }

    #[test]
    fn tools_that_only_check_have_a_stand_in_and_are_not_missed() {
        let base = load(&ours(), "bookworm-ros1").expect("valid");
        for tool in ["roslint", "code_coverage", "ros_pytest"] {
            let config = format!("/usr/share/{tool}/cmake/{tool}Config.cmake");
            assert!(base.build.files.contains_key(Path::new(&config)), "{tool}");
            assert!(base.ros_packages.ignore.contains(tool), "{tool}");
        }
    }

    #[test]
    fn an_unknown_base_is_answered_with_those_known() {
        for name in ["nonesuch", "../images/bookworm-ros1", ""] {
            let error = load(&ours(), name).expect_err("not there").to_string();
            assert!(error.contains("bookworm-ros1"), "{error}");
        }
    }

    #[test]
    fn mistakes_are_named_with_their_line() {
        parse(SMALLEST).expect("valid");
        let cases = [
            (SMALLEST.replace("prefix", "prefixx"), "line 10"),
            (SMALLEST.replace("libroscpp4d", "Lib Roscpp"), "line 7"),
            (SMALLEST.replace("/opt/x", "/opt/../x"), "line 10"),
            (SMALLEST.replace("[\"libroscpp4d\"]", "[]"), "line 6"),
            (SMALLEST.replace("ros1", "ros7"), "line 4"),
            (
                format!("{SMALLEST}[strip]\nunpacked = [\"rm -rf\"]\n"),
                "line 12",
            ),
            (
                format!("{SMALLEST}[keys]\neigen = [\"LIBEIGEN\"]\n"),
                "line 12",
            ),
        ];
        for (text, line) in cases {
            let problem = parse(&text).expect_err("a mistake");
            assert!(problem.starts_with(line), "{problem}");
        }
    }
}
