//! Finds missing dependencies in the output of a build or a node, and advises the `push` option that adds them.

use std::collections::BTreeSet;

use crate::archive::Archive;
use crate::base::Base;
use crate::contents::Contents;
use crate::error::Error;
use crate::keys;

/// A missing dependency, by the name in the output.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
enum MissingDependency<'a> {
    /// CMake: `find_package(NAME)`.
    Config(&'a str),
    /// CMake: `find_package(NAME)` through CMake's own module `FindNAME.cmake`.
    Found(&'a str),
    /// CMake: `pkg_check_modules(… NAME)`.
    PkgConfig(&'a str),
    /// Python: `import NAME`.
    Module(&'a str),
    /// A shared library, by its file name.
    Library(String),
}

/// Index in which missing dependencies are looked up.
#[derive(Clone, Copy)]
pub(crate) struct AdviceIndex<'a> {
    contents: &'a Contents,
    /// Set for a base with install spaces, where the distribution's own ROS 1 packages must be ignored.
    two: Option<Ros2Base<'a>>,
}

#[derive(Clone, Copy)]
struct Ros2Base<'a> {
    archive: &'a Archive,
    base: &'a Base,
}

impl<'a> AdviceIndex<'a> {
    /// Returns the index of a base and its archive.
    pub(crate) fn for_base(archive: &'a Archive, base: &'a Base) -> Self {
        Self { contents: &archive.contents, two: (!base.has_distributions_ros()).then_some(Ros2Base { archive, base }) }
    }

    /// Returns the index of an archive for a base of ROS 1.
    #[cfg(test)]
    pub(crate) fn for_ros1(contents: &'a Contents) -> Self {
        Self { contents, two: None }
    }

    /// Returns the package that provides a CMake configuration.
    fn config(&self, name: &str) -> Option<String> {
        let mut debs = self.contents.cmake_config(name);
        match self.two {
            // As a ROS package it is installed completely, with definitions and plugins.
            None if !self.contents.ros_package(name).is_empty() => Some(name.to_owned()),
            None => nearest_name(&debs, name).map(str::to_owned),
            Some(two) => two.find_deb(name).or_else(|| {
                debs.retain(|deb| two.matches_ros(deb));
                nearest_name(&debs, name).map(str::to_owned)
            }),
        }
    }

    /// Returns the package that provides a pkg-config module.
    fn pkg_config(&self, name: &str) -> Option<String> {
        let mut debs = self.contents.pkg_config(name);
        debs.retain(|deb| self.two.is_none_or(|two| two.matches_ros(deb)));
        nearest_name(&debs, name).map(str::to_owned)
    }

    /// Returns the package that provides a Python module.
    pub(crate) fn module(&self, name: &str) -> Option<String> {
        let mut debs = self.contents.python_module(name);
        match self.two {
            None => nearest_name(&debs, name).map(str::to_owned),
            Some(two) => two.find_deb(name).or_else(|| {
                debs.retain(|deb| two.matches_ros(deb));
                nearest_name(&debs, name).map(str::to_owned)
            }),
        }
    }

    /// Returns the package that provides a library.
    fn library(&self, name: &str) -> Option<String> {
        let deb = self.contents.library(name)?;
        let fits = self.two.is_none_or(|two| two.matches_ros(deb));
        fits.then(|| deb.to_owned())
    }

    /// Describes which other ROS packages contain a program.
    fn programs(&self, program: &str) -> String {
        if self.two.is_some() {
            return String::new();
        }
        let places = self.contents.programs(program).into_iter();
        let places: Vec<String> = places
            .map(|(package, deb)| {
                format!(
                    "; the ROS package {package} (Debian's {deb}) has it: push with `--apt {package}`, or add \
                     `--with {package}` and write `--node {package}/{program}`"
                )
            })
            .collect();
        places.concat()
    }
}

impl Ros2Base<'_> {
    fn find_deb(&self, name: &str) -> Option<String> {
        keys::find_ros_deb(self.archive, self.base, name)
    }

    fn matches_ros(&self, deb: &str) -> bool {
        !keys::is_of_other_ros(self.archive, self.base, deb)
    }
}

/// Returns a line of advice for each missing dependency named in `words`; empty if there is none.
pub(crate) fn advise_for_output(words: &str, known: AdviceIndex<'_>) -> Vec<String> {
    // What CMake looks up without success may be optional; required dependencies are named again
    // (`inside/second_look.py`).
    let lines = words.lines().filter(|line| !line.starts_with("-- "));
    let missed: BTreeSet<MissingDependency<'_>> = lines.filter_map(parse_missing).collect();
    missed
        .into_iter()
        .map(|missed| match missed {
            MissingDependency::Config(name) => advise(&format!("the CMake package {name}"), known.config(name)),
            MissingDependency::Found(name) => match known.config(name) {
                // It is unknown whether the archive has it, since such modules search for files.
                None => format!(
                    "{name} is missing, which CMake searches with Find{name}.cmake: push with `--with PACKAGE`, the \
                        Debian package with its files"
                ),
                found => advise(&format!("the CMake package {name}"), found),
            },
            MissingDependency::PkgConfig(name) => {
                advise(&format!("the pkg-config module {name}"), known.pkg_config(name))
            }
            MissingDependency::Module(name) => advise(&format!("the Python module {name}"), known.module(name)),
            MissingDependency::Library(name) => advise(&format!("the library {name}"), known.library(&name)),
        })
        .collect()
}

/// Adds the advice to the error of a failed build.
pub(crate) fn add_advice(error: Error, known: AdviceIndex<'_>) -> Error {
    match error {
        Error::BuildFailed { package, log, last_lines, .. } => {
            Error::BuildFailed { advice: advise_for_output(&last_lines, known), package, log, last_lines }
        }
        Error::NotInPackage { what: what @ "executable", name, known: there, .. } => Error::NotInPackage {
            elsewhere: known.programs(name.rsplit('/').next().unwrap_or(&name)),
            what,
            name,
            known: there,
        },
        Error::NoLaunch { module, .. } => Error::NoLaunch { with: known.module(&module), module },
        other => other,
    }
}

fn advise(what: &str, with: Option<String>) -> String {
    match with {
        Some(name) => format!("{what} is missing: push with `--with {name}`"),
        None => format!(
            "{what} is missing, and no package of the archive has it: push a workspace that also contains its source"
        ),
    }
}

/// Returns the Debian package whose name is closest to what is looked for.
pub(crate) fn nearest_name<'a>(debs: &BTreeSet<&'a str>, name: &str) -> Option<&'a str> {
    let plain = name.to_lowercase().replace('_', "-");
    debs.iter().min_by_key(|deb| (!deb.contains(&plain), deb.len(), **deb)).copied()
}

/// Returns whether a line of output names a missing dependency.
pub(crate) fn mentions_missing(line: &str) -> bool {
    parse_missing(line).is_some()
}

fn parse_missing(line: &str) -> Option<MissingDependency<'_>> {
    let after = |words: &str| line.split_once(words).map(|(_, rest)| rest);
    let until = |rest: &'_ str, ends: &[char]| rest.find(ends).unwrap_or(rest.len());
    if let Some(rest) = after("Could not find a package configuration file provided by \"") {
        return Some(MissingDependency::Config(&rest[..until(rest, &['"'])]));
    }
    if let Some(rest) = after("Could NOT find ")
        && let Some((name, _)) = rest.split_once(" (missing:")
        && !line.starts_with("-- ")
    {
        return Some(MissingDependency::Found(name));
    }
    if let Some((name, _)) = after("No package '").and_then(|rest| rest.split_once("' found")) {
        return Some(MissingDependency::PkgConfig(name));
    }
    if let Some((name, rest)) = after("Package '").and_then(|rest| rest.split_once("', "))
        && rest.ends_with("not found")
    {
        return Some(MissingDependency::PkgConfig(name));
    }
    if let Some(rest) = after("No module named ") {
        let rest = rest.trim_start_matches(['\'', '"']);
        let name = &rest[..until(rest, &['\'', '"', '.', ';', ' '])];
        return (!name.is_empty()).then_some(MissingDependency::Module(name));
    }
    if let Some(rest) = after("cannot find -l") {
        let name = &rest[..until(rest, &[':', ' '])];
        return Some(MissingDependency::Library(format!("lib{name}.so")));
    }
    if line.contains("cannot open shared object file") {
        let name = line.split([' ', ':']).find(|word| word.starts_with("lib") && word.contains(".so"))?;
        return Some(MissingDependency::Library(name.to_owned()));
    }
    None
}

#[cfg(test)]
mod tests {
    use ros::flavour::Version;

    use super::*;
    use crate::contents::tests::list;

    fn contents() -> (tempfile::TempDir, Contents) {
        let directory = tempfile::tempdir().expect("a directory");
        let triplet = crate::contents::triplet();
        let text = format!(
            "usr/share/rosbag_storage/package.xml libdevel/librosbag-storage-dev\n\
             usr/share/rosbag_storage/cmake/rosbag_storageConfig.cmake libdevel/librosbag-storage-dev\n\
             usr/lib/{triplet}/cmake/Ceres/CeresConfig.cmake libdevel/libceres-dev\n\
             usr/lib/python3/dist-packages/joblib/__init__.py python/python3-joblib\n\
             usr/lib/python3/dist-packages/six.py python/python3-six\n\
             usr/lib/{triplet}/libgsl.so.27 libs/libgsl27\n\
             usr/lib/{triplet}/libgsl.so libdevel/libgsl-dev\n\
             usr/share/topic_tools/package.xml devel/libtopic-tools-dev\n\
             usr/lib/topic_tools/relay utils/topic-tools\n\
             usr/lib/gcc/relay devel/gcc\n\
             usr/lib/{triplet}/pkgconfig/gsl.pc libdevel/libgsl-dev\n\
             usr/share/pkgconfig/eigen3.pc libdevel/libeigen3-dev\n\
             usr/share/eigen3/cmake/Eigen3Config.cmake libdevel/libeigen3-dev\n"
        );
        let contents = Contents::open(directory.path(), &[list(directory.path(), "c.gz", &text)]).expect("read");
        (directory, contents)
    }

    #[test]
    fn what_is_missed_is_named_with_the_option_that_adds_it() {
        let (_directory, contents) = contents();
        for (words, advice) in [
            (
                "  Could not find a package configuration file provided by \"rosbag_storage\"\n  with any of",
                "the CMake package rosbag_storage is missing: push with `--with rosbag_storage`",
            ),
            (
                "  Could not find a package configuration file provided by \"Ceres\" with any",
                "the CMake package Ceres is missing: push with `--with libceres-dev`",
            ),
            (
                "ModuleNotFoundError: No module named 'joblib.memory'",
                "the Python module joblib is missing: push with `--with python3-joblib`",
            ),
            ("ImportError: No module named six", "the Python module six is missing: push with `--with python3-six`"),
            (
                "/usr/bin/ld: cannot find -lgsl: No such file or directory",
                "the library libgsl.so is missing: push with `--with libgsl-dev`",
            ),
            (
                "/x/node: error while loading shared libraries: libgsl.so.27: cannot open shared object file: No such",
                "the library libgsl.so.27 is missing: push with `--with libgsl27`",
            ),
            (
                "No package 'gsl' found, for pkg-config",
                "the pkg-config module gsl is missing: push with `--with libgsl-dev`",
            ),
            (
                "Package 'eigen3', required by 'virtual:world', not found",
                "the pkg-config module eigen3 is missing: push with `--with libeigen3-dev`",
            ),
            (
                "  Could NOT find Eigen3 (missing: Eigen3_DIR)",
                "the CMake package Eigen3 is missing: push with `--with libeigen3-dev`",
            ),
            (
                "  Could NOT find GLUT (missing: GLUT_glut_LIBRARY)",
                "GLUT is missing, which CMake searches with FindGLUT.cmake: push with `--with PACKAGE`, the Debian \
                    package with its files",
            ),
            (
                "Could not find a package configuration file provided by \"warp\" with",
                "the CMake package warp is missing, and no package of the archive has it: push a workspace that also \
                    contains its source",
            ),
        ] {
            assert_eq!(advise_for_output(words, AdviceIndex::for_ros1(&contents)), [advice], "{words}");
        }
        for words in [
            "main.cpp:3: error: expected ;",
            // Not stated to be required.
            "--   No package 'gsl' found",
            "--   Package 'gsl', required by 'virtual:world', not found\n\
             CMake Error at /usr/share/cmake-3.25/Modules/FindPkgConfig.cmake:607 (message):",
            "-- Could NOT find Eigen3 (missing: Eigen3_DIR)",
        ] {
            assert!(advise_for_output(words, AdviceIndex::for_ros1(&contents)).is_empty(), "{words}");
        }
    }

    #[test]
    fn a_program_that_another_package_has_is_found() {
        let (_directory, contents) = contents();
        let error = Error::NotInPackage {
            what: "executable",
            name: "relay".into(),
            known: "none".into(),
            elsewhere: String::new(),
        };
        let text = add_advice(error, AdviceIndex::for_ros1(&contents)).to_string();
        assert!(
            text.contains("available: none") && text.contains("`--apt topic_tools`") && !text.contains("gcc"),
            "{text}"
        );
    }

    #[test]
    fn on_a_base_of_ros_2_the_distributions_ros_1_is_not_advised() {
        let directory = tempfile::tempdir().expect("a directory");
        let modules = "usr/lib/python3/dist-packages";
        let text = format!(
            "usr/share/tf2_ros/package.xml libdevel/libtf2-ros-dev\n\
             usr/share/tf2_ros/cmake/tf2_rosConfig.cmake libdevel/libtf2-ros-dev\n\
             {modules}/tf2_ros/__init__.py python/python3-tf2-ros\n\
             {modules}/joblib/__init__.py python/python3-joblib\n"
        );
        let lists = [list(directory.path(), "c.gz", &text)];
        let images = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
        let mut base = crate::base::load(&images, crate::DEFAULT_BASE).expect("valid");
        base.definition.ros = Version::Ros2;
        base.definition.ros_distribution = "jazzy".to_owned();
        let mut archive = Archive {
            apt: crate::apt::Apt::open(directory.path(), "").expect("prepared"),
            contents: Contents::open(directory.path(), &lists).expect("read").into(),
            candidates: crate::candidates::tests::candidates_named(&["python3-tf2-ros", "python3-joblib"]),
            stamp: String::new(),
            sources: String::new(),
        };
        let words = "ModuleNotFoundError: No module named 'tf2_ros'\n\
                     Could not find a package configuration file provided by \"tf2_ros\"\n\
                     ModuleNotFoundError: No module named 'joblib'";
        let advice = advise_for_output(words, AdviceIndex::for_base(&archive, &base)).join("\n");
        assert_eq!(advice.matches("no package of the archive has it").count(), 2, "{advice}");
        assert!(advice.contains("`--with python3-joblib`"), "{advice}");
        archive.candidates = crate::candidates::tests::candidates_named(&["ros-jazzy-tf2-ros"]);
        let advice = advise_for_output(words, AdviceIndex::for_base(&archive, &base)).join("\n");
        assert_eq!(advice.matches("`--with ros-jazzy-tf2-ros`").count(), 2, "{advice}");
    }
}
