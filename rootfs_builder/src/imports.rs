//! Imports of Python files in Debian packages. Debian's dependencies do not cover all of them: a package.xml names a
//! ROS package whose Python module is in a separate Debian package, and scripts are not inspected when a package is
//! built.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::advice;
use crate::archive::Archive;
use crate::cache::write_atomically;
use crate::cache_cleanup;
use crate::deb::{self, MemberContent};
use crate::error::{Error, IoContext};

/// Directory below the cache; to be changed when the cached content changes.
const CACHE_DIRECTORY: &str = "imports-1";

/// Top-level modules that the Python files of a Debian package import when they are loaded.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Imports {
    /// Imports of the modules in the package.
    pub(crate) modules: BTreeSet<String>,
    /// Imports of each program of a ROS package, by name.
    pub(crate) programs: BTreeMap<String, BTreeSet<String>>,
}

/// Programs that may be run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum SelectedPrograms {
    /// Programs with these names.
    Named(BTreeSet<String>),
    /// Any program: a launch file decides.
    All,
}

impl Imports {
    /// Returns the imports of the selected programs and of all modules of the package.
    pub(crate) fn for_programs(self, programs: &SelectedPrograms) -> BTreeSet<String> {
        let runs = |name: &String| match programs {
            SelectedPrograms::Named(names) => names.contains(name),
            SelectedPrograms::All => true,
        };
        let run = self.programs.into_iter().filter(|(name, _)| runs(name));
        run.flat_map(|(_, modules)| modules).chain(self.modules).collect()
    }
}

/// Inspects a Debian package. The result is cached below `cache` under the name of the package's file. Blocking.
pub(crate) fn read_imports(deb: &Path, cache: &Path) -> Result<Imports, Error> {
    let directory = cache.join(CACHE_DIRECTORY);
    let path = directory.join(deb.file_name().unwrap_or_default());
    if let Some(found) = fs::read(&path).ok().and_then(|text| serde_json::from_slice(&text).ok()) {
        cache_cleanup::mark_used(&path);
        return Ok(found);
    }
    let mut found = Imports::default();
    for member in deb::read_members(deb, is_relevant)? {
        let MemberContent::File(bytes) = &member.content else {
            continue;
        };
        let name = member.path.file_name().unwrap_or_default();
        if member.path.starts_with(MODULES) {
            found.modules.extend(parse_imports(&String::from_utf8_lossy(bytes)));
        } else if let Some(modules) = program_imports(bytes) {
            let name = name.to_string_lossy().into_owned();
            found.programs.insert(name, modules);
        }
    }
    fs::create_dir_all(&directory).io_context("making", &directory)?;
    write_atomically(&path, &serde_json::to_vec(&found).unwrap_or_default())?;
    Ok(found)
}

/// Returns the Debian package to install for an import; `None` for modules of Python itself.
pub(crate) fn provider_package<'a>(archive: &'a Archive, module: &str) -> Option<&'a str> {
    let mut debs = archive.contents.python_module(module);
    debs.retain(|deb| archive.candidates.contains(deb));
    advice::nearest_name(&debs, module)
}

const MODULES: &str = "usr/lib/python3/dist-packages";

/// Returns whether a path is a program of a ROS package, or a Python module.
fn is_relevant(path: &Path) -> bool {
    if path.starts_with(MODULES) {
        return path.extension().is_some_and(|extension| extension == "py");
    }
    let parts: Vec<&str> = path.iter().filter_map(|part| part.to_str()).collect();
    matches!(parts.as_slice(), ["usr", "lib", _, program] if !program.contains(".so"))
}

/// Returns the imports of a program; `None` if it is not a Python program.
pub(crate) fn program_imports(bytes: &[u8]) -> Option<BTreeSet<String>> {
    is_python_program(bytes).then(|| parse_imports(&String::from_utf8_lossy(bytes)))
}

fn is_python_program(bytes: &[u8]) -> bool {
    let first = bytes.split(|byte| *byte == b'\n').next().unwrap_or_default();
    first.starts_with(b"#!") && String::from_utf8_lossy(first).contains("python")
}

/// Parses the imports that are not indented: others are in functions, or in a `try` that handles a missing module.
fn parse_imports(text: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for line in text.lines() {
        let names: Vec<&str> = if let Some(names) = line.strip_prefix("import ") {
            names.split(',').collect()
        } else if let Some((name, _)) = line.strip_prefix("from ").and_then(|rest| rest.split_once(" import ")) {
            vec![name]
        } else {
            continue;
        };
        // `a.b as c # …`
        let first = |name: &str| {
            let name = name.trim_start();
            let end = name.find(|c: char| !(c.is_alphanumeric() || c == '_'));
            name[..end.unwrap_or(name.len())].to_owned()
        };
        found.extend(names.into_iter().map(first));
    }
    found.remove("");
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(names: &[&str]) -> BTreeSet<String> {
        names.iter().map(|&name| name.to_owned()).collect()
    }

    #[test]
    fn imports_are_those_that_loading_needs() {
        let text = "#!/usr/bin/env python\n\
                    import os, numpy as np  # arrays\n\
                    import a.b.c\n\
                    from tf.transformations import (\n    quaternion_inverse)\n\
                    from .near import x\n\
                    from . import y\n\
                    import_name = 'import this'\n\
                    try:\n    import optional\nexcept ImportError:\n    pass\n\
                    def f():\n    import late\n";
        assert_eq!(parse_imports(text), set(&["a", "numpy", "os", "tf"]));
    }

    #[test]
    fn programs_and_modules_are_looked_into() {
        for (path, expected) in [
            ("usr/lib/robot/monitor", true),
            ("usr/lib/python3/dist-packages/robot/core/x.py", true),
            ("usr/lib/python3/dist-packages/robot/core/x.json", false),
            ("usr/lib/x86_64-linux-gnu/librobot.so.1", false),
            ("usr/share/robot/x.py", false),
        ] {
            assert_eq!(is_relevant(Path::new(path)), expected, "{path}");
        }
        assert!(is_python_program(b"#! /usr/bin/python3\nimport a"));
        assert!(!is_python_program(b"\x7fELF\x00python"));
        assert!(!is_python_program(b"#!/bin/sh\npython\n"));
    }

    #[test]
    fn only_what_is_run_counts() {
        let imports = || Imports {
            modules: set(&["genpy"]),
            programs: [("a", "numpy"), ("b", "cv2")].map(|(name, module)| (name.to_owned(), set(&[module]))).into(),
        };
        let named = |names: &[&str]| imports().for_programs(&SelectedPrograms::Named(set(names)));
        assert_eq!(named(&[]), set(&["genpy"]));
        assert_eq!(named(&["a", "other"]), set(&["genpy", "numpy"]));
        assert_eq!(imports().for_programs(&SelectedPrograms::All), set(&["cv2", "genpy", "numpy"]));
    }
}
