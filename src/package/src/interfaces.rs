//! The interfaces that packages of ROS 2 define (`msg`, `srv` and `action` of their sources), read before anything is
//! compiled: a mistake, or a type that nobody defines, is told with its file and line at once, and not from within a
//! code generator.

use std::path::{Path, PathBuf};

use foreign::{Found, Tree};
use ros::bus::RosVersion;
use ros::schema::{InterfaceFile, Registry, SchemaError};

use crate::definitions::Definitions;
use crate::workspace::{Package, Workspace};
use crate::{Error, names, read};

/// The largest file that is read.
const MAX_BYTES: u64 = 256 << 10;
/// `CMakeLists.txt`.
const MAX_BUILD_FILE: u64 = 1 << 20;
/// Files of one directory.
const MAX_FILES: usize = 20_000;
/// The function that makes code of interfaces.
const GENERATE: &str = "rosidl_generate_interfaces";

/// Directories of a package, and the extensions of the files in them.
const KINDS: [(&str, &str); 3] = [("msg", "msg"), ("srv", "srv"), ("action", "action")];

/// An interface of a package's sources.
struct Source {
    /// `package/msg/Type`
    key: String,
    /// Below what was pushed.
    path: PathBuf,
    text: String,
    /// The build makes code of it.
    is_built: bool,
}

/// Checks those of a workspace. `known`: definitions that its packages are built with. Blocking.
///
/// # Errors
/// [`Error::Definition`] for the first that does not parse, or that needs a type of which there is no definition.
pub fn check(workspace: &Workspace, known: &Definitions) -> Result<(), Error> {
    let mut sources = Vec::new();
    for package in &workspace.packages {
        read_package(&workspace.root, package, &mut sources)?;
    }
    if sources.is_empty() {
        return Ok(());
    }
    let registry = Registry::of(RosVersion::Two);
    for (key, text) in known {
        // Of those that are unusable somebody may be told below.
        let _ = registry.insert(key, text);
    }
    for source in &sources {
        if let Err(error) = add(&registry, source)
            && source.is_built
        {
            return Err(wrong(workspace, source, &error));
        }
    }
    for source in sources.iter().filter(|source| source.is_built) {
        resolve(&registry, &source.key).map_err(|error| wrong(workspace, source, &error))?;
    }
    Ok(())
}

fn add(registry: &Registry, source: &Source) -> Result<(), SchemaError> {
    if source.path.extension().is_some_and(|end| end == "idl") {
        let file = InterfaceFile::read_idl(&source.key, &source.text)?;
        let mut definitions = file.definitions.iter();
        return definitions.try_for_each(|(key, text)| registry.insert(key, text));
    }
    registry.insert(&source.key, &source.text)
}

fn resolve(registry: &Registry, key: &str) -> Result<(), SchemaError> {
    match key.split('/').nth(1) {
        Some("srv") => registry.service(key).map(|_| ()),
        Some("action") => registry.action(key).map(|_| ()),
        _ => registry.message(key).map(|_| ()),
    }
}

fn wrong(workspace: &Workspace, source: &Source, error: &SchemaError) -> Error {
    let missing = |name: &str, needed_by: &str| {
        let package = name.split('/').next().unwrap_or(name);
        format!(
            "{needed_by} needs {name}, of which there is no definition; name the package {package} as a <depend> in \
             package.xml, or push it along"
        )
    };
    let problem = match error {
        SchemaError::Missing { name, needed_by } => missing(name, needed_by),
        SchemaError::Unknown(name) => missing(name, &source.key),
        SchemaError::Syntax { name, line, reason } if *name == source.key => {
            format!("line {line}: {reason}")
        }
        other => other.to_string(),
    };
    Error::Definition {
        path: workspace.root.join(&source.path),
        problem,
    }
}

/// Reads a package's interfaces, if its build makes code of any.
fn read_package(root: &Path, package: &Package, sources: &mut Vec<Source>) -> Result<(), Error> {
    let directory = root.join(&package.path);
    let build_file = directory.join("CMakeLists.txt");
    if !build_file.is_file() {
        return Ok(());
    }
    let build = read::text_inside(root, &build_file, MAX_BUILD_FILE)?;
    if !build.contains(GENERATE) {
        return Ok(());
    }
    let (top, tree) = (Tree::open(root)?, Tree::open(&directory)?);
    let first = sources.len();
    for (kind, extension) in KINDS {
        let Found::Directory(files) = tree.directory(kind)? else {
            continue;
        };
        let mut names = files.names()?;
        if names.len() > MAX_FILES {
            return Err(Error::TooMany {
                path: files.path().to_owned(),
                what: "files",
                limit: MAX_FILES,
            });
        }
        names.sort();
        for name in names {
            let Some(name) = name.to_str() else {
                continue;
            };
            let Some((of_type, end)) = name.rsplit_once('.') else {
                continue;
            };
            if !names::is_type(of_type) || (end != extension && end != "idl") {
                continue;
            }
            let path = package.path.join(kind).join(name);
            // A link to another directory of what was pushed is as good as a file.
            let Some(file) = top.file_following(&path, MAX_BYTES)? else {
                continue;
            };
            sources.push(Source {
                key: format!("{}/{kind}/{of_type}", package.manifest.name),
                path,
                text: String::from_utf8_lossy(&file.bytes).into_owned(),
                is_built: mentions(&build, name),
            });
        }
    }
    // A build file that names none of them looks for them itself.
    let own = &mut sources[first..];
    if own.iter().all(|source| !source.is_built) {
        own.iter_mut().for_each(|source| source.is_built = true);
    }
    Ok(())
}

/// Whether a text has a file's name as a word of its own.
fn mentions(text: &str, name: &str) -> bool {
    text.match_indices(name).any(|(at, _)| {
        let before = text[..at].chars().next_back();
        before.is_none_or(|c| !c.is_alphanumeric() && c != '_')
    })
}

#[cfg(test)]
mod tests;
