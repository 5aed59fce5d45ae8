//! What an image holds: install spaces, ROS packages with their programs, message definitions. It is looked for once, when a
//! revision is published, and recorded with it; nobody searches layers afterwards.

mod launch;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path};

use serde::{Deserialize, Serialize};

use crate::definitions::{self, Definitions};
use crate::merged::{self, Level, Merged};
use crate::{Error, ament, names};

/// Links that are followed from one to the next.
const MAX_LINKS: usize = 8;
/// Install spaces that are looked into.
const MAX_PREFIXES: usize = 1024;

/// What an image holds.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Inventory {
    /// Install spaces, absolute, in the order in which the nodes search them.
    pub prefixes: Vec<String>,
    /// ROS packages by name, each as the first install space that has it.
    pub packages: BTreeMap<String, Installed>,
    /// Programs of the pushed package that the revision's nodes run: absolute paths by name. A stub may have these
    /// started and no others.
    pub programs: BTreeMap<String, String>,
    /// Texts of message, service and action definitions.
    pub definitions: Definitions,
}

/// Where a package is installed.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Installed {
    /// What it shares: the directory of its `package.xml`, absolute.
    pub share: String,
    /// The directory of its programs, absolute; empty where it has none.
    pub lib: String,
    /// Names of the programs there.
    pub executables: BTreeSet<String>,
    /// Launch files, by their paths below `share`.
    #[serde(default, skip_serializing_if = "BTreeSet::is_empty")]
    pub launch_files: BTreeSet<String>,
    /// Classes of nodes for component containers (ROS 2), each with its library's absolute path.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub components: BTreeMap<String, String>,
}

/// What a revision says of itself, which tells where to look.
#[derive(Debug, Clone, Copy)]
pub struct Published<'a> {
    /// The pushed package.
    pub package: &'a str,
    /// Environment of every process.
    pub environment: &'a BTreeMap<String, String>,
    /// Command lines of its nodes.
    pub commands: &'a [&'a [String]],
}

impl Inventory {
    /// Looks through a stack of extracted layers, given lowest first. Blocking.
    pub fn take<L: AsRef<Path>>(layers: &[L], of: Published<'_>) -> Result<Self, Error> {
        let stack = merged::open(layers)?;
        let prefixes = prefixes(&stack, of)?;
        let shares: Vec<String> = prefixes.iter().map(|p| format!("{p}/share")).collect();
        Ok(Self {
            packages: packages(&stack, &prefixes)?,
            programs: programs(&stack, of),
            definitions: definitions::read(layers, &shares)?,
            prefixes,
        })
    }
}

/// Install spaces, as the environment and the nodes name them, then `/usr`, then others below `/opt`.
fn prefixes(stack: &[Level], of: Published<'_>) -> Result<Vec<String>, Error> {
    let variable = |name| {
        of.environment
            .get(name)
            .map_or("", String::as_str)
            .split(':')
    };
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
    for space in below(stack, "/opt")? {
        let inner = below(stack, &space)?;
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
        if Merged::at(stack, &format!("{prefix}/share"))?.exists()
            || Merged::at(stack, &format!("{prefix}/lib"))?.exists()
        {
            prefixes.push(prefix.to_owned());
        }
    }
    Ok(prefixes)
}

/// Directories in a directory, absolute.
fn below(stack: &[Level], parent: &str) -> Result<Vec<String>, Error> {
    let directory = Merged::at(stack, parent)?;
    let mut found = Vec::new();
    for name in directory.names()?.into_keys() {
        if let Ok(text) = std::str::from_utf8(&name)
            && directory.below(&name)?.exists()
        {
            found.push(format!("{parent}/{text}"));
        }
    }
    Ok(found)
}

fn packages(stack: &[Level], prefixes: &[String]) -> Result<BTreeMap<String, Installed>, Error> {
    let mut packages: BTreeMap<String, Installed> = BTreeMap::new();
    for prefix in prefixes {
        let share = Merged::at(stack, &format!("{prefix}/share"))?;
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
            let own = share.below(name.as_bytes())?;
            let is_package = own.names()?.contains_key(b"package.xml".as_slice());
            if !is_package && !indexed.contains(&name) {
                continue;
            }
            let components = match indexed.contains(&name) {
                true => ament::components(stack, prefix, &name)?,
                false => Vec::new(),
            };
            let components = components.into_iter();
            let installed = Installed {
                share: format!("{prefix}/share/{name}"),
                launch_files: launch::files(&own)?,
                components: components
                    .map(|(class, library)| (class, format!("{prefix}/{library}")))
                    .collect(),
                ..Installed::default()
            };
            packages.insert(name, installed);
        }
    }
    for prefix in prefixes {
        let libraries = Merged::at(stack, &format!("{prefix}/lib"))?;
        for (name, package) in &mut packages {
            if package.lib.is_empty() {
                let executables = executables(&libraries.below(name.as_bytes())?)?;
                if !executables.is_empty() {
                    package.lib = format!("{prefix}/lib/{name}");
                    package.executables = executables;
                }
            }
        }
    }
    Ok(packages)
}

/// What `dynamic_reconfigure` makes code of: executable, and of no use to a node.
const OF_BUILDS: &str = ".cfg";

/// Names of programs. A link to one is one.
fn executables(lib: &Merged) -> Result<BTreeSet<String>, Error> {
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

fn programs(stack: &[Level], of: Published<'_>) -> BTreeMap<String, String> {
    let package = of.package;
    let below = [format!("/lib/{package}/"), format!("/share/{package}/")];
    let of_package = |argument: &&String| {
        argument.starts_with('/') && below.iter().any(|below| argument.contains(below))
    };
    // Nodes are given files of the package, too. What cannot be found or looked at is taken for a program, as it was
    // when it was started.
    let runs = |path: &&String| !matches!(is_program(stack, Path::new(path)), Ok(Some(false)));
    let commands = of.commands.iter();
    commands
        .filter_map(|command| command.iter().filter(of_package).find(runs))
        .filter_map(|path| Some((path.rsplit('/').next()?.to_owned(), path.clone())))
        .filter(|(name, _)| names::is_executable(name))
        .collect()
}

/// Whether the file at an absolute path may be executed; none where there is none. Links are followed as a process in the
/// image would.
fn is_program(stack: &[Level], path: &Path) -> Result<Option<bool>, Error> {
    let mut path = path.to_owned();
    for _ in 0..MAX_LINKS {
        let (Some(parent), Some(name)) = (path.parent(), path.file_name()) else {
            return Ok(None);
        };
        let Some(directory) = parent.to_str() else {
            return Ok(None);
        };
        let directory = Merged::at(stack, directory)?;
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
