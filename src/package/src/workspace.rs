//! Kinds of pushed directories: a single package, a workspace of several, or an install space.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::condition::Variables;
use crate::locate::{LocatedKind, locate};
use crate::manifest::{Kind, Manifest};
use crate::provided::{self, Providers};
use crate::{Error, install_space, order};

pub use crate::install_space::Layout;

/// Content of a pushed directory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PushedDirectory {
    /// Sources, which are to be built.
    Source(Workspace),
    /// An install space that was built elsewhere and is placed at its original prefix.
    Installed(InstallSpace),
}

/// A package in a pushed directory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Package {
    /// Directory of the package, relative to what was pushed; empty for the directory itself.
    pub path: PathBuf,
    /// Content of its `package.xml`.
    pub manifest: Manifest,
    /// Names of the Python modules in the sources of an `ament_python` package.
    pub modules: BTreeSet<String>,
}

/// A workspace of source packages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Workspace {
    /// Directory that was pushed.
    pub root: PathBuf,
    /// At least one package; each after its build dependencies.
    pub packages: Vec<Package>,
    /// Directories of packages that are not built, relative to the root.
    pub left_out: Vec<PathBuf>,
}

/// An install space.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InstallSpace {
    /// Directory with `setup.sh`.
    pub root: PathBuf,
    /// Layout of the packages.
    pub layout: Layout,
    /// Prefix for which it was built, which its scripts and configuration files still contain. A catkin space works
    /// only there; a ROS 2 space works elsewhere if it is told where it is. `None` if its scripts contain no prefix.
    pub prefix: Option<PathBuf>,
    /// Packages, sorted by name.
    pub packages: Vec<Package>,
}

/// A dependency that was not pushed together with the packages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExternalDependency {
    /// Name of a ROS package, or a rosdep key.
    pub name: String,
    /// Kinds of the dependency, such as at build time or at run time.
    pub kinds: BTreeSet<Kind>,
    /// Packages that need it.
    pub needed_by: BTreeSet<String>,
}

impl PushedDirectory {
    /// Returns the packages of either kind.
    pub fn packages(&self) -> &[Package] {
        match self {
            Self::Source(workspace) => &workspace.packages,
            Self::Installed(space) => &space.packages,
        }
    }

    /// Returns the external dependencies of the packages, sorted by name.
    pub fn external_dependencies(&self) -> Vec<ExternalDependency> {
        external_dependencies(self.packages())
    }
}

/// Inspects a directory.
///
/// A directory with a `package.xml` is a single package; one with a `.catkin` file and a `setup.sh` or
/// `_setup_util.py`, or with ament's package index, is an install space (also one level down, in `install`). Otherwise
/// packages are searched in `src`, or in the whole directory if there is none: not in hidden or ignored directories or
/// result spaces, and not within packages. Links are followed as long as they stay inside.
pub fn inspect(root: &Path, variables: &Variables) -> Result<PushedDirectory, Error> {
    let located = locate(root)?;
    let mut packages = BTreeMap::new();
    for path in located.packages() {
        let found = read_package(&located.root, located.base(), path, variables)?;
        insert_unique(&mut packages, found)?;
    }
    let packages = packages.into_values().collect();
    Ok(match located.what {
        LocatedKind::Sources(_) => {
            let packages = order::build_order(packages)?;
            PushedDirectory::Source(Workspace { root: located.root, packages, left_out: Vec::new() })
        }
        LocatedKind::Space(space) => PushedDirectory::Installed(InstallSpace {
            prefix: install_space::read_prefix(&located.root, &space.root)?,
            layout: space.layout,
            root: space.root,
            packages,
        }),
    })
}

/// Returns the dependencies of packages that no one of them is or provides, sorted by name.
pub fn external_dependencies(packages: &[Package]) -> Vec<ExternalDependency> {
    let own: BTreeSet<&str> = packages.iter().map(|package| package.manifest.name.as_str()).collect();
    let providers = Providers::new(packages);
    let mut found: BTreeMap<&str, ExternalDependency> = BTreeMap::new();
    for package in packages {
        for dependency in &package.manifest.dependencies {
            let name = dependency.name.as_str();
            if own.contains(name) || !providers.find(&package.manifest, name).is_empty() {
                continue;
            }
            let external = found.entry(name).or_insert_with(|| ExternalDependency {
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

/// Reads the package in `base/path`, whose links may point anywhere in `root`.
fn read_package(root: &Path, base: &Path, path: &Path, variables: &Variables) -> Result<Package, Error> {
    let file = base.join(path).join("package.xml");
    let manifest = Manifest::load(root, &file, variables)?;
    let modules = match manifest.build_type.as_str() {
        "ament_python" => provided::find_modules(&base.join(path)),
        _ => BTreeSet::new(),
    };
    Ok(Package { path: path.to_owned(), manifest, modules })
}

fn insert_unique(packages: &mut BTreeMap<String, Package>, package: Package) -> Result<(), Error> {
    match packages.get(&package.manifest.name) {
        Some(first) => {
            Err(Error::SameName { name: package.manifest.name, first: first.path.clone(), second: package.path })
        }
        None => {
            packages.insert(package.manifest.name.clone(), package);
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests;
