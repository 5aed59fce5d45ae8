//! Validation of the interface files of ROS 2 packages (`msg`, `srv` and `action`) before anything is compiled: an
//! error, or a type without definition, is reported at once with its file and line, and not by a code generator later.

use std::path::{Path, PathBuf};

use foreign::{DirectoryLookup, Tree};
use ros::bus::RosVersion;
use ros::schema::{InterfaceFile, Registry, SchemaError};

use crate::definitions::Definitions;
use crate::workspace::{Package, Workspace};
use crate::{Error, names, read};

/// Maximum size of an interface file in bytes.
const MAX_BYTES: u64 = 256 << 10;
/// Maximum size of a `CMakeLists.txt` in bytes.
const MAX_BUILD_FILE: u64 = 1 << 20;
/// Maximum number of files in a directory.
const MAX_FILES: usize = 20_000;
/// CMake function that generates code for interfaces.
const GENERATE: &str = "rosidl_generate_interfaces";

/// Directories of a package, and the extension of the files in them.
const KINDS: [(&str, &str); 3] = [("msg", "msg"), ("srv", "srv"), ("action", "action")];

/// An interface file of a package.
struct InterfaceSource {
    /// Type name: `package/msg/Type`.
    key: String,
    /// Path, below what was pushed.
    path: PathBuf,
    text: String,
    /// True if the build generates code for it.
    is_built: bool,
}

/// Validates the interface files of a workspace. `known` are the definitions that its packages are built with.
/// Blocking.
///
/// # Errors
/// [`Error::Definition`] for the first file that cannot be parsed, or that refers to a type without definition.
pub fn check(workspace: &Workspace, known: &Definitions) -> Result<(), Error> {
    let mut sources = Vec::new();
    for package in &workspace.packages {
        read_package(&workspace.root, package, &mut sources)?;
    }
    if sources.is_empty() {
        return Ok(());
    }
    let registry = Registry::for_version(RosVersion::Two);
    for (key, text) in known {
        // Unusable definitions are reported below if they are needed.
        let _ = registry.insert(key, text);
    }
    for source in &sources {
        if let Err(error) = register(&registry, source)
            && source.is_built
        {
            return Err(definition_error(workspace, source, &error));
        }
    }
    for source in sources.iter().filter(|source| source.is_built) {
        resolve(&registry, &source.key).map_err(|error| definition_error(workspace, source, &error))?;
    }
    Ok(())
}

fn register(registry: &Registry, source: &InterfaceSource) -> Result<(), SchemaError> {
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

fn definition_error(workspace: &Workspace, source: &InterfaceSource, error: &SchemaError) -> Error {
    let missing = |name: &str, needed_by: &str| {
        let package = name.split('/').next().unwrap_or(name);
        format!(
            "{needed_by} needs {name}, which has no definition; name the package {package} as a <depend> in \
                package.xml, or push it, too"
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
    Error::Definition { path: workspace.root.join(&source.path), problem }
}

/// Reads the interface files of a package, if its build generates code for any.
fn read_package(root: &Path, package: &Package, sources: &mut Vec<InterfaceSource>) -> Result<(), Error> {
    let directory = root.join(&package.path);
    let build_file = directory.join("CMakeLists.txt");
    if !build_file.is_file() {
        return Ok(());
    }
    let build = read::read_text(root, &build_file, MAX_BUILD_FILE)?;
    if !build.contains(GENERATE) {
        return Ok(());
    }
    let (top, tree) = (Tree::open(root)?, Tree::open(&directory)?);
    let first = sources.len();
    for (kind, extension) in KINDS {
        let DirectoryLookup::Directory(files) = tree.open_directory(kind)? else {
            continue;
        };
        let mut names = files.names()?;
        if names.len() > MAX_FILES {
            return Err(Error::TooMany { path: files.path().to_owned(), what: "files", limit: MAX_FILES });
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
            // A link to another directory of what was pushed is accepted as a file.
            let Some(file) = top.read_file_following(&path, MAX_BYTES)? else {
                continue;
            };
            sources.push(InterfaceSource {
                key: format!("{}/{kind}/{of_type}", package.manifest.name),
                path,
                text: String::from_utf8_lossy(&file.bytes).into_owned(),
                is_built: mentions(&build, name),
            });
        }
    }
    // A build file that names none of them finds them by a pattern.
    let own = &mut sources[first..];
    if own.iter().all(|source| !source.is_built) {
        own.iter_mut().for_each(|source| source.is_built = true);
    }
    Ok(())
}

/// Returns whether a text contains a file name as a separate word.
fn mentions(text: &str, name: &str) -> bool {
    text.match_indices(name).any(|(at, _)| {
        let before = text[..at].chars().next_back();
        before.is_none_or(|c| !c.is_alphanumeric() && c != '_')
    })
}

#[cfg(test)]
mod tests;
