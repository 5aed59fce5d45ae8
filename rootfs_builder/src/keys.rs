//! From the names in a package.xml (rosdep keys and ROS packages) to Debian packages.
//!
//! In this order: what the deployer said (`--map`), what is in the same workspace, the base's table, ROS packages of
//! the archive, a Debian package of that very name.

use std::collections::{BTreeMap, BTreeSet};

use crate::archive::Archive;
use crate::base::Base;
use crate::error::{Error, Unresolved};

/// Who asks for what.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Asked {
    /// Key → packages that ask for it while compiling.
    pub(crate) build: BTreeMap<String, BTreeSet<String>>,
    /// Key → packages that ask for it at run time.
    pub(crate) run: BTreeMap<String, BTreeSet<String>>,
}

/// What it comes to.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Resolved {
    /// Debian packages to compile with.
    pub(crate) build: BTreeSet<String>,
    /// Debian packages to run with.
    pub(crate) run: BTreeSet<String>,
    /// ROS packages to run with, to be gathered.
    pub(crate) run_ros: BTreeSet<String>,
}

enum Found {
    Debs(Vec<String>),
    Ros,
    Nothing,
}

/// Resolves all keys, or names all that nothing provides. `own`: packages of the workspace itself.
pub(crate) fn resolve(
    archive: &Archive,
    base: &Base,
    map: &BTreeMap<String, String>,
    own: &BTreeSet<String>,
    asked: &Asked,
) -> Result<Resolved, Error> {
    let find = |key: &str| -> Found {
        if let Some(deb) = map.get(key) {
            return Found::Debs(deb.split([',', ' ']).filter(|deb| !deb.is_empty()).map(str::to_owned).collect());
        }
        if let Some(debs) = base.keys.get(key) {
            return Found::Debs(debs.clone());
        }
        if !archive.contents.ros_package(key).is_empty() {
            return Found::Ros;
        }
        if archive.names.contains(key) {
            return Found::Debs(vec![key.to_owned()]);
        }
        Found::Nothing
    };
    let mut resolved = Resolved::default();
    let mut missing: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    let mut miss = |key: &str, by: &BTreeSet<String>| missing.entry(key.to_owned()).or_default().extend(by.clone());
    for (key, by) in asked.build.iter().filter(|(key, _)| !own.contains(*key)) {
        match find(key) {
            Found::Debs(debs) => resolved.build.extend(debs),
            Found::Ros => resolved.build.extend(archive.to_build(key)),
            Found::Nothing if base.ros_packages.ignore.contains(key) => {}
            Found::Nothing => miss(key, by),
        }
    }
    for (key, by) in asked.run.iter().filter(|(key, _)| !own.contains(*key)) {
        match find(key) {
            // What is linked from a development package is found by what the result needs.
            Found::Debs(debs) => resolved.run.extend(debs.into_iter().filter(|deb| !deb.ends_with("-dev"))),
            Found::Ros if base.ros_packages.ignore.contains(key) => {}
            Found::Ros => {
                resolved.run_ros.insert(key.clone());
            }
            Found::Nothing if base.ros_packages.ignore.contains(key) => {}
            Found::Nothing => miss(key, by),
        }
    }
    // What the deployer wrote may be wrong as well.
    for (key, debs) in map {
        for deb in debs.split([',', ' ']).filter(|deb| !deb.is_empty() && !archive.names.contains(*deb)) {
            missing.entry(deb.to_owned()).or_default().insert(format!("--map {key}={debs}"));
        }
    }
    if missing.is_empty() {
        return Ok(resolved);
    }
    Err(Error::Unresolved(
        missing
            .into_iter()
            .map(|(key, by)| Unresolved { similar: archive.similar(&key), wanted_by: by.into_iter().collect(), key })
            .collect(),
    ))
}
