//! What a pushed directory is: one package, a workspace of several, or an install space.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::condition::Variables;
use crate::locate::{What, locate};
use crate::manifest::{Kind, Manifest};
use crate::{Error, install_space, order};

pub use crate::install_space::Layout;

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

/// An install space.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InstallSpace {
    /// The directory with `setup.sh`.
    pub root: PathBuf,
    /// How packages are laid out in it.
    pub layout: Layout,
    /// Where it was installed when it was built, which its scripts and configuration files still name. One of catkin
    /// works only there; one of ROS 2 where it is told that it is. None when its scripts name no place.
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
/// A `package.xml` in it makes it one package; a `.catkin` file with a `setup.sh` or `_setup_util.py`, or ament's index
/// of packages, an install space (also one directory down, in `install`); otherwise packages are looked for in `src`,
/// or if there is none in the whole directory: not in hidden or ignored directories or result spaces, and not within
/// packages. Links are followed as long as they stay inside.
pub fn inspect(root: &Path, variables: &Variables) -> Result<Pushed, Error> {
    let located = locate(root)?;
    let mut packages = BTreeMap::new();
    for path in located.packages() {
        let found = package(&located.root, located.base(), path, variables)?;
        insert(&mut packages, found)?;
    }
    let packages = packages.into_values().collect();
    Ok(match located.what {
        What::Sources(_) => Pushed::Source(Workspace {
            root: located.root,
            packages: order::build_order(packages)?,
        }),
        What::Space(space) => Pushed::Installed(InstallSpace {
            prefix: install_space::prefix(&located.root, &space.root)?,
            layout: space.layout,
            root: space.root,
            packages,
        }),
    })
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

/// The package in `base/path`, whose links may lead anywhere in `root`.
fn package(root: &Path, base: &Path, path: &Path, variables: &Variables) -> Result<Package, Error> {
    let file = base.join(path).join("package.xml");
    Ok(Package {
        manifest: Manifest::read_inside(root, &file, variables)?,
        path: path.to_owned(),
    })
}

fn insert(packages: &mut BTreeMap<String, Package>, package: Package) -> Result<(), Error> {
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

#[cfg(test)]
mod tests;
