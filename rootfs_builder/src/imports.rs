//! What Python files of Debian packages import. Debian's own dependencies leave some of it out: a package.xml names a
//! ROS package, of which the Python module is in a Debian package of its own, and scripts are not looked into when a
//! package is made.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::advice;
use crate::archive::Archive;
use crate::cache::write_whole;
use crate::deb::{self, Content};
use crate::error::{Error, IoAt};
use crate::unused;

/// Below the cache; raise it when what is kept changes.
const KEPT: &str = "imports-1";

/// Modules that Python files of a Debian package import as soon as they are loaded, by the first part of their names.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Imports {
    /// By all modules that are in the package.
    pub(crate) modules: BTreeSet<String>,
    /// By each program of a ROS package, by its name.
    pub(crate) programs: BTreeMap<String, BTreeSet<String>>,
}

/// Programs that may be run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Programs {
    /// Those of these names.
    Named(BTreeSet<String>),
    /// Any: a launch file decides.
    All,
}

impl Imports {
    /// What is imported if these programs are run, and the modules of the package are imported themselves.
    pub(crate) fn of(self, programs: &Programs) -> BTreeSet<String> {
        let runs = |name: &String| match programs {
            Programs::Named(names) => names.contains(name),
            Programs::All => true,
        };
        let run = self.programs.into_iter().filter(|(name, _)| runs(name));
        run.flat_map(|(_, modules)| modules)
            .chain(self.modules)
            .collect()
    }
}

/// Looks into a Debian package. What is found is kept below `cache`, named as the package's file is. Blocking.
pub(crate) fn of_package(deb: &Path, cache: &Path) -> Result<Imports, Error> {
    let directory = cache.join(KEPT);
    let path = directory.join(deb.file_name().unwrap_or_default());
    if let Some(found) = fs::read(&path)
        .ok()
        .and_then(|text| serde_json::from_slice(&text).ok())
    {
        unused::used(&path);
        return Ok(found);
    }
    let mut found = Imports::default();
    for member in deb::members(deb, wanted)? {
        let Content::File(bytes) = &member.content else {
            continue;
        };
        let name = member.path.file_name().unwrap_or_default();
        if member.path.starts_with(MODULES) {
            found
                .modules
                .extend(of_text(&String::from_utf8_lossy(bytes)));
        } else if let Some(modules) = of_program(bytes) {
            let name = name.to_string_lossy().into_owned();
            found.programs.insert(name, modules);
        }
    }
    fs::create_dir_all(&directory).at("making", &directory)?;
    write_whole(&path, &serde_json::to_vec(&found).unwrap_or_default())?;
    Ok(found)
}

/// The Debian package that is to be installed for an import; none for modules of Python itself.
pub(crate) fn provider<'a>(archive: &'a Archive, module: &str) -> Option<&'a str> {
    let mut debs = archive.contents.python_module(module);
    debs.retain(|deb| archive.candidates.contains(deb));
    advice::nearest(&debs, module)
}

const MODULES: &str = "usr/lib/python3/dist-packages";

/// Programs of ROS packages, and modules.
fn wanted(path: &Path) -> bool {
    if path.starts_with(MODULES) {
        return path.extension().is_some_and(|extension| extension == "py");
    }
    let parts: Vec<&str> = path.iter().filter_map(|part| part.to_str()).collect();
    matches!(parts.as_slice(), ["usr", "lib", _, program] if !program.contains(".so"))
}

/// What a program imports; none where it is not one of Python.
pub(crate) fn of_program(bytes: &[u8]) -> Option<BTreeSet<String>> {
    is_python_program(bytes).then(|| of_text(&String::from_utf8_lossy(bytes)))
}

fn is_python_program(bytes: &[u8]) -> bool {
    let first = bytes
        .split(|byte| *byte == b'\n')
        .next()
        .unwrap_or_default();
    first.starts_with(b"#!") && String::from_utf8_lossy(first).contains("python")
}

/// Statements that are not indented: others are in functions, or in a `try` that can do without the module.
fn of_text(text: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for line in text.lines() {
        let names: Vec<&str> = if let Some(names) = line.strip_prefix("import ") {
            names.split(',').collect()
        } else if let Some((name, _)) = line
            .strip_prefix("from ")
            .and_then(|rest| rest.split_once(" import "))
        {
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
        assert_eq!(of_text(text), set(&["a", "numpy", "os", "tf"]));
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
            assert_eq!(wanted(Path::new(path)), expected, "{path}");
        }
        assert!(is_python_program(b"#! /usr/bin/python3\nimport a"));
        assert!(!is_python_program(b"\x7fELF\x00python"));
        assert!(!is_python_program(b"#!/bin/sh\npython\n"));
    }

    #[test]
    fn only_what_is_run_counts() {
        let imports = || Imports {
            modules: set(&["genpy"]),
            programs: [("a", "numpy"), ("b", "cv2")]
                .map(|(name, module)| (name.to_owned(), set(&[module])))
                .into(),
        };
        let named = |names: &[&str]| imports().of(&Programs::Named(set(names)));
        assert_eq!(named(&[]), set(&["genpy"]));
        assert_eq!(named(&["a", "other"]), set(&["genpy", "numpy"]));
        assert_eq!(
            imports().of(&Programs::All),
            set(&["cv2", "genpy", "numpy"])
        );
    }
}
