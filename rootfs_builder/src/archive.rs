//! The distribution's archive: versions and files through apt, names through the Contents index.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use crate::apt::Apt;
use crate::candidates::Candidates;
use crate::contents::{Carriers, Contents, RosPackagePart};
use crate::error::Error;
use crate::event::Progress;

/// The archive of a base.
pub(crate) struct Archive {
    pub(crate) apt: Apt,
    pub(crate) contents: Arc<Contents>,
    /// All installable packages.
    pub(crate) candidates: Candidates,
    /// Fingerprint of the lists.
    pub(crate) stamp: String,
    /// Lines of `sources.list`.
    pub(crate) sources: String,
}

impl Archive {
    /// Opens the archive; fetches the lists if they are missing or old (or if `force`d).
    pub(crate) async fn open(cache: &Path, sources: String, force: bool, progress: &Progress) -> Result<Self, Error> {
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
        Ok(Self { apt, contents: Arc::new(contents), candidates, stamp, sources })
    }

    /// Returns whether the lists are recent enough to be used.
    pub(crate) fn is_fresh(&self) -> bool {
        self.apt.is_fresh()
    }

    /// Returns names similar to a key, closest first; at most three.
    pub(crate) fn similar(&self, key: &str) -> Vec<String> {
        let plain = key.replace('_', "-").to_lowercase();
        let bare = plain.trim_start_matches("lib").trim_end_matches("-dev").to_owned();
        if bare.len() < 3 {
            return Vec::new();
        }
        let names = self.candidates.names();
        let mut near: Vec<&str> = names.filter(|name| has_word(name, &bare)).collect();
        near.sort_by_key(|name| (name.len(), *name));
        // A misspelt ROS package is more likely than a package with a word in common.
        let mut found: Vec<String> = self.contents.misspelt_ros_packages(key).into_iter().map(str::to_owned).collect();
        found.extend(near.into_iter().map(str::to_owned));
        found.truncate(3);
        found
    }

    /// Returns the packages to install to run with a ROS package, and the development packages that contain further
    /// files of it.
    pub(crate) fn runtime_packages(&self, ros_package: &str, depth: DependencyDepth) -> RosPackageDebs {
        let mut carried = RosPackageDebs::default();
        for (deb, parts) in self.contents.ros_package(ros_package) {
            let wanted = match depth {
                DependencyDepth::Itself { python } => {
                    let only_python = parts.iter().all(|part| *part == RosPackagePart::Python);
                    parts.iter().any(|part| *part != RosPackagePart::CMake) && (python || !only_python)
                }
                DependencyDepth::Needed => {
                    let useful = [
                        RosPackagePart::Manifest,
                        RosPackagePart::Programs,
                        RosPackagePart::Definitions,
                        RosPackagePart::Share,
                    ];
                    useful.iter().any(|part| parts.contains(part)) && !deb.starts_with("python3-")
                }
                DependencyDepth::Beyond => parts.contains(&RosPackagePart::Definitions) && !deb.ends_with("-dev"),
            };
            match (wanted, deb.ends_with("-dev")) {
                (true, true) => carried.unpack.insert(deb),
                (true, false) => carried.install.insert(deb),
                (false, _) => false,
            };
        }
        carried
    }

    /// Returns the packages to install to compile against a ROS package.
    pub(crate) fn build_packages(&self, ros_package: &str) -> BTreeSet<String> {
        let needed =
            [RosPackagePart::Manifest, RosPackagePart::CMake, RosPackagePart::Definitions, RosPackagePart::Python];
        let carriers: Carriers = self.contents.ros_package(ros_package);
        let wanted = |parts: &BTreeSet<RosPackagePart>| needed.iter().any(|part| parts.contains(part));
        carriers.into_iter().filter(|(deb, parts)| wanted(parts) || deb.ends_with("-dev")).map(|(deb, _)| deb).collect()
    }

    /// Returns the Debian packages that contain these libraries, and the libraries contained in none.
    pub(crate) fn libraries(&self, names: &BTreeSet<String>) -> (BTreeMap<String, String>, Vec<String>) {
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

/// Minimum length of a significant word; shorter ones occur in many names by chance.
const TELLING: usize = 5;

/// Returns whether a package name contains these words at a word boundary: `libeigen3-dev` contains `eigen`. A short
/// word may only be followed by a number.
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

/// Distance of a ROS package from those requested. The larger it is, the more is left to the dependencies stated by
/// Debian's maintainers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DependencyDepth {
    /// Requested: all of it; its Python module only if needed.
    Itself {
        /// True if Python code uses it.
        python: bool,
    },
    /// Exec dependency of a requested package: what a launch file, a plugin loader or rospack may look up.
    Needed,
    /// Further dependency: message definitions only.
    Beyond,
}

/// Debian packages of a ROS package.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct RosPackageDebs {
    /// Packages to install with their dependencies.
    pub(crate) install: BTreeSet<String>,
    /// Packages to unpack for their files only.
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
            candidates: crate::candidates::tests::candidates_named(&names),
            stamp: String::new(),
            sources: String::new(),
        };
        for (key, expected) in [
            // Part of another word.
            ("libg2o", &[][..]),
            ("ceres-solver", &[]),
            ("ceres", &["libceres-dev"]),
            // Short words are followed by numbers, not by letters.
            ("pcl", &["libpcl-dev", "libpcl1.13"]),
            ("eigen", &["libeigen3-dev"]),
            ("robot_localization", &["ros-robot-localization"]),
        ] {
            assert_eq!(archive.similar(key), expected, "{key}");
        }
    }

    #[test]
    fn a_misspelt_ros_package_is_the_first_suggestion() {
        let directory = tempfile::tempdir().expect("a directory");
        let text = "usr/share/cv_bridge/package.xml libdevel/libcv-bridge-dev\n\
                    usr/share/tf2_ros/package.xml libdevel/libtf2-ros-dev\n\
                    usr/share/tf/package.xml libdevel/libtf-dev\n";
        let lists = [crate::contents::tests::list(directory.path(), "c.gz", text)];
        let archive = Archive {
            apt: Apt::open(directory.path(), "").expect("prepared"),
            contents: Contents::open(directory.path(), &lists).expect("read").into(),
            candidates: crate::candidates::tests::candidates_named(&["libcv-bridge-dev", "libcvbridge9"]),
            stamp: String::new(),
            sources: String::new(),
        };
        for (key, expected) in [
            ("cv_brigde", &["cv_bridge"][..]),
            ("cv-bridge", &["cv_bridge", "libcv-bridge-dev"]),
            ("cvbridge", &["cv_bridge", "libcvbridge9"]),
            ("cv_bridges", &["cv_bridge"]),
            ("tf2_rso", &["tf2_ros"]),
            // Of short names every other one is similar.
            ("tg", &[]),
            ("move_base", &[]),
        ] {
            assert_eq!(archive.similar(key), expected, "{key}");
        }
    }
}
