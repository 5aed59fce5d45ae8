//! Inventory of an image: install spaces, ROS packages with their executables, message definitions. It is taken once,
//! when a revision is published, and recorded with it, so that layers need not be searched afterwards.

mod launch;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path};

use serde::{Deserialize, Serialize};

use crate::definitions::{self, Definitions};
use crate::merged::{self, LayerDirectory, MergedDirectory};
use crate::{Error, ament, names};

/// Maximum number of links followed in a chain.
const MAX_LINKS: usize = 8;
/// Maximum number of install spaces searched.
const MAX_PREFIXES: usize = 1024;

/// Content of an image.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Inventory {
    /// Install spaces (absolute paths), in the order in which the nodes search them.
    pub prefixes: Vec<String>,
    /// ROS packages by name, each in the first install space that contains it.
    pub packages: BTreeMap<String, InstalledPackage>,
    /// Executables of the pushed package that the revision's nodes run: absolute paths by name. A stub may start these
    /// and no others.
    pub programs: BTreeMap<String, String>,
    /// Texts of message, service and action definitions.
    pub definitions: Definitions,
}

/// An installed package.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct InstalledPackage {
    /// Share directory, which contains `package.xml`; absolute.
    pub share: String,
    /// Directory of the executables, absolute; empty if there are none.
    pub lib: String,
    /// Names of the executables.
    pub executables: BTreeSet<String>,
    /// Launch files, as paths below `share`.
    #[serde(default, skip_serializing_if = "BTreeSet::is_empty")]
    pub launch_files: BTreeSet<String>,
    /// Component classes (ROS 2), each with the absolute path of its library.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub components: BTreeMap<String, String>,
}

/// Properties of a revision that determine where to search.
#[derive(Debug, Clone, Copy)]
pub struct SearchHints<'a> {
    /// Pushed package.
    pub package: &'a str,
    /// Environment of every process.
    pub environment: &'a BTreeMap<String, String>,
    /// Command lines of the nodes.
    pub commands: &'a [&'a [String]],
}

impl Inventory {
    /// Takes the inventory of a stack of extracted layers, given lowest first. Blocking.
    pub fn scan<L: AsRef<Path>>(layers: &[L], of: SearchHints<'_>) -> Result<Self, Error> {
        let stack = merged::open_layers(layers)?;
        let prefixes = find_prefixes(&stack, of)?;
        let shares: Vec<String> = prefixes.iter().map(|p| format!("{p}/share")).collect();
        Ok(Self {
            packages: find_packages(&stack, &prefixes)?,
            programs: find_programs(&stack, of),
            definitions: definitions::read(layers, &shares)?,
            prefixes,
        })
    }
}

/// Returns the names of the packages with a package.xml in these install spaces (absolute paths in the layers).
/// `layers` are extracted trees, lowest first. Blocking.
pub fn find_manifests<L: AsRef<Path>, P: AsRef<str>>(layers: &[L], prefixes: &[P]) -> Result<BTreeSet<String>, Error> {
    let stack = merged::open_layers(layers)?;
    let mut found = BTreeSet::new();
    for prefix in prefixes {
        let share = MergedDirectory::open_path(&stack, &format!("{}/share", prefix.as_ref()))?;
        for name in share.names()?.into_keys().filter_map(|name| String::from_utf8(name).ok()) {
            if names::is_package(&name)
                && share.open_child(name.as_bytes())?.names()?.contains_key(b"package.xml".as_slice())
            {
                found.insert(name);
            }
        }
    }
    Ok(found)
}

/// Returns the install spaces: those named by the environment and the nodes, then `/usr`, then others below `/opt`.
fn find_prefixes(stack: &[LayerDirectory], of: SearchHints<'_>) -> Result<Vec<String>, Error> {
    let variable = |name| of.environment.get(name).map_or("", String::as_str).split(':');
    let spaces = variable("AMENT_PREFIX_PATH").chain(variable("CMAKE_PREFIX_PATH"));
    let mut named: Vec<String> = spaces.map(str::to_owned).collect();
    let shares = variable("ROS_PACKAGE_PATH").filter_map(|share| share.strip_suffix("/share"));
    named.extend(shares.map(str::to_owned));
    // PREFIX/lib/PACKAGE/PROGRAM
    let of_program = |command: &&[String]| {
        let prefix = Path::new(command.first()?).ancestors().nth(3)?;
        Some(prefix.to_str()?.to_owned())
    };
    named.extend(of.commands.iter().filter_map(of_program));
    named.push("/usr".to_owned());
    for space in list_directories(stack, "/opt")? {
        let inner = list_directories(stack, &space)?;
        named.push(space);
        named.extend(inner);
    }
    let mut seen = BTreeSet::new();
    named.retain(|prefix| {
        let mut parts = Path::new(prefix).components();
        prefix.len() > 1
            && prefix.starts_with('/')
            && parts.all(|part| part != Component::ParentDir)
            && seen.insert(prefix.trim_end_matches('/').to_owned())
    });
    named.truncate(MAX_PREFIXES);
    let mut prefixes = Vec::new();
    for prefix in named {
        let prefix = prefix.trim_end_matches('/');
        if MergedDirectory::open_path(stack, &format!("{prefix}/share"))?.exists()
            || MergedDirectory::open_path(stack, &format!("{prefix}/lib"))?.exists()
        {
            prefixes.push(prefix.to_owned());
        }
    }
    Ok(prefixes)
}

/// Returns the subdirectories of a directory, as absolute paths.
fn list_directories(stack: &[LayerDirectory], parent: &str) -> Result<Vec<String>, Error> {
    let directory = MergedDirectory::open_path(stack, parent)?;
    let mut found = Vec::new();
    for name in directory.names()?.into_keys() {
        if let Ok(text) = std::str::from_utf8(&name)
            && directory.open_child(&name)?.exists()
        {
            found.push(format!("{parent}/{text}"));
        }
    }
    Ok(found)
}

fn find_packages(stack: &[LayerDirectory], prefixes: &[String]) -> Result<BTreeMap<String, InstalledPackage>, Error> {
    let mut packages: BTreeMap<String, InstalledPackage> = BTreeMap::new();
    for prefix in prefixes {
        let share = MergedDirectory::open_path(stack, &format!("{prefix}/share"))?;
        let indexed = ament::packages_in(stack, prefix)?;
        let named = share.names()?.into_keys();
        let mut named: BTreeSet<String> = named
            .filter_map(|name| String::from_utf8(name).ok())
            .filter(|name| names::is_package(name) && !indexed.contains(name))
            .collect();
        named.extend(indexed.iter().cloned());
        for name in named {
            if packages.contains_key(&name) {
                continue;
            }
            let own = share.open_child(name.as_bytes())?;
            let is_package = own.names()?.contains_key(b"package.xml".as_slice());
            if !is_package && !indexed.contains(&name) {
                continue;
            }
            let components =
                if indexed.contains(&name) { ament::components(stack, prefix, &name)? } else { Vec::new() };
            let components = components.into_iter();
            let installed = InstalledPackage {
                share: format!("{prefix}/share/{name}"),
                launch_files: launch::find_launch_files(&own)?,
                components: components.map(|(class, library)| (class, format!("{prefix}/{library}"))).collect(),
                ..InstalledPackage::default()
            };
            packages.insert(name, installed);
        }
    }
    for prefix in prefixes {
        let libraries = MergedDirectory::open_path(stack, &format!("{prefix}/lib"))?;
        for (name, package) in &mut packages {
            if package.lib.is_empty() {
                let executables = find_executables(&libraries.open_child(name.as_bytes())?)?;
                if !executables.is_empty() {
                    package.lib = format!("{prefix}/lib/{name}");
                    package.executables = executables;
                }
            }
        }
    }
    Ok(packages)
}

/// Suffix of input files of `dynamic_reconfigure`'s code generator, which are executable but useless at run time.
const OF_BUILDS: &str = ".cfg";

/// Returns the names of executables. A link counts as one.
fn find_executables(lib: &MergedDirectory) -> Result<BTreeSet<String>, Error> {
    let mut found = BTreeSet::new();
    for (name, level) in lib.names()? {
        let Ok(text) = String::from_utf8(name.clone()) else {
            continue;
        };
        if names::is_executable(&text)
            && !text.ends_with(OF_BUILDS)
            && (level.is_executable(&name) || level.link(&name).is_some())
        {
            found.insert(text);
        }
    }
    Ok(found)
}

fn find_programs(stack: &[LayerDirectory], of: SearchHints<'_>) -> BTreeMap<String, String> {
    let package = of.package;
    let below = [format!("/lib/{package}/"), format!("/share/{package}/")];
    let of_package =
        |argument: &&String| argument.starts_with('/') && below.iter().any(|below| argument.contains(below));
    // Nodes also get files of the package as arguments. A file that cannot be found or inspected is assumed to be an
    // executable, since it was when it was started.
    let runs = |path: &&String| !matches!(is_program(stack, Path::new(path)), Ok(Some(false)));
    let commands = of.commands.iter();
    commands
        .filter_map(|command| command.iter().filter(of_package).find(runs))
        .filter_map(|path| Some((path.rsplit('/').next()?.to_owned(), path.clone())))
        .filter(|(name, _)| names::is_executable(name))
        .collect()
}

/// Returns whether the file at an absolute path is executable; `None` if it does not exist. Links are followed as by a
/// process in the image.
fn is_program(stack: &[LayerDirectory], path: &Path) -> Result<Option<bool>, Error> {
    let mut path = path.to_owned();
    for _ in 0..MAX_LINKS {
        let (Some(parent), Some(name)) = (path.parent(), path.file_name()) else {
            return Ok(None);
        };
        let Some(directory) = parent.to_str() else {
            return Ok(None);
        };
        let directory = MergedDirectory::open_path(stack, directory)?;
        let names = directory.names()?;
        let Some((name, level)) = names.get_key_value(name.as_encoded_bytes()) else {
            return Ok(None);
        };
        match level.link(name) {
            Some(target) => path = parent.join(target),
            None => return Ok(Some(level.is_executable(name))),
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests;
