//! Bases whose ROS comes as Python wheels.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::base_file_error::WheelsError;
use crate::error::{Error, IoContext};
use crate::requirements::Requirements;

/// Python packages that provide ROS.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wheels {
    /// Python version of the base: `3.11`.
    pub python: String,
    /// C library version of the base, by which wheels are selected: `2.36`.
    pub glibc: String,
    /// Installation prefix.
    pub prefix: PathBuf,
    /// Name of a requirements file with hashes next to the definition: packages of every image.
    pub runtime: String,
    /// Name of a requirements file with hashes next to the definition: packages present only while a package is
    /// compiled.
    pub build: String,
    /// Additional files in every image: path below the prefix → content.
    #[serde(default)]
    pub files: BTreeMap<PathBuf, String>,
    /// Replacements in CMake files: path on the wheels' build machine → path here.
    #[serde(default)]
    pub rewrite: BTreeMap<String, String>,
}

impl Wheels {
    /// Returns the Python ABIs that wheels may be compiled for (PEP 425).
    pub(crate) fn abis(&self) -> impl Iterator<Item = String> {
        let own = format!("cp{}", self.python.replace('.', ""));
        [own, "abi3".to_owned(), "none".to_owned()].into_iter()
    }

    /// Returns the platforms that wheels may be compiled for (PEP 600), newest first. `machine` is a name such as
    /// `x86_64`.
    pub(crate) fn platforms(&self, machine: &str) -> impl Iterator<Item = String> {
        let minor = self.glibc.rsplit('.').next().unwrap_or_default();
        let newest: u32 = minor.parse().unwrap_or_default();
        let numbered = (5..=newest).rev().map(|minor| format!("manylinux_2_{minor}"));
        // Legacy names of 2.17, 2.12 and 2.5.
        let named = ["manylinux2014", "manylinux2010", "manylinux1"];
        let all: Vec<String> =
            numbered.chain(named.map(str::to_owned)).map(|kind| format!("{kind}_{machine}")).collect();
        all.into_iter()
    }

    pub(super) fn check(&self) -> Result<(), WheelsError> {
        let numbers = |text: &str, first: &str| {
            text.strip_prefix(first).is_some_and(|rest| !rest.is_empty() && rest.bytes().all(|b| b.is_ascii_digit()))
        };
        if !numbers(&self.python, "3.") {
            return Err(WheelsError::Python(self.python.clone()));
        }
        if !numbers(&self.glibc, "2.") {
            return Err(WheelsError::Glibc(self.glibc.clone()));
        }
        let below = |path: &PathBuf| {
            let plain = |part| matches!(part, Component::Normal(_));
            path.file_name().is_some() && path.components().all(plain)
        };
        if let Some(path) = self.files.keys().find(|path| !below(path)) {
            return Err(WheelsError::File(path.clone()));
        }
        for file in [&self.runtime, &self.build] {
            if file.is_empty() || file.starts_with('.') || file.contains('/') {
                return Err(WheelsError::Requirements(file.clone()));
            }
        }
        Ok(())
    }
}

/// Content of the requirements files.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct RequiredWheels {
    pub(crate) runtime: Requirements,
    pub(crate) build: Requirements,
}

impl RequiredWheels {
    pub(super) fn read(directory: &Path, wheels: &Wheels) -> Result<Self, Error> {
        let read = |file: &String| {
            let path = directory.join(file);
            let text = std::fs::read_to_string(&path).io_context("reading", &path)?;
            Requirements::parse(&text).map_err(|problem| Error::BadRequirements { path, problem })
        };
        Ok(Self { runtime: read(&wheels.runtime)?, build: read(&wheels.build)? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wheels() -> Wheels {
        Wheels {
            python: "3.11".to_owned(),
            glibc: "2.17".to_owned(),
            prefix: "/opt/ros/jazzy".into(),
            runtime: "a.txt".to_owned(),
            build: "b.txt".to_owned(),
            files: BTreeMap::new(),
            rewrite: BTreeMap::new(),
        }
    }

    #[test]
    fn wheels_of_older_systems_are_good_and_those_of_newer_ones_are_not() {
        let platforms: Vec<String> = wheels().platforms("x86_64").collect();
        assert_eq!(platforms.first().map(String::as_str), Some("manylinux_2_17_x86_64"));
        assert_eq!(platforms.last().map(String::as_str), Some("manylinux1_x86_64"));
        assert!(platforms.contains(&"manylinux2014_x86_64".to_owned()));
        let abis: Vec<String> = wheels().abis().collect();
        assert_eq!(abis, ["cp311", "abi3", "none"]);
    }

    #[test]
    fn versions_and_files_are_checked() {
        wheels().check().expect("valid");
        for (bad, words) in [
            (Wheels { python: "2.7".to_owned(), ..wheels() }, "Python 3"),
            (Wheels { glibc: "12".to_owned(), ..wheels() }, "glibc"),
            (Wheels { runtime: "../x".to_owned(), ..wheels() }, "beside"),
            (Wheels { build: String::new(), ..wheels() }, "beside"),
            (Wheels { files: [("../setup.sh".into(), String::new())].into(), ..wheels() }, "below the prefix"),
        ] {
            let problem = bad.check().expect_err(words).to_string();
            assert!(problem.contains(words), "{problem}");
        }
    }
}
