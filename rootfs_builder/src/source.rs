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

use crate::build::{Build, Parts};
use crate::builder::kept;
use crate::error::Error;
use crate::install::Made;
use crate::keys::{self, Resolved};
use crate::{advice, elf, packaged, pushed, units};

/// Compiles and packs.
pub(crate) async fn build(build: &Build<'_>, workspace: Workspace) -> Result<Parts, Error> {
    let (own, asked) = (
        pushed::names(&workspace.packages),
        pushed::asked(&workspace.packages),
    );
    let resolved = keys::resolve(
        &build.archive,
        &build.base,
        &build.request.map,
        &own,
        &asked,
    )?;
    let (packages, version, python) = (
        pushed::by_importance(&workspace.packages),
        pushed::version(&workspace.packages),
        pushed::has_python(&workspace.root),
    );
    let below = toolchain(build, &resolved).await?;
    let package = units::compiled(build, workspace, below)
        .await
        .map_err(|error| advice::on(error, &build.archive.contents))?;
    let needed = needed_by(build, &package).await?;
    let dependencies = dependencies(build, &resolved, &needed, python).await?;
    Ok(Parts {
        packages,
        version,
        dependencies,
        package,
        prefix: Some(build.base.build.prefix.clone()),
    })
}

/// What a package is compiled in: base, toolchain, build dependencies.
async fn toolchain(build: &Build<'_>, resolved: &Resolved) -> Result<Vec<Digest>, Error> {
    let mut below = build.on_base();
    let toolchain = build.base.build.packages.iter().cloned().collect();
    let toolchain = build
        .add("toolchain", &below, &toolchain, Vec::new())
        .await?;
    below.extend(toolchain.diff_ids());
    build
        .shop
        .layers
        .keep_note(&kept(&build.base.name), &below)?;
    // What the deployer adds may be what package.xml forgot, for compiling as well as for running.
    let (ros, mut wanted) = build.extra_packages()?;
    wanted.extend(ros.iter().flat_map(|name| build.archive.to_build(name)));
    wanted.extend(resolved.build.iter().cloned());
    let more = build
        .add("build-dependencies", &below, &wanted, Vec::new())
        .await?;
    below.extend(more.diff_ids());
    Ok(below)
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
    let (mut roots, mut debs) = build.extra_packages()?;
    // Those are for compiling; the libraries that they bring are found by what the result needs.
    debs.retain(|deb| !deb.ends_with("-dev"));
    roots.extend(resolved.run_ros.iter().cloned());
    let wanted = packaged::wanted(build, &roots, python).await?;
    debs.extend(wanted.install);
    debs.extend(resolved.run.iter().cloned());
    let (found, missing) = build.archive.libraries(libraries);
    debs.extend(found.into_values());
    let trees = build.shop.extracted(&below).await?;
    for name in missing {
        // Not in the index, perhaps in an image all the same: a link that a package's script made.
        if !library_in(&trees, &name) {
            let text = format!(
                "no package holds the library {name}, which the package needs; a node may fail to start"
            );
            build.progress.warn(text).await;
        }
    }
    build
        .add("dependencies", &below, &debs, wanted.extras)
        .await
}

fn library_in(trees: &[PathBuf], name: &str) -> bool {
    let triplet = crate::contents::triplet();
    let places = [
        format!("usr/lib/{triplet}"),
        "usr/lib".into(),
        format!("lib/{triplet}"),
        "lib64".into(),
        "lib".into(),
    ];
    trees.iter().any(|tree| {
        places
            .iter()
            .any(|place| tree.join(place).join(name).symlink_metadata().is_ok())
    })
}
