//! Source packages and workspaces: compiled in a sandbox, and run with what the result needs.
//!
//! ```text
//!   compiled in:  base / toolchain / build dependencies / ▒ sources ▒ → install space
//!   runs in:      base / dependencies / package  ◀──────────────────────┘
//! ```
//!
//! The toolchain and the development packages are not part of an image. Run-time dependencies are determined from
//! package.xml (exec dependencies) and from the result itself (libraries needed by its ELF files).

use std::collections::BTreeSet;
use std::path::PathBuf;

use image::Digest;
use package::workspace::Workspace;
use ros::flavour::Version;

use crate::archive::Archive;
use crate::base::{Base, ImportedImage};
use crate::build::{Build, BuildParts};
use crate::cache::keep_note_key;
use crate::error::Error;
use crate::install::LayerSet;
use crate::keys::{self, ResolvedKeys};
use crate::needs::RuntimeNeeds;
use crate::{advice, elf, indexed, packaged, pushed_packages, units, wheels};

/// Compiles and packs the workspace.
pub(crate) async fn build(build: &Build<'_>, workspace: Workspace) -> Result<BuildParts, Error> {
    let (own, asked) =
        (pushed_packages::names(&workspace.packages), pushed_packages::required_keys(&workspace.packages));
    let (packages, versions, python) = (
        pushed_packages::sort_by_importance(&workspace.packages),
        pushed_packages::versions(&workspace.packages),
        pushed_packages::has_python(&workspace.root),
    );
    let tools = toolchain(build, &workspace).await?;
    let mut there = build.find_known_packages(&tools).await?;
    build.foundation.add_to(&mut there);
    let resolved = keys::resolve_keys(&build.archive, &build.base, &build.request.map, &own, &asked, &there)?;
    for warning in &resolved.warnings {
        build.progress.warn(warning.as_str()).await;
    }
    let wanted = build_packages(build, &resolved).await?;
    let below = build_dependencies(build, tools, &wanted).await?;
    let workspace = check_interfaces(build, workspace, &below).await?;
    let of_underlay = build.request.as_underlay.then(|| workspace.packages.clone());
    let compiled = units::compile_workspace(build, workspace, below)
        .await
        .map_err(|error| advice::add_advice(error, advice::AdviceIndex::for_base(&build.archive, &build.base)))?;
    let libraries = needed_libraries(build, &compiled.package).await?;
    let needs = runtime_needs(build, &resolved, (libraries, python)).await?;
    let dependencies = dependencies(build, &needs).await?;
    let contents = match (of_underlay, compiled.underlay) {
        (Some(packages), Some(layer)) => Some(build.foundation.extend(&build.base, &packages, layer, (wanted, needs))),
        _ => None,
    };
    let prefix = Some(build.base.build.prefix.clone());
    Ok(BuildParts { packages, versions, dependencies, package: compiled.package, prefix, contents })
}

/// Returns whether the packages are installed as they are, with what the image of the base has.
fn is_installed_without_tools(base: &Base, workspace: &Workspace) -> bool {
    let is_python = workspace.packages.iter().all(|package| package.manifest.build_type == "ament_python");
    is_python && base.image.as_ref().is_some_and(|image| image.installs_python)
}

fn no_tools(base: &Base, image: &ImportedImage, words: String) -> Error {
    Error::NoTools { base: base.name.clone(), missing: image.missing_tools.join(", "), words }
}

/// Fails if the packages are to be compiled on a base from an image that lacks tools, and the archive has them not
/// either: without it, what the packages depend on is not known.
pub(crate) fn check_tools(base: &Base, archive: &Archive, workspace: &Workspace) -> Result<(), Error> {
    let Some(image) = base.image.as_ref().filter(|_| !is_installed_without_tools(base, workspace)) else {
        return Ok(());
    };
    let tools = &base.build.packages;
    if tools.is_empty() {
        return Err(no_tools(base, image, "it has no dpkg".to_owned()));
    }
    match tools.iter().find(|tool| !archive.candidates.contains(tool)) {
        Some(tool) => Err(no_tools(base, image, format!("the archive has no {tool}"))),
        None => Ok(()),
    }
}

/// Returns the layers of base and toolchain.
async fn toolchain(build: &Build<'_>, workspace: &Workspace) -> Result<Vec<Digest>, Error> {
    if let Some(tools) = &build.tools {
        return Ok(tools.clone());
    }
    let mut below = build.base_diff_ids();
    let image = build.base.image.as_ref();
    if is_installed_without_tools(&build.base, workspace) {
        return Ok(below);
    }
    let toolchain = build.base.build.packages.iter().cloned().collect();
    let toolchain = match (build.add_packages("toolchain", &below, &toolchain, Vec::new()).await, image) {
        (Err(error @ (Error::Unsolvable { .. } | Error::Download { .. })), Some(image)) => {
            return Err(no_tools(&build.base, image, error.to_string()));
        }
        (made, _) => made?,
    };
    below.extend(toolchain.diff_ids());
    let tools = wheels::add_build_wheels(&build.shop, &build.base, &below, build.progress).await?;
    below.extend(tools.diff_ids());
    build.shop.layers.write_note(&keep_note_key(&build.base.name), &below)?;
    Ok(below)
}

/// Returns the Debian packages for compiling, those of the underlays included.
async fn build_packages(build: &Build<'_>, resolved: &ResolvedKeys) -> Result<BTreeSet<String>, Error> {
    // Packages added by the deployer may be missing in package.xml for compiling as well as for running.
    let (ros, mut wanted) = build.extra_packages().await?;
    wanted.extend(ros.iter().flat_map(|name| build.archive.build_packages(name)));
    wanted.extend(resolved.build.iter().cloned());
    wanted.extend(build.foundation.build_packages().iter().cloned());
    Ok(wanted)
}

/// Returns the layers in which packages are compiled: base, toolchain, build dependencies, underlays.
async fn build_dependencies(
    build: &Build<'_>,
    mut below: Vec<Digest>,
    wanted: &BTreeSet<String>,
) -> Result<Vec<Digest>, Error> {
    let more = build.add_packages("build-dependencies", &below, wanted, Vec::new()).await?;
    below.extend(more.diff_ids());
    below.extend(build.foundation.compile_layers());
    Ok(below)
}

/// Validates the interface files of ROS 2 packages before anything is compiled.
async fn check_interfaces(build: &Build<'_>, workspace: Workspace, below: &[Digest]) -> Result<Workspace, Error> {
    if build.base.ros == Version::Ros1 {
        return Ok(workspace);
    }
    let trees = build.shop.extract_layers(below).await?;
    let mut prefixes = build.base.install_prefixes();
    // Where underlays are.
    prefixes.push(build.base.build.prefix.display().to_string());
    let shares: Vec<String> = prefixes.iter().map(|prefix| format!("{prefix}/share")).collect();
    crate::blocking::spawn_reader(move || {
        let known = package::definitions::read(&trees, &shares)?;
        package::interfaces::check(&workspace, &known)?;
        Ok(workspace)
    })
    .await?
}

/// Returns the libraries that a package layer needs from elsewhere.
pub(crate) async fn needed_libraries(build: &Build<'_>, package: &LayerSet) -> Result<BTreeSet<String>, Error> {
    let layers: Vec<Digest> = package.diff_ids().collect();
    let trees = build.shop.extract_layers(&layers).await?;
    crate::blocking::spawn_reader(move || {
        let mut needed = BTreeSet::new();
        for tree in &trees {
            needed.extend(elf::needed_libraries(tree)?);
        }
        Ok(needed)
    })
    .await?
}

/// Returns what the packages of a push need at run time, with what their underlays need.
pub(crate) async fn runtime_needs(
    build: &Build<'_>,
    resolved: &ResolvedKeys,
    (libraries, python): (BTreeSet<String>, bool),
) -> Result<RuntimeNeeds, Error> {
    let (mut ros, mut debs) = build.extra_packages().await?;
    // Those are for compiling; their libraries are found by what the result needs.
    debs.retain(|deb| !deb.ends_with("-dev"));
    ros.extend(resolved.run_ros.iter().cloned());
    debs.extend(resolved.run.iter().cloned());
    let mut needs = RuntimeNeeds { ros, debs, libraries, python };
    needs.extend(build.foundation.runtime_needs());
    Ok(needs)
}

/// Adds the layer of all run-time dependencies.
pub(crate) async fn dependencies(build: &Build<'_>, needs: &RuntimeNeeds) -> Result<LayerSet, Error> {
    let below = build.base_diff_ids();
    let wanted = packaged::gather_wanted(build, &needs.ros, needs.python).await?;
    let mut debs = needs.debs.clone();
    debs.extend(wanted.install);
    let underlays: Vec<Digest> = build.foundation.run_layers().collect();
    let underlays = build.shop.extract_layers(&underlays).await?;
    let mut trees = build.shop.extract_layers(&below).await?;
    trees.extend(underlays.iter().cloned());
    let mut libraries = needs.libraries.clone();
    let mut own = indexed::library_directories(&build.base);
    own.push(format!("{}/lib", build.base.build.prefix.display()).trim_start_matches('/').to_owned());
    libraries.retain(|name| !has_library(&trees, &own, name));
    let (found, missing) = build.archive.libraries(&libraries);
    debs.extend(found.into_values());
    let made = build.add_packages("dependencies", &below, &debs, wanted.extras).await?;
    let all: Vec<Digest> = below.into_iter().chain(made.diff_ids()).collect();
    let mut trees = build.shop.extract_layers(&all).await?;
    trees.extend(underlays);
    for name in missing {
        // Not in the index, but perhaps in an image: a link created by a package's script.
        if !has_library(&trees, &system_library_directories(), &name) && !has_library(&trees, &own, &name) {
            let text =
                format!("no package holds the library {name}, which the package needs; a node may fail to start");
            build.progress.warn(text).await;
        }
    }
    Ok(made)
}

/// Returns the library directories of a distribution.
fn system_library_directories() -> [String; 5] {
    let triplet = crate::contents::triplet();
    [format!("usr/lib/{triplet}"), "usr/lib".into(), format!("lib/{triplet}"), "lib64".into(), "lib".into()]
}

fn has_library(trees: &[PathBuf], places: &[String], name: &str) -> bool {
    trees.iter().any(|tree| places.iter().any(|place| tree.join(place).join(name).symlink_metadata().is_ok()))
}
