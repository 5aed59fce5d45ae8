//! What a pushed directory is: one package, a workspace of several, or an install space.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::condition::Variables;
use crate::manifest::{Kind, Manifest};
use crate::{Error, order, read};

/// Files that keep a directory and all below it out of a workspace.
const IGNORE: [&str; 3] = ["CATKIN_IGNORE", "COLCON_IGNORE", "AMENT_IGNORE"];

/// Marks a catkin result space: empty in an install space, a list of sources in a devel space.
const MARKER: &str = ".catkin";

const MAX_PACKAGES: usize = 1000;
const MAX_DIRECTORIES: usize = 50_000;
const MAX_DEPTH: usize = 32;
/// `setup.sh`, the marker and the like.
const MAX_BYTES: u64 = 1 << 20;

/// What was pushed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Pushed {
    /// Sources, to be built.
    Source(Workspace),
    /// Built elsewhere, to be put where it was built for.
    Installed(InstallSpace),
}

/// A package in a directory that was pushed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Package {
    /// Its directory, below what was pushed; empty for the directory itself.
    pub path: PathBuf,
    /// Its `package.xml`.
    pub manifest: Manifest,
}

/// Source packages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Workspace {
    /// What was pushed.
    pub root: PathBuf,
    /// At least one, each after those it needs to be built.
    pub packages: Vec<Package>,
}

/// A catkin install space.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InstallSpace {
    /// The directory with `setup.sh`.
    pub root: PathBuf,
    /// Where it was installed when it was built, which its scripts and configuration files still name: it works
    /// only there. None when its `setup.sh` names no place.
    pub prefix: Option<PathBuf>,
    /// By name.
    pub packages: Vec<Package>,
}

/// Something that packages need and that was not pushed with them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct External {
    /// A ROS package or rosdep key.
    pub name: String,
    /// The kinds of dependency, such as at build or at run time.
    pub kinds: BTreeSet<Kind>,
    /// The packages that need it.
    pub needed_by: BTreeSet<String>,
}

impl Pushed {
    /// The packages, whichever it is.
    pub fn packages(&self) -> &[Package] {
        match self {
            Self::Source(workspace) => &workspace.packages,
            Self::Installed(space) => &space.packages,
        }
    }

    /// What its packages need besides each other, by name.
    pub fn external(&self) -> Vec<External> {
        external(self.packages())
    }
}

/// Looks at a directory.
///
/// A `package.xml` in it makes it one package; a `.catkin` file with a `setup.sh` or `_setup_util.py` an install
/// space (also one directory down, in `install`); otherwise packages are looked for in `src`, or if there is none
/// in the whole directory: not in hidden or ignored directories or result spaces, and not within packages. Links
/// are followed as long as they stay inside.
pub fn inspect(root: &Path, variables: &Variables) -> Result<Pushed, Error> {
    let real = root
        .canonicalize()
        .map_err(|error| read::failed("open", root, error))?;
    if !real.is_dir() {
        let error = std::io::Error::from(std::io::ErrorKind::NotADirectory);
        return Err(read::failed("open", root, error));
    }
    if real.join("package.xml").is_file() {
        let packages = vec![package(&real, PathBuf::new(), variables)?];
        return Ok(Pushed::Source(Workspace {
            root: real,
            packages,
        }));
    }
    let has_sources = real.join("src").is_dir();
    for candidate in [real.clone(), real.join("install")] {
        if is_result_space(&candidate) && !(has_sources && candidate != real) {
            return install_space(&real, &candidate, variables).map(Pushed::Installed);
        }
    }
    let start = if has_sources {
        PathBuf::from("src")
    } else {
        PathBuf::new()
    };
    let mut search = Search {
        root: &real,
        variables,
        seen: BTreeSet::new(),
        packages: BTreeMap::new(),
        ignored: 0,
    };
    search.directory(&start, 0)?;
    let ignored = search.ignored;
    if search.packages.is_empty() {
        let place = if has_sources {
            "below its src"
        } else {
            "anywhere below it"
        };
        let mut looked_for =
            format!("there is no package.xml in it or {place}, and no {MARKER} with a setup.sh");
        if ignored > 0 {
            looked_for.push_str(&format!(
                " ({ignored} directories hold a file such as {} and were left out)",
                IGNORE[0]
            ));
        }
        return Err(Error::NoPackage {
            path: root.to_owned(),
            looked_for,
        });
    }
    let packages = order::build_order(search.packages.into_values().collect())?;
    Ok(Pushed::Source(Workspace {
        root: real,
        packages,
    }))
}

/// What packages need besides each other, by name.
pub fn external(packages: &[Package]) -> Vec<External> {
    let own: BTreeSet<&str> = packages
        .iter()
        .map(|package| package.manifest.name.as_str())
        .collect();
    let mut found: BTreeMap<&str, External> = BTreeMap::new();
    for package in packages {
        for dependency in &package.manifest.dependencies {
            let name = dependency.name.as_str();
            if own.contains(name) {
                continue;
            }
            let external = found.entry(name).or_insert_with(|| External {
                name: name.to_owned(),
                kinds: BTreeSet::new(),
                needed_by: BTreeSet::new(),
            });
            external.kinds.insert(dependency.kind);
            external.needed_by.insert(package.manifest.name.clone());
        }
    }
    found.into_values().collect()
}

fn is_result_space(directory: &Path) -> bool {
    directory.join(MARKER).is_file()
        && ["setup.sh", "_setup_util.py"]
            .iter()
            .any(|name| directory.join(name).is_file())
}

/// The package in `root/path`.
fn package(root: &Path, path: PathBuf, variables: &Variables) -> Result<Package, Error> {
    let file = root.join(&path).join("package.xml");
    let manifest = Manifest::read_inside(root, &file, variables)?;
    Ok(Package { path, manifest })
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

fn install_space(root: &Path, space: &Path, variables: &Variables) -> Result<InstallSpace, Error> {
    let marker = read::text_inside(root, &space.join(MARKER), MAX_BYTES)?;
    if !marker.trim().is_empty() {
        return Err(Error::DevelSpace {
            path: space.to_owned(),
        });
    }
    let mut packages = BTreeMap::new();
    let share = space.join("share");
    if share.is_dir() {
        for path in subdirectories(root, &share)? {
            if !path.join("package.xml").is_file() {
                continue;
            }
            let below = path.strip_prefix(space).unwrap_or(&path).to_owned();
            insert(
                &mut packages,
                package_below(root, space, below, variables)?,
                space,
            )?;
        }
    }
    if packages.is_empty() {
        let looked_for = "it is an install space without a share/*/package.xml".to_owned();
        return Err(Error::NoPackage {
            path: space.to_owned(),
            looked_for,
        });
    }
    let prefix = prefix(root, space)?;
    Ok(InstallSpace {
        root: space.to_owned(),
        prefix,
        packages: packages.into_values().collect(),
    })
}

/// The package in `space/path`, whose links may lead anywhere in `root`.
fn package_below(
    root: &Path,
    space: &Path,
    path: PathBuf,
    variables: &Variables,
) -> Result<Package, Error> {
    let file = space.join(&path).join("package.xml");
    Ok(Package {
        manifest: Manifest::read_inside(root, &file, variables)?,
        path,
    })
}

/// `setup.sh` falls back to where it was installed: `: ${_CATKIN_SETUP_DIR:=/where/it/was}`.
fn prefix(root: &Path, space: &Path) -> Result<Option<PathBuf>, Error> {
    let script = space.join("setup.sh");
    if !script.is_file() {
        return Ok(None);
    }
    let text = read::text_inside(root, &script, MAX_BYTES)?;
    let after = text
        .split_once("_CATKIN_SETUP_DIR:=")
        .map(|(_, after)| after);
    let named = after
        .and_then(|after| after.split(['}', '\n']).next())
        .map(|name| name.trim_matches(['"', '\'']));
    // It becomes a path in the image: nothing but a plain absolute path will do.
    let plain = named.filter(|name| {
        name.starts_with('/')
            && name.len() > 1
            && name
                .chars()
                .all(|c| c.is_alphanumeric() || "/_-.+@ ".contains(c))
            && name.split('/').all(|part| part != "..")
    });
    Ok(plain.map(|name| PathBuf::from(name.trim_end_matches('/'))))
}

/// Directories in a directory, by name, links that stay in `root` included.
fn subdirectories(root: &Path, directory: &Path) -> Result<Vec<PathBuf>, Error> {
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

fn insert(
    packages: &mut BTreeMap<String, Package>,
    package: Package,
    root: &Path,
) -> Result<(), Error> {
    if packages.len() >= MAX_PACKAGES {
        return Err(Error::TooMany {
            path: root.to_owned(),
            what: "packages",
            limit: MAX_PACKAGES,
        });
    }
    match packages.get(&package.manifest.name) {
        Some(first) => Err(Error::SameName {
            name: package.manifest.name,
            first: first.path.clone(),
            second: package.path,
        }),
        None => {
            packages.insert(package.manifest.name.clone(), package);
            Ok(())
        }
    }
}

/// Looks for packages.
struct Search<'a> {
    root: &'a Path,
    variables: &'a Variables,
    /// Real paths, so that links make no circles and no package is found twice.
    seen: BTreeSet<PathBuf>,
    packages: BTreeMap<String, Package>,
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
            let path = self.root.to_owned();
            return Err(Error::TooMany {
                path,
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
            let found = package(self.root, path.to_owned(), self.variables)?;
            return insert(&mut self.packages, found, self.root);
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

#[cfg(test)]
mod tests;
