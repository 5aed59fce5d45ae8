//! Where in a pushed directory packages are. Their package.xml files are not read here.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::install_space::{self, MARKER, Space};
use crate::{Error, read};

/// Files that keep a directory and all below it out of a workspace.
const IGNORE: [&str; 3] = ["CATKIN_IGNORE", "COLCON_IGNORE", "AMENT_IGNORE"];

pub(crate) const MAX_PACKAGES: usize = 1000;
const MAX_DIRECTORIES: usize = 50_000;
const MAX_DEPTH: usize = 32;

/// What was found.
pub(crate) struct Located {
    /// What was pushed: its real path.
    pub(crate) root: PathBuf,
    pub(crate) what: What,
}

pub(crate) enum What {
    /// Directories of packages, below the root; at least one.
    Sources(Vec<PathBuf>),
    /// An install space.
    Space(Space),
}

impl Located {
    /// The directory that paths of packages begin at.
    pub(crate) fn base(&self) -> &Path {
        match &self.what {
            What::Sources(_) => &self.root,
            What::Space(space) => &space.root,
        }
    }

    /// Directories of packages, below [`Located::base`].
    pub(crate) fn packages(&self) -> &[PathBuf] {
        match &self.what {
            What::Sources(packages) => packages,
            What::Space(space) => &space.packages,
        }
    }
}

/// Looks through a directory; see [`crate::workspace::inspect`] for the rules.
pub(crate) fn locate(root: &Path) -> Result<Located, Error> {
    let real = root
        .canonicalize()
        .map_err(|error| read::failed("open", root, error))?;
    if !real.is_dir() {
        let error = std::io::Error::from(std::io::ErrorKind::NotADirectory);
        return Err(read::failed("open", root, error));
    }
    if real.join("package.xml").is_file() {
        return Ok(Located {
            root: real,
            what: What::Sources(vec![PathBuf::new()]),
        });
    }
    let has_sources = real.join("src").is_dir();
    for candidate in [real.clone(), real.join("install")] {
        if has_sources && candidate != real {
            continue;
        }
        if let Some(space) = install_space::at(&real, &candidate)? {
            return Ok(Located {
                root: real,
                what: What::Space(space),
            });
        }
    }
    let start = if has_sources {
        PathBuf::from("src")
    } else {
        PathBuf::new()
    };
    let mut search = Search {
        root: &real,
        seen: BTreeSet::new(),
        packages: Vec::new(),
        ignored: 0,
    };
    search.directory(&start, 0)?;
    let Search {
        packages, ignored, ..
    } = search;
    if packages.is_empty() {
        return Err(Error::NoPackage {
            path: root.to_owned(),
            looked_for: looked_for(has_sources, ignored),
        });
    }
    Ok(Located {
        root: real,
        what: What::Sources(packages),
    })
}

fn looked_for(has_sources: bool, ignored: usize) -> String {
    let place = if has_sources {
        "below its src"
    } else {
        "anywhere below it"
    };
    let mut text = format!(
        "there is no package.xml in it or {place}, no {MARKER} with a setup.sh, and no {}",
        install_space::INDEX
    );
    if ignored > 0 {
        text.push_str(&format!(
            " ({ignored} directories hold a file such as {} and were left out)",
            IGNORE[0]
        ));
    }
    text
}

/// Where a path really is, if that is below `root`.
fn inside(root: &Path, path: &Path) -> Result<PathBuf, Error> {
    let real = path
        .canonicalize()
        .map_err(|error| read::failed("open", path, error))?;
    if real.starts_with(root) {
        return Ok(real);
    }
    Err(Error::Outside {
        path: path.to_owned(),
        root: root.to_owned(),
    })
}

/// Directories in a directory, by name, links that stay in `root` included.
pub(crate) fn subdirectories(root: &Path, directory: &Path) -> Result<Vec<PathBuf>, Error> {
    let failed = |error| read::failed("list", directory, error);
    let mut found = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let kind = entry.file_type().map_err(failed)?;
        let hidden = entry.file_name().as_encoded_bytes().starts_with(b".");
        // A link that leads nowhere or out of here is no package's directory.
        let within = kind.is_dir()
            || kind.is_symlink() && inside(root, &entry.path()).is_ok_and(|real| real.is_dir());
        if within && !hidden {
            found.push(entry.path());
        }
    }
    found.sort();
    Ok(found)
}

/// Refuses more packages than can sensibly be.
pub(crate) fn not_too_many(packages: usize, path: &Path) -> Result<(), Error> {
    if packages <= MAX_PACKAGES {
        return Ok(());
    }
    Err(Error::TooMany {
        path: path.to_owned(),
        what: "packages",
        limit: MAX_PACKAGES,
    })
}

/// Looks for source packages.
struct Search<'a> {
    root: &'a Path,
    /// Real paths, so that links make no circles and no package is found twice.
    seen: BTreeSet<PathBuf>,
    packages: Vec<PathBuf>,
    /// Directories left out by an ignore file.
    ignored: usize,
}

impl Search<'_> {
    fn directory(&mut self, path: &Path, depth: usize) -> Result<(), Error> {
        let directory = self.root.join(path);
        if !self.seen.insert(inside(self.root, &directory)?) {
            return Ok(());
        }
        if self.seen.len() > MAX_DIRECTORIES {
            return Err(Error::TooMany {
                path: self.root.to_owned(),
                what: "directories",
                limit: MAX_DIRECTORIES,
            });
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
            return not_too_many(self.packages.len(), self.root);
        }
        if depth >= MAX_DEPTH {
            return Ok(());
        }
        for below in subdirectories(self.root, &directory)? {
            let below = below.strip_prefix(self.root).unwrap_or(&below).to_owned();
            self.directory(&below, depth + 1)?;
        }
        Ok(())
    }
}
