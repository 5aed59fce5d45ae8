//! Search for packages in a pushed directory. Their package.xml files are not read here.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::install_space::{self, LocatedSpace, MARKER};
use crate::{Error, read};

/// Marker files that exclude a directory and everything below it from a workspace.
const IGNORE: [&str; 3] = ["CATKIN_IGNORE", "COLCON_IGNORE", "AMENT_IGNORE"];

pub(crate) const MAX_PACKAGES: usize = 1000;
const MAX_DIRECTORIES: usize = 50_000;
const MAX_DEPTH: usize = 32;

/// Result of the search.
pub(crate) struct Located {
    /// Canonical path of what was pushed.
    pub(crate) root: PathBuf,
    pub(crate) what: LocatedKind,
}

pub(crate) enum LocatedKind {
    /// Directories of packages, below the root; at least one.
    Sources(Vec<PathBuf>),
    /// An install space.
    Space(LocatedSpace),
}

impl Located {
    /// Returns the directory that the packages' paths are relative to.
    pub(crate) fn base(&self) -> &Path {
        match &self.what {
            LocatedKind::Sources(_) => &self.root,
            LocatedKind::Space(space) => &space.root,
        }
    }

    /// Returns the directories of packages, relative to [`Located::base`].
    pub(crate) fn packages(&self) -> &[PathBuf] {
        match &self.what {
            LocatedKind::Sources(packages) => packages,
            LocatedKind::Space(space) => &space.packages,
        }
    }
}

/// Searches a directory; see [`crate::workspace::inspect`] for the rules.
pub(crate) fn locate(root: &Path) -> Result<Located, Error> {
    let real = root.canonicalize().map_err(|error| read::file_error("open", root, error))?;
    if !real.is_dir() {
        let error = std::io::Error::from(std::io::ErrorKind::NotADirectory);
        return Err(read::file_error("open", root, error));
    }
    if real.join("package.xml").is_file() {
        return Ok(Located { root: real, what: LocatedKind::Sources(vec![PathBuf::new()]) });
    }
    let has_sources = real.join("src").is_dir();
    for candidate in [real.clone(), real.join("install")] {
        if has_sources && candidate != real {
            continue;
        }
        if let Some(space) = install_space::find_install_space(&real, &candidate)? {
            return Ok(Located { root: real, what: LocatedKind::Space(space) });
        }
    }
    let start = if has_sources { PathBuf::from("src") } else { PathBuf::new() };
    let mut search = PackageSearch { root: &real, seen: BTreeSet::new(), packages: Vec::new(), ignored: 0 };
    search.search_directory(&start, 0)?;
    let PackageSearch { packages, ignored, .. } = search;
    if packages.is_empty() {
        return Err(Error::NoPackage { path: root.to_owned(), looked_for: describe_search(has_sources, ignored) });
    }
    Ok(Located { root: real, what: LocatedKind::Sources(packages) })
}

fn describe_search(has_sources: bool, ignored: usize) -> String {
    let place = if has_sources { "below its src" } else { "anywhere below it" };
    let mut text =
        format!("no package.xml in it or {place}, no {MARKER} with a setup.sh, and no {}", install_space::INDEX);
    if ignored > 0 {
        text.push_str(&format!(" ({ignored} directories were skipped because of a file such as {})", IGNORE[0]));
    }
    text
}

/// Resolves a path; fails if the result is not below `root`.
fn resolve_inside(root: &Path, path: &Path) -> Result<PathBuf, Error> {
    let real = path.canonicalize().map_err(|error| read::file_error("open", path, error))?;
    if real.starts_with(root) {
        return Ok(real);
    }
    Err(Error::Outside { path: path.to_owned(), root: root.to_owned() })
}

/// Returns the subdirectories of a directory, sorted by name, including links that stay in `root`.
pub(crate) fn subdirectories(root: &Path, directory: &Path) -> Result<Vec<PathBuf>, Error> {
    let failed = |error| read::file_error("list", directory, error);
    let mut found = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let kind = entry.file_type().map_err(failed)?;
        let hidden = entry.file_name().as_encoded_bytes().starts_with(b".");
        // A link that is dangling or leads outside is not a package's directory.
        let within =
            kind.is_dir() || kind.is_symlink() && resolve_inside(root, &entry.path()).is_ok_and(|real| real.is_dir());
        if within && !hidden {
            found.push(entry.path());
        }
    }
    found.sort();
    Ok(found)
}

/// Rejects an excessive number of packages.
pub(crate) fn check_package_count(packages: usize, path: &Path) -> Result<(), Error> {
    if packages <= MAX_PACKAGES {
        return Ok(());
    }
    Err(Error::TooMany { path: path.to_owned(), what: "packages", limit: MAX_PACKAGES })
}

/// Search for source packages.
struct PackageSearch<'a> {
    root: &'a Path,
    /// Canonical paths visited, so that links cause no cycles and no package is found twice.
    seen: BTreeSet<PathBuf>,
    packages: Vec<PathBuf>,
    /// Number of directories excluded by a marker file.
    ignored: usize,
}

impl PackageSearch<'_> {
    fn search_directory(&mut self, path: &Path, depth: usize) -> Result<(), Error> {
        let directory = self.root.join(path);
        if !self.seen.insert(resolve_inside(self.root, &directory)?) {
            return Ok(());
        }
        if self.seen.len() > MAX_DIRECTORIES {
            return Err(Error::TooMany { path: self.root.to_owned(), what: "directories", limit: MAX_DIRECTORIES });
        }
        if IGNORE.iter().any(|name| directory.join(name).exists()) {
            self.ignored += 1;
            return Ok(());
        }
        if directory.join(MARKER).is_file() {
            return Ok(());
        }
        if directory.join("package.xml").is_file() {
            self.packages.push(path.to_owned());
            return check_package_count(self.packages.len(), self.root);
        }
        if depth >= MAX_DEPTH {
            return Ok(());
        }
        for below in subdirectories(self.root, &directory)? {
            let below = below.strip_prefix(self.root).unwrap_or(&below).to_owned();
            self.search_directory(&below, depth + 1)?;
        }
        Ok(())
    }
}
