//! An install space that was compiled elsewhere: placed where it was compiled for.

use std::collections::BTreeSet;
use std::fs;

use crate::builder::{Build, Parts};
use crate::cache::Entry;
use crate::compile;
use crate::error::{Error, IoAt};
use crate::install::{Made, set_mode};
use crate::key::{self, Key};
use crate::keys::{self, Asked};
use crate::pushed::InstallSpace;
use crate::source;

/// Packs it and finds what it needs.
pub(crate) async fn build(build: &Build<'_>, space: InstallSpace) -> Result<Parts, Error> {
    let own: BTreeSet<String> = space.packages.iter().map(|package| package.unit.name.clone()).collect();
    let mut asked = Asked::default();
    for package in &space.packages {
        for key in &package.run {
            asked.run.entry(key.clone()).or_default().insert(package.unit.name.clone());
        }
    }
    let resolved = keys::resolve(&build.archive, &build.base, &build.request.map, &own, &asked)?;
    let package = packed(build, &space).await?;
    let mut needed = BTreeSet::new();
    if let Some(layer) = package.layer {
        needed = source::needed_by(build, &layer).await?;
    }
    let dependencies = source::dependencies(build, &resolved, &needed, &build.on_base()).await?;
    let version = space.packages.first().map_or_else(String::new, |package| package.version.clone());
    let packages = space.packages.into_iter().map(|package| package.unit.name).collect();
    Ok(Parts { packages, version, dependencies, package: Some(package), prefix: Some(space.prefix) })
}

async fn packed(build: &Build<'_>, space: &InstallSpace) -> Result<Made, Error> {
    let (root, prefix) = (space.root.clone(), space.prefix.clone());
    let hashed = root.clone();
    let content = tokio::task::spawn_blocking(move || key::tree(&hashed)).await??;
    let key = Key::new("prebuilt")
        .with("content", content)
        .with("prefix", prefix.as_os_str().as_encoded_bytes())
        .finish();
    let shop = &build.shop;
    let _turn = shop.turns.take(&key).await;
    if let Some(entry) = shop.cached(&key).await? {
        return Ok(Made { layer: entry.layer, cached: true });
    }
    build.progress.step("packing the install space").await;
    let tree = shop.site.fresh("prebuilt")?;
    let target = tree.join(prefix.strip_prefix("/").unwrap_or(&prefix));
    let parent = target.parent().unwrap_or(&tree).to_owned();
    fs::create_dir_all(&parent).at("making", &parent)?;
    for directory in parent.ancestors().take_while(|directory| directory.starts_with(&tree)) {
        set_mode(directory, 0o755)?;
    }
    // The pushed tree is this build's own: moving it costs nothing.
    fs::rename(&root, &target).at("moving", &root)?;
    let opened = target.clone();
    tokio::task::spawn_blocking(move || compile::open_up(&opened)).await??;
    let layer = compile::pack(shop, &build.base, &tree).await?;
    let made_from = space.packages.iter().map(|package| package.unit.name.clone()).collect();
    shop.keep(&key, Entry { layer: Some(layer), made_from }).await?;
    Ok(Made { layer: Some(layer), cached: false })
}
