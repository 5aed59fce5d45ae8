//! Python scripts in the sources of a package that are meant to be run.

use std::io::Read;
use std::path::{Component, Path, PathBuf};

use foreign::Visit;
use rustix::fs::FileType;

/// Maximum number of scripts of a package.
const MAX_SCRIPTS: usize = 1000;
/// Directories whose files are for builds, tests or people.
const EXCLUDED_DIRECTORIES: [&str; 11] =
    ["build", "devel", "install", "test", "tests", "doc", "docs", "cfg", "cmake", "launch", "__pycache__"];
/// Directories of a ROS 1 package whose files are installed only if its build files state so.
const UNINSTALLED_DIRECTORIES: [&str; 10] =
    ["build", "devel", "install", "test", "tests", "doc", "docs", "include", "__pycache__", "cmake"];
/// Directories whose scripts are programs even if they are not executable.
const PLACES: [&str; 3] = ["scripts", "nodes", "bin"];

/// A script with a first line that names Python.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Script {
    /// Path relative to the package.
    pub(super) path: PathBuf,
    pub(super) is_executable: bool,
}

impl Script {
    pub(super) fn name(&self) -> Option<&str> {
        self.path.file_name()?.to_str()
    }
}

/// Returns the scripts in the directory of a package that are executable, or in a directory of scripts. Unreadable
/// files are ignored.
pub(super) fn find_scripts(directory: &Path) -> Vec<Script> {
    let mut found = Vec::new();
    // The package may be behind a link that stays inside, as in the search of the workspace.
    let directory = directory.canonicalize().unwrap_or_else(|_| directory.to_owned());
    let _ = foreign::walk(&directory, |entry| {
        let name = entry.name().to_string_lossy();
        let is_root = entry.path.as_os_str().is_empty();
        match entry.kind() {
            FileType::Directory if !is_root && (name.starts_with('.') || EXCLUDED_DIRECTORIES.contains(&&*name)) => {
                return Ok(Visit::Skip);
            }
            FileType::RegularFile if found.len() < MAX_SCRIPTS => {}
            _ => return Ok(Visit::Into),
        }
        let is_executable = entry.stat.st_mode & 0o100 != 0;
        let is_in_place =
            entry.path.parent().is_some_and(|parent| PLACES.iter().any(|place| parent == Path::new(place)));
        let is_for_builds = name == "setup.py" || name.ends_with(".cfg") || name.starts_with('.');
        if (is_executable || is_in_place) && !is_for_builds {
            let mut start = [0; 64];
            let read = entry.open()?.read(&mut start).unwrap_or(0);
            let first = start[..read].split(|byte| *byte == b'\n').next().unwrap_or_default();
            if first.starts_with(b"#!") && first.windows(6).any(|word| word == b"python") {
                found.push(Script { path: entry.path.to_owned(), is_executable });
            }
        }
        Ok::<_, foreign::Error>(Visit::Into)
    });
    found
}

/// Returns whether a file of a ROS 1 package is copied to its share directory regardless of its build files.
pub(super) fn is_shared(path: &Path) -> bool {
    path.components().all(|part| match part {
        Component::Normal(name) => {
            let name = name.to_string_lossy();
            !name.starts_with('.') && !UNINSTALLED_DIRECTORIES.contains(&&*name)
        }
        _ => false,
    })
}
