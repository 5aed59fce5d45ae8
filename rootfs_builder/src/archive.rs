//! The distribution's archive as one thing: versions and files by apt, names by the Contents index.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use crate::apt::Apt;
use crate::candidates::Candidates;
use crate::contents::{Carriers, Contents, Part};
use crate::error::Error;
use crate::event::Progress;

/// One base's archive.
pub(crate) struct Archive {
    pub(crate) apt: Apt,
    pub(crate) contents: Arc<Contents>,
    /// All installable packages.
    pub(crate) candidates: Candidates,
    /// Changes when the lists do.
    pub(crate) stamp: String,
    /// For `sources.list`.
    pub(crate) sources: String,
}

impl Archive {
    /// Opens it; fetches lists where they are missing or old (or `force`d).
    pub(crate) async fn open(
        cache: &Path,
        sources: String,
        force: bool,
        progress: &Progress,
    ) -> Result<Self, Error> {
        let name = &crate::key::sha256(sources.as_bytes())[..12];
        let apt = Apt::open(&cache.join("apt").join(name), &sources)?;
        if let Some(warning) = apt.refresh(force, progress).await? {
            progress.warn(warning).await;
        }
        let lists = apt.contents_files()?;
        if lists.is_empty() {
            return Err(Error::NoContents { sources });
        }
        let root = apt.root().to_owned();
        let contents = crate::blocking::spawn(move || Contents::open(&root, &lists)).await??;
        let candidates = apt.candidates().await?;
        let stamp = apt.stamp();
        Ok(Self {
            apt,
            contents: Arc::new(contents),
            candidates,
            stamp,
            sources,
        })
    }

    /// Whether its lists need not be fetched again yet.
    pub(crate) fn is_fresh(&self) -> bool {
        self.apt.is_fresh()
    }

    /// Names that look like a key, the nearest first; at most three.
    pub(crate) fn similar(&self, key: &str) -> Vec<String> {
        let plain = key.replace('_', "-").to_lowercase();
        let bare = plain
            .trim_start_matches("lib")
            .trim_end_matches("-dev")
            .to_owned();
        if bare.len() < 3 {
            return Vec::new();
        }
        let names = self.candidates.names();
        let mut near: Vec<&str> = names.filter(|name| has_word(name, &bare)).collect();
        near.sort_by_key(|name| (name.len(), *name));
        near.into_iter().take(3).map(str::to_owned).collect()
    }

    /// What to install to run with a ROS package, and which development packages hold files of it besides.
    pub(crate) fn to_run(&self, ros_package: &str, depth: Depth) -> Carried {
        let mut carried = Carried::default();
        for (deb, parts) in self.contents.ros_package(ros_package) {
            let wanted = match depth {
                Depth::Itself { python } => {
                    let only_python = parts.iter().all(|part| *part == Part::Python);
                    parts.iter().any(|part| *part != Part::CMake) && (python || !only_python)
                }
                Depth::Needed => {
                    let useful = [
                        Part::Manifest,
                        Part::Programs,
                        Part::Definitions,
                        Part::Share,
                    ];
                    useful.iter().any(|part| parts.contains(part)) && !deb.starts_with("python3-")
                }
                Depth::Beyond => parts.contains(&Part::Definitions) && !deb.ends_with("-dev"),
            };
            match (wanted, deb.ends_with("-dev")) {
                (true, true) => carried.unpack.insert(deb),
                (true, false) => carried.install.insert(deb),
                (false, _) => false,
            };
        }
        carried
    }

    /// What to install to compile against a ROS package.
    pub(crate) fn to_build(&self, ros_package: &str) -> BTreeSet<String> {
        let needed = [Part::Manifest, Part::CMake, Part::Definitions, Part::Python];
        let carriers: Carriers = self.contents.ros_package(ros_package);
        let wanted = |parts: &BTreeSet<Part>| needed.iter().any(|part| parts.contains(part));
        carriers
            .into_iter()
            .filter(|(deb, parts)| wanted(parts) || deb.ends_with("-dev"))
            .map(|(deb, _)| deb)
            .collect()
    }

    /// Debian packages with these libraries; second, those that nothing has.
    pub(crate) fn libraries(
        &self,
        names: &BTreeSet<String>,
    ) -> (BTreeMap<String, String>, Vec<String>) {
        let (mut found, mut missing) = (BTreeMap::new(), Vec::new());
        for name in names {
            match self.contents.library(name) {
                Some(deb) => {
                    found.insert(name.clone(), deb.to_owned());
                }
                None => missing.push(name.clone()),
            }
        }
        (found, missing)
    }
}

/// Names shorter than this are in many others by chance.
const TELLING: usize = 5;

/// Whether a Debian package's name has these words from the beginning of one of its own: `libeigen3-dev` has `eigen`. Behind
/// a short one, only a number may come.
fn has_word(name: &str, words: &str) -> bool {
    name.match_indices(words).any(|(at, _)| {
        let before = &name[..at];
        let before = before.strip_suffix("lib").unwrap_or(before);
        let rest = name[at + words.len()..].split('-').next();
        let is_number = |c: char| c.is_ascii_digit() || c == '.' || c == '+';
        (before.is_empty() || before.ends_with('-'))
            && (words.len() >= TELLING || rest.is_none_or(|rest| rest.chars().all(is_number)))
    })
}

/// How far a ROS package is from what was asked for. The further, the more of it is left to the dependencies that
/// Debian's maintainers wrote down.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Depth {
    /// Asked for: all of it, its Python module only if wanted.
    Itself {
        /// Whether Python code uses it.
        python: bool,
    },
    /// An exec dependency of that: what a launch file, a plugin loader or rospack may look for.
    Needed,
    /// Further away: the definitions of messages.
    Beyond,
}

/// Debian packages of one ROS package.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Carried {
    /// With what they depend on.
    pub(crate) install: BTreeSet<String>,
    /// For their files only.
    pub(crate) unpack: BTreeSet<String>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_look_alike_begin_alike() {
        let directory = tempfile::tempdir().expect("a directory");
        let names = [
            "wpg2odg",
            "libeigen3-dev",
            "libg2opt-dev",
            "ros-robot-localization",
            "libceres-dev",
            "maceres-tools",
            "pclock",
            "libpcl-dev",
            "libpcl1.13",
        ];
        let archive = Archive {
            apt: Apt::open(directory.path(), "").expect("prepared"),
            contents: Contents::open(directory.path(), &[]).expect("read").into(),
            candidates: crate::candidates::tests::named(&names),
            stamp: String::new(),
            sources: String::new(),
        };
        for (key, expected) in [
            // Part of another word means nothing.
            ("libg2o", &[][..]),
            ("ceres-solver", &[]),
            ("ceres", &["libceres-dev"]),
            // Short names have numbers behind them, and no letters.
            ("pcl", &["libpcl-dev", "libpcl1.13"]),
            ("eigen", &["libeigen3-dev"]),
            ("robot_localization", &["ros-robot-localization"]),
        ] {
            assert_eq!(archive.similar(key), expected, "{key}");
        }
    }
}
