//! Build order of packages.

use std::collections::{BTreeMap, BTreeSet};

use crate::Error;
use crate::manifest::Kind;
use crate::workspace::Package;

/// Dependencies that must be built before a package.
const BUILD_DEPENDENCIES: [Kind; 4] = [Kind::Buildtool, Kind::BuildtoolExport, Kind::Build, Kind::BuildExport];

/// Sorts packages after their build dependencies, otherwise by name.
pub(crate) fn build_order(packages: Vec<Package>) -> Result<Vec<Package>, Error> {
    let mut replaced: BTreeMap<String, String> = packages.iter().flat_map(replaced_names).collect();
    for package in &packages {
        replaced.remove(&package.manifest.name);
    }
    let mut waiting: BTreeMap<String, Package> =
        packages.into_iter().map(|package| (package.manifest.name.clone(), package)).collect();
    let mut ordered = Vec::with_capacity(waiting.len());
    while !waiting.is_empty() {
        let ready = waiting.values().find(|package| build_prerequisites(package, &waiting, &replaced).is_empty());
        match ready.map(|package| package.manifest.name.clone()) {
            Some(name) => ordered.extend(waiting.remove(&name)),
            None => {
                return Err(Error::Circle { circle: find_cycle(&waiting, &replaced) });
            }
        }
    }
    Ok(ordered)
}

/// Returns the names that a package replaces, each with its own.
fn replaced_names(package: &Package) -> impl Iterator<Item = (String, String)> {
    package.manifest.replaces.iter().map(|name| (name.clone(), package.manifest.name.clone()))
}

/// Returns the names of remaining packages that must be built before this one; `replaced` has the names that packages
/// replace, each with the name of one that does.
fn build_prerequisites<'a>(
    package: &'a Package,
    waiting: &'a BTreeMap<String, Package>,
    replaced: &'a BTreeMap<String, String>,
) -> BTreeSet<&'a str> {
    let own = &package.manifest;
    let mut names = own.needs(&BUILD_DEPENDENCIES);
    let others: Vec<&str> = names.iter().filter_map(|name| replaced.get(*name)).map(String::as_str).collect();
    names.extend(others);
    names.retain(|name| waiting.contains_key(*name));
    if !own.group_dependencies.is_empty() {
        let others = waiting.values().map(|package| &package.manifest);
        let members = others.filter(|other| own.needs_group_of(other));
        names.extend(members.map(|other| other.name.as_str()));
    }
    names.remove(own.name.as_str());
    names
}

/// Follows dependencies, of which every remaining package has one, until a package repeats.
fn find_cycle(waiting: &BTreeMap<String, Package>, replaced: &BTreeMap<String, String>) -> Vec<String> {
    let mut path: Vec<String> = Vec::new();
    let mut name = waiting.keys().next().cloned().unwrap_or_default();
    loop {
        if let Some(start) = path.iter().position(|seen| *seen == name) {
            let mut circle = path.split_off(start);
            circle.push(name);
            return circle;
        }
        let next = waiting
            .get(&name)
            .and_then(|package| build_prerequisites(package, waiting, replaced).first().map(|next| (*next).to_owned()));
        path.push(name);
        match next {
            Some(next) => name = next,
            None => return path,
        }
    }
}
