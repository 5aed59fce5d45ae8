//! Selection of the packages of a workspace that are built.
//!
//! A push may name them (`--packages-up-to`, `--packages-skip`). Otherwise they follow from what it runs: the packages
//! of the chosen nodes or launch file, and every package that these declare as a dependency or mention anywhere in
//! their files. A mention need not be a use, so too much may be built, but nothing that is found by name is missing.

mod mentions;

use std::collections::{BTreeMap, BTreeSet};

use foreign::Visit;
use ros::bus::RosVersion;
use rustix::fs::FileType;

use crate::Error;
use crate::foreseen;
use crate::manifest::Kind;
use crate::provided::Providers;
use crate::workspace::{Package, Workspace};

/// Kinds of dependencies that a package needs to be built or run.
const NEEDS: [Kind; 5] = [Kind::Buildtool, Kind::BuildtoolExport, Kind::Build, Kind::BuildExport, Kind::Exec];

/// Options of a push that determine the packages to build.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PackageQuery<'a> {
    /// Packages to build with those that they need; empty if they follow from what is run.
    pub up_to: &'a [String],
    /// Packages that are not built.
    pub skip: &'a [String],
    /// Launch file to run.
    pub launch: Option<&'a str>,
    /// Executables to run (`EXE` or `PACKAGE/EXE`) with their arguments.
    pub nodes: &'a [String],
    /// Other texts that may name packages: values of parameters, launch arguments and mappings of dependencies.
    pub texts: Vec<String>,
}

/// Reduces a workspace to the selected packages; returns the names of the others, sorted. Blocking.
///
/// # Errors
/// An option names a package that is not in the workspace, or no package is left.
pub fn select_packages(
    workspace: &mut Workspace,
    query: &PackageQuery<'_>,
    version: RosVersion,
) -> Result<Vec<String>, Error> {
    for (option, names) in [("--packages-up-to", query.up_to), ("--packages-skip", query.skip)] {
        let is_known = |name: &String| workspace.packages.iter().any(|package| package.manifest.name == *name);
        if let Some(unknown) = names.iter().find(|name| !is_known(name)) {
            return Err(Error::UnknownPackage {
                option,
                name: unknown.clone(),
                known: list_names(&workspace.packages),
            });
        }
    }
    let packages = &workspace.packages;
    let skipped: BTreeSet<usize> = indexes_of(packages, query.skip).collect();
    let needs = resolve_needs(packages);
    let selected = if query.up_to.is_empty() {
        select_by_what_runs(workspace, query, version, (&needs[..], &skipped))
    } else {
        Some(close(indexes_of(packages, query.up_to), &needs, &skipped))
    };
    let selected = selected.unwrap_or_else(|| (0..packages.len()).filter(|index| !skipped.contains(index)).collect());
    if selected.is_empty() {
        return Err(Error::NothingSelected { skipped: query.skip.join(", ") });
    }
    let mut left_out = Vec::new();
    let all = std::mem::take(&mut workspace.packages);
    for (index, package) in all.into_iter().enumerate() {
        if selected.contains(&index) {
            workspace.packages.push(package);
        } else {
            workspace.left_out.push(package.path);
            left_out.push(package.manifest.name);
        }
    }
    left_out.sort();
    Ok(left_out)
}

fn list_names(packages: &[Package]) -> String {
    let mut names: Vec<&str> = packages.iter().map(|package| package.manifest.name.as_str()).collect();
    names.sort_unstable();
    names.join(", ")
}

fn indexes_of<'a>(packages: &'a [Package], names: &'a [String]) -> impl Iterator<Item = usize> + 'a {
    let all = packages.iter().enumerate();
    all.filter(move |(_, package)| names.contains(&package.manifest.name)).map(|(index, _)| index)
}

/// Returns, for each package, the others that it declares as dependencies, or that provide these.
fn resolve_needs(packages: &[Package]) -> Vec<BTreeSet<usize>> {
    let providers = Providers::new(packages);
    let needs_of = |package: &Package| {
        let named = package.manifest.needs(&NEEDS);
        let others = packages.iter().enumerate();
        let needed = others.filter(|(_, other)| {
            named.contains(other.manifest.name.as_str()) || package.manifest.needs_group_of(&other.manifest)
        });
        let mut needed: BTreeSet<usize> = needed.map(|(index, _)| index).collect();
        needed.extend(providers.find_all(&package.manifest));
        needed
    };
    packages.iter().map(needs_of).collect()
}

/// Adds all direct and indirect dependencies.
fn close(
    roots: impl IntoIterator<Item = usize>,
    needs: &[BTreeSet<usize>],
    skipped: &BTreeSet<usize>,
) -> BTreeSet<usize> {
    let mut selected = BTreeSet::new();
    let mut waiting: Vec<usize> = roots.into_iter().collect();
    while let Some(index) = waiting.pop() {
        if !skipped.contains(&index) && selected.insert(index) {
            waiting.extend(&needs[index]);
        }
    }
    selected
}

/// Returns the packages that follow from what is run; `None` if that is not known for certain.
fn select_by_what_runs(
    workspace: &Workspace,
    query: &PackageQuery<'_>,
    version: RosVersion,
    (needs, skipped): (&[BTreeSet<usize>], &BTreeSet<usize>),
) -> Option<BTreeSet<usize>> {
    let packages = &workspace.packages;
    if packages.len() < 2 {
        return None;
    }
    let mut roots = packages_of_nodes(workspace, query.nodes, version)?;
    if let Some(launch) = query.launch {
        roots.extend(packages_of_launch_file(workspace, launch)?);
    }
    if roots.is_empty() {
        return None;
    }
    let mut reader = mentions::MentionReader::new(packages);
    for text in query.texts.iter().chain(query.nodes) {
        roots.extend(reader.find_mentions(text.as_bytes()));
    }
    // Closed over dependencies and over mentions, until nothing new is found.
    let mut read = BTreeSet::new();
    loop {
        let selected = close(roots.iter().copied(), needs, skipped);
        let Some(next) = selected.iter().copied().find(|index| !read.contains(index)) else {
            return Some(selected);
        };
        read.insert(next);
        roots.extend(reader.read_package(&workspace.root, &packages[next])?);
    }
}

/// Returns the packages that may be meant by nodes: none for a package outside of the workspace, `None` if one is
/// unknown. Each package is read once, however many nodes there are.
fn packages_of_nodes(workspace: &Workspace, nodes: &[String], version: RosVersion) -> Option<BTreeSet<usize>> {
    let packages = &workspace.packages;
    let mut found = BTreeSet::new();
    // Programs without a package, and whether one has them.
    let mut programs: BTreeMap<&str, bool> = BTreeMap::new();
    for node in nodes {
        let program = node.split_whitespace().next()?;
        match program.split_once('/') {
            Some((package, _)) => found.extend(packages.iter().position(|other| other.manifest.name == package)),
            None => {
                programs.insert(program, false);
            }
        }
    }
    if programs.is_empty() {
        return Some(found);
    }
    for (index, package) in packages.iter().enumerate() {
        let mut names = foreseen::programs_of(workspace, package, version);
        names.extend(file_names(workspace, package, |name| programs.contains_key(name)));
        for name in &names {
            if let Some(is_there) = programs.get_mut(name.as_str()) {
                *is_there = true;
                found.insert(index);
            }
        }
    }
    programs.values().all(|is_there| *is_there).then_some(found)
}

/// Returns the wanted ones of the names of a package's files; none if they cannot all be read.
fn file_names(workspace: &Workspace, package: &Package, is_wanted: impl Fn(&str) -> bool) -> BTreeSet<String> {
    let Ok(directory) = workspace.root.join(&package.path).canonicalize() else {
        return BTreeSet::new();
    };
    let mut names = BTreeSet::new();
    let walked = foreign::walk(&directory, |entry| {
        let is_entry = entry.kind() != FileType::Directory && !entry.path.as_os_str().is_empty();
        names.extend(entry.name().to_str().filter(|name| is_entry && is_wanted(name)).map(str::to_owned));
        Ok::<_, foreign::Error>(Visit::Into)
    });
    if walked.is_ok() { names } else { BTreeSet::new() }
}

/// Returns the packages with a launch file of this name; `None` if there are none.
fn packages_of_launch_file(workspace: &Workspace, launch: &str) -> Option<Vec<usize>> {
    let mut found = Vec::new();
    for (index, package) in workspace.packages.iter().enumerate() {
        let within = launch.strip_prefix(&*package.manifest.name).and_then(|rest| rest.strip_prefix('/'));
        let asked = within.unwrap_or(launch);
        if has_file(workspace, package, |path, is_file| is_file && path.ends_with(asked)) {
            found.push(index);
        }
    }
    (!found.is_empty()).then_some(found)
}

/// Returns whether a package has a file; `is_it` gets paths relative to the package, and whether they are files.
fn has_file(workspace: &Workspace, package: &Package, is_it: impl Fn(&std::path::Path, bool) -> bool) -> bool {
    let Ok(directory) = workspace.root.join(&package.path).canonicalize() else {
        return false;
    };
    let mut found = false;
    let walked = foreign::walk(&directory, |entry| {
        let kind = entry.kind();
        let is_entry = kind != FileType::Directory && !entry.path.as_os_str().is_empty();
        found |= is_entry && is_it(entry.path, kind == FileType::RegularFile);
        Ok::<_, foreign::Error>(if found { Visit::Skip } else { Visit::Into })
    });
    found && walked.is_ok()
}

#[cfg(test)]
mod tests;
