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
use std::path::{Path, PathBuf};

use package::workspace::Workspace;

use crate::build::{Build, Parts};
use crate::builder::kept;
use crate::cache::Entry;
use crate::compile::{self, Unit};
use crate::error::Error;
use crate::install::Made;
use crate::key::{self, Key};
use crate::keys::{self, Resolved};
use crate::{advice, elf, packaged, pushed};

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
    let units: Vec<Unit> = workspace
        .packages
        .iter()
        .map(|package| Unit {
            name: package.manifest.name.clone(),
            path: package.path.clone(),
            build_type: package.manifest.build_type.clone(),
        })
        .collect();
    let package = compiled(build, &workspace.root, &units, &resolved).await?;
    let needed = needed_by(build, package.layer.as_ref()).await?;
    let dependencies = dependencies(
        build,
        &resolved,
        &needed,
        pushed::has_python(&workspace.root),
    )
    .await?;
    Ok(Parts {
        packages: pushed::by_importance(&workspace.packages),
        version: pushed::version(&workspace.packages),
        dependencies,
        package: Some(package),
        prefix: Some(build.base.build.prefix.clone()),
    })
}

/// The package layer: from the cache when the same sources were compiled with the same packages before.
async fn compiled(
    build: &Build<'_>,
    root: &Path,
    units: &[Unit],
    resolved: &Resolved,
) -> Result<Made, Error> {
    let on_base = build.on_base();
    let toolchain = build.base.build.packages.iter().cloned().collect();
    let toolchain = build
        .add("toolchain", &on_base, &toolchain, Vec::new())
        .await?;
    let below: Vec<_> = on_base.into_iter().chain(toolchain.layer).collect();
    let keep: Vec<_> = below.iter().map(|layer| layer.diff_id).collect();
    build
        .shop
        .layers
        .keep_note(&kept(&build.base.name), &keep)?;
    // What the deployer adds may be what package.xml forgot, for compiling as well as for running.
    let (ros, mut wanted) = build.extra_packages()?;
    wanted.extend(ros.iter().flat_map(|name| build.archive.to_build(name)));
    wanted.extend(resolved.build.iter().cloned());
    let more = build
        .add("build-dependencies", &below, &wanted, Vec::new())
        .await?;
    let below: Vec<_> = below.into_iter().chain(more.layer).collect();
    let hashed = root.to_owned();
    let sources = crate::blocking::spawn(move || key::sources(&hashed)).await??;
    let key = Key::new("compiled")
        .with("build", build.base.build_key())
        .with("sources", sources)
        .with_all("below", below.iter().map(|layer| layer.diff_id.to_string()))
        .with_all(
            "unit",
            units
                .iter()
                .map(|unit| format!("{} {} {}", unit.name, unit.path.display(), unit.build_type)),
        )
        .finish();
    let shop = &build.shop;
    let _turn = shop.turns.take(&key).await;
    if let Some(entry) = shop.cached(&key).await? {
        return Ok(Made {
            layer: entry.layer,
            cached: true,
        });
    }
    let tree = compile::compile(
        shop,
        &build.base,
        &below,
        root,
        units,
        &build.log,
        build.progress,
    )
    .await
    .map_err(|error| advice::on(error, &build.archive.contents))?;
    build.progress.step("packing the package").await;
    let layer = compile::pack(shop, &build.base, &tree).await?;
    let made_from = units.iter().map(|unit| unit.name.clone()).collect();
    shop.keep(
        &key,
        Entry {
            layer: Some(layer),
            made_from,
        },
    )
    .await?;
    Ok(Made {
        layer: Some(layer),
        cached: false,
    })
}

/// Libraries that a package layer needs from elsewhere.
pub(crate) async fn needed_by(
    build: &Build<'_>,
    layer: Option<&image::LayerInfo>,
) -> Result<BTreeSet<String>, Error> {
    let trees = build
        .shop
        .extracted(layer.map_or(&[], std::slice::from_ref))
        .await?;
    crate::blocking::spawn(move || {
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
