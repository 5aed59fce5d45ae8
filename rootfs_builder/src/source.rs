//! A source package or workspace: compiled in a sandbox, run on what its result needs.
//!
//! ```text
//!   compiled in:  base / toolchain / build dependencies / ▒ sources ▒ → install space
//!   runs in:      base / dependencies / package  ◀──────────────────────┘
//! ```
//!
//! The toolchain and the development packages are in no image. What the result needs at run time is asked of
//! package.xml (exec dependencies) and of the result itself (the libraries its ELF files need).

use std::collections::BTreeSet;
use std::path::PathBuf;

use image::Digest;
use package::workspace::Workspace;
use ros::flavour::Version;

use crate::build::{Build, Parts};
use crate::builder::kept;
use crate::error::Error;
use crate::indexed::Indexed;
use crate::install::Made;
use crate::keys::{self, Resolved};
use crate::{advice, elf, indexed, packaged, pushed, units, wheels};

/// Compiles and packs.
pub(crate) async fn build(build: &Build<'_>, workspace: Workspace) -> Result<Parts, Error> {
    let (own, asked) = (
        pushed::names(&workspace.packages),
        pushed::asked(&workspace.packages),
    );
    let (packages, versions, python) = (
        pushed::by_importance(&workspace.packages),
        pushed::versions(&workspace.packages),
        pushed::has_python(&workspace.root),
    );
    let tools = toolchain(build).await?;
    let there = Indexed {
        build: build.indexed(&tools).await?,
        run: build.indexed(&build.on_base()).await?,
    };
    let resolved = keys::resolve(
        &build.archive,
        &build.base,
        &build.request.map,
        &own,
        &asked,
        &there,
    )?;
    for warning in &resolved.warnings {
        build.progress.warn(warning.as_str()).await;
    }
    let below = build_dependencies(build, tools, &resolved).await?;
    let workspace = check_interfaces(build, workspace, &below).await?;
    let package = units::compiled(build, workspace, below)
        .await
        .map_err(|error| advice::on(error, advice::Known::of(&build.archive, &build.base)))?;
    let needed = needed_by(build, &package).await?;
    let dependencies = dependencies(build, &resolved, &needed, python).await?;
    Ok(Parts {
        packages,
        versions,
        dependencies,
        package,
        prefix: Some(build.base.build.prefix.clone()),
    })
}

/// Base and toolchain.
async fn toolchain(build: &Build<'_>) -> Result<Vec<Digest>, Error> {
    let mut below = build.on_base();
    let toolchain = build.base.build.packages.iter().cloned().collect();
    let toolchain = build
        .add("toolchain", &below, &toolchain, Vec::new())
        .await?;
    below.extend(toolchain.diff_ids());
    let tools = wheels::to_compile(&build.shop, &build.base, &below, build.progress).await?;
    below.extend(tools.diff_ids());
    build
        .shop
        .layers
        .keep_note(&kept(&build.base.name), &below)?;
    Ok(below)
}

/// What a package is compiled in: base, toolchain, build dependencies.
async fn build_dependencies(
    build: &Build<'_>,
    mut below: Vec<Digest>,
    resolved: &Resolved,
) -> Result<Vec<Digest>, Error> {
    // What the deployer adds may be what package.xml forgot, for compiling as well as for running.
    let (ros, mut wanted) = build.extra_packages().await?;
    wanted.extend(ros.iter().flat_map(|name| build.archive.to_build(name)));
    wanted.extend(resolved.build.iter().cloned());
    let more = build
        .add("build-dependencies", &below, &wanted, Vec::new())
        .await?;
    below.extend(more.diff_ids());
    Ok(below)
}

/// Says what is wrong with interfaces of ROS 2 before anything is compiled.
async fn check_interfaces(
    build: &Build<'_>,
    workspace: Workspace,
    below: &[Digest],
) -> Result<Workspace, Error> {
    if build.base.ros == Version::Ros1 {
        return Ok(workspace);
    }
    let trees = build.shop.extracted(below).await?;
    let shares: Vec<String> = indexed::prefixes(&build.base)
        .iter()
        .map(|prefix| format!("{prefix}/share"))
        .collect();
    crate::blocking::reading(move || {
        let known = package::definitions::read(&trees, &shares)?;
        package::interfaces::check(&workspace, &known)?;
        Ok(workspace)
    })
    .await?
}

/// Libraries that a package layer needs from elsewhere.
pub(crate) async fn needed_by(
    build: &Build<'_>,
    package: &Made,
) -> Result<BTreeSet<String>, Error> {
    let layers: Vec<Digest> = package.diff_ids().collect();
    let trees = build.shop.extracted(&layers).await?;
    crate::blocking::reading(move || {
        let mut needed = BTreeSet::new();
        for tree in &trees {
            needed.extend(elf::needed_below(tree)?);
        }
        Ok(needed)
    })
    .await?
}

/// The layer of everything needed at run time.
pub(crate) async fn dependencies(
    build: &Build<'_>,
    resolved: &Resolved,
    libraries: &BTreeSet<String>,
    python: bool,
) -> Result<Made, Error> {
    let below = build.on_base();
    let (mut roots, mut debs) = build.extra_packages().await?;
    // Those are for compiling; the libraries that they bring are found by what the result needs.
    debs.retain(|deb| !deb.ends_with("-dev"));
    roots.extend(resolved.run_ros.iter().cloned());
    let wanted = packaged::wanted(build, &roots, python).await?;
    debs.extend(wanted.install);
    debs.extend(resolved.run.iter().cloned());
    let trees = build.shop.extracted(&below).await?;
    let mut libraries = libraries.clone();
    let own = indexed::libraries(&build.base);
    libraries.retain(|name| !library_in(&trees, &own, name));
    let (found, missing) = build.archive.libraries(&libraries);
    debs.extend(found.into_values());
    let made = build
        .add("dependencies", &below, &debs, wanted.extras)
        .await?;
    let all: Vec<Digest> = below.into_iter().chain(made.diff_ids()).collect();
    let trees = build.shop.extracted(&all).await?;
    for name in missing {
        // Not in the index, perhaps in an image all the same: a link that a package's script made.
        if !library_in(&trees, &places(), &name) && !library_in(&trees, &own, &name) {
            let text = format!(
                "no package holds the library {name}, which the package needs; a node may fail to start"
            );
            build.progress.warn(text).await;
        }
    }
    Ok(made)
}

/// Where a distribution has its libraries.
fn places() -> [String; 5] {
    let triplet = crate::contents::triplet();
    [
        format!("usr/lib/{triplet}"),
        "usr/lib".into(),
        format!("lib/{triplet}"),
        "lib64".into(),
        "lib".into(),
    ]
}

fn library_in(trees: &[PathBuf], places: &[String], name: &str) -> bool {
    trees.iter().any(|tree| {
        places
            .iter()
            .any(|place| tree.join(place).join(name).symlink_metadata().is_ok())
    })
}
