//! Finds in the output of a build or a node what is missing, and the option of `push` that adds it.

use std::collections::BTreeSet;

use crate::contents::Contents;
use crate::error::Error;

/// Something missing, under the name that the output gives it.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Missed<'a> {
    /// CMake's `find_package(NAME)`.
    Config(&'a str),
    /// Python's `import NAME`.
    Module(&'a str),
    /// A shared library by its file name.
    Library(String),
}

/// One line of advice for each missing thing that `words` names; empty if it names none.
pub(crate) fn for_words(words: &str, contents: &Contents) -> Vec<String> {
    let missed: BTreeSet<Missed<'_>> = words.lines().filter_map(missed).collect();
    missed
        .into_iter()
        .map(|missed| match missed {
            Missed::Config(name) => {
                let ros = !contents.ros_package(name).is_empty();
                let mut debs = contents.cmake_config(name);
                if ros {
                    debs.insert(name);
                }
                // As a ROS package it comes whole: its definitions and plugins, too.
                let with = if ros {
                    Some(name)
                } else {
                    nearest(&debs, name)
                };
                told(&format!("the CMake package {name}"), with)
            }
            Missed::Module(name) => told(
                &format!("the Python module {name}"),
                nearest(&contents.python_module(name), name),
            ),
            Missed::Library(name) => told(&format!("the library {name}"), contents.library(&name)),
        })
        .collect()
}

/// The error of a failed build with that advice.
pub(crate) fn on(error: Error, contents: &Contents) -> Error {
    match error {
        Error::BuildFailed {
            package,
            log,
            last_lines,
            ..
        } => Error::BuildFailed {
            advice: for_words(&last_lines, contents),
            package,
            log,
            last_lines,
        },
        Error::NotInPackage {
            what: what @ "executable",
            name,
            known,
            ..
        } => {
            let program = name.rsplit('/').next().unwrap_or(&name);
            let places = contents.programs(program).into_iter();
            let places: Vec<String> = places
                .map(|(package, deb)| {
                    format!(
                        "; the ROS package {package} (Debian's {deb}) has it: push with `--apt {package}`, or add \
                         `--with {package}` and write `--node {package}/{program}`"
                    )
                })
                .collect();
            Error::NotInPackage {
                elsewhere: places.concat(),
                what,
                name,
                known,
            }
        }
        other => other,
    }
}

fn told(what: &str, with: Option<&str>) -> String {
    match with {
        Some(name) => format!("{what} is missing: push with `--with {name}`"),
        None => format!(
            "{what} is missing, and no package of the archive has it: push a workspace that holds its source, too"
        ),
    }
}

/// The Debian package whose name is nearest to what is looked for.
pub(crate) fn nearest<'a>(debs: &BTreeSet<&'a str>, name: &str) -> Option<&'a str> {
    let plain = name.to_lowercase().replace('_', "-");
    debs.iter()
        .min_by_key(|deb| (!deb.contains(&plain), deb.len(), **deb))
        .copied()
}

fn missed(line: &str) -> Option<Missed<'_>> {
    let after = |words: &str| line.split_once(words).map(|(_, rest)| rest);
    let until = |rest: &'_ str, ends: &[char]| rest.find(ends).unwrap_or(rest.len());
    if let Some(rest) = after("Could not find a package configuration file provided by \"") {
        return Some(Missed::Config(&rest[..until(rest, &['"'])]));
    }
    if let Some(rest) = after("No module named ") {
        let rest = rest.trim_start_matches(['\'', '"']);
        let name = &rest[..until(rest, &['\'', '"', '.', ';', ' '])];
        return (!name.is_empty()).then_some(Missed::Module(name));
    }
    if let Some(rest) = after("cannot find -l") {
        let name = &rest[..until(rest, &[':', ' '])];
        return Some(Missed::Library(format!("lib{name}.so")));
    }
    if line.contains("cannot open shared object file") {
        let name = line
            .split([' ', ':'])
            .find(|word| word.starts_with("lib") && word.contains(".so"))?;
        return Some(Missed::Library(name.to_owned()));
    }
    None
}

#[cfg(test)]
mod tests {
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
             usr/lib/gcc/relay devel/gcc\n"
        );
        let contents = Contents::open(directory.path(), &[list(directory.path(), "c.gz", &text)])
            .expect("read");
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
            (
                "ImportError: No module named six",
                "the Python module six is missing: push with `--with python3-six`",
            ),
            (
                "/usr/bin/ld: cannot find -lgsl: No such file or directory",
                "the library libgsl.so is missing: push with `--with libgsl-dev`",
            ),
            (
                "/x/node: error while loading shared libraries: libgsl.so.27: cannot open shared object file: No such",
                "the library libgsl.so.27 is missing: push with `--with libgsl27`",
            ),
            (
                "Could not find a package configuration file provided by \"warp\" with",
                "the CMake package warp is missing, and no package of the archive has it: push a workspace that holds \
                 its source, too",
            ),
        ] {
            assert_eq!(for_words(words, &contents), [advice], "{words}");
        }
        assert!(for_words("main.cpp:3: error: expected ;", &contents).is_empty());
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
        let text = on(error, &contents).to_string();
        assert!(
            text.contains("there are: none")
                && text.contains("`--apt topic_tools`")
                && !text.contains("gcc"),
            "{text}"
        );
    }
}
