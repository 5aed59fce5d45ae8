//! Install spaces compiled elsewhere, which are placed at their original prefix.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use package::system::HIDDEN_DIRECTORIES;
use package::workspace::{InstallSpace, Layout};

use crate::build::{Build, BuildParts};
use crate::compile;
use crate::error::{Error, IoContext};
use crate::indexed::IndexedPackages;
use crate::install::LayerSet;
use crate::key::{self, Key};
use crate::keys::{self, RequiredKeys};
use crate::modes::set_mode;
use crate::workshop::PackJob;
use crate::{pushed_packages, source};

/// Packs the install space and finds its dependencies.
pub(crate) async fn build(build: &Build<'_>, space: InstallSpace) -> Result<BuildParts, Error> {
    let packages = pushed_packages::sort_by_importance(&space.packages);
    let prefix = choose_prefix(&space, &build.base.build.prefix, &packages)?;
    let (own, asked) = (pushed_packages::names(&space.packages), pushed_packages::required_keys(&space.packages));
    // It is compiled already: its build dependencies do not matter.
    let asked = RequiredKeys { build: BTreeMap::new(), ..asked };
    let there = IndexedPackages {
        build: pushed_packages::build_tools(&asked),
        run: build.indexed_packages(&build.base_diff_ids()).await?,
        modules: build.indexed_modules(&build.base_diff_ids()).await?,
    };
    let resolved = keys::resolve_keys(&build.archive, &build.base, &build.request.map, &own, &asked, &there)?;
    for warning in &resolved.warnings {
        build.progress.warn(warning.as_str()).await;
    }
    let python = pushed_packages::has_python(&space.root);
    let package = pack_space(build, &space, &prefix).await?;
    let libraries = source::needed_libraries(build, &package).await?;
    let needs = source::runtime_needs(build, &resolved, (libraries, python)).await?;
    let dependencies = source::dependencies(build, &needs).await?;
    Ok(BuildParts {
        packages,
        versions: pushed_packages::versions(&space.packages),
        dependencies,
        package,
        prefix: Some(prefix),
        contents: None,
    })
}

/// Chooses the prefix: the original one, if it is visible. An install space without a prefix works anywhere; scripts of
/// ROS 2 can be relocated.
fn choose_prefix(space: &InstallSpace, otherwise: &Path, packages: &[String]) -> Result<PathBuf, Error> {
    let Some(prefix) = &space.prefix else {
        return Ok(otherwise.to_owned());
    };
    let is_usable = prefix.is_absolute() && prefix != Path::new("/");
    let is_hidden = HIDDEN_DIRECTORIES.iter().any(|hidden| prefix.starts_with(hidden));
    match space.layout {
        _ if is_usable && !is_hidden => Ok(prefix.clone()),
        Layout::Merged | Layout::Isolated => Ok(otherwise.to_owned()),
        Layout::Catkin => {
            Err(Error::Prefix { prefix: prefix.clone(), package: packages.first().cloned().unwrap_or_default() })
        }
    }
}

async fn pack_space(build: &Build<'_>, space: &InstallSpace, prefix: &Path) -> Result<LayerSet, Error> {
    let root = &space.root;
    let root = root.canonicalize().io_context("opening", root)?;
    let hashed = root.clone();
    let content = crate::blocking::spawn(move || key::hash_tree(&hashed)).await??;
    let key =
        Key::new("prebuilt").input("content", content).input("prefix", prefix.as_os_str().as_encoded_bytes()).finish();
    let shop = &build.shop;
    let turn = shop.lock_key(&key).await;
    if let Some(entry) = shop.get_cached(&key).await?
        && let Some(layer) = entry.layer
    {
        return Ok(LayerSet::single(layer.diff_id, true));
    }
    build.progress.step("packing the install space").await;
    let directory = shop.site.fresh_directory("prebuilt")?;
    let tree = directory.join("tree");
    let target = tree.join(prefix.strip_prefix("/").unwrap_or(prefix));
    let parent = target.parent().unwrap_or(&tree).to_owned();
    fs::create_dir_all(&parent).io_context("making", &parent)?;
    for directory in parent.ancestors().take_while(|directory| directory.starts_with(&tree)) {
        set_mode(directory, 0o755)?;
    }
    // The pushed tree belongs to this build, so moving it is cheap.
    fs::rename(&root, &target).io_context("moving", &root)?;
    let opened = target.clone();
    crate::blocking::spawn(move || compile::make_readable(&opened)).await??;
    let packing = PackJob {
        key,
        made_from: pushed_packages::names(&space.packages).into_iter().collect(),
        tree,
        options: compile::package_options(&build.base, 0),
        directory,
        turn,
    };
    Ok(LayerSet::single(shop.pack(packing, |_| Ok(())).await?, false))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_space_is_where_it_was_built_for_if_that_can_be_seen() {
        let otherwise = Path::new("/opt/cloudroid/install");
        let placed = |layout, prefix: Option<&str>| {
            let space =
                InstallSpace { root: PathBuf::new(), layout, prefix: prefix.map(PathBuf::from), packages: Vec::new() };
            choose_prefix(&space, otherwise, &["p".to_owned()])
        };
        for layout in [Layout::Catkin, Layout::Merged, Layout::Isolated] {
            let ours = Path::new("/home/me/ws/install");
            assert_eq!(placed(layout, ours.to_str()).expect("can be seen"), ours);
            assert_eq!(placed(layout, None).expect("anywhere"), otherwise);
        }
        for hidden in ["/root/ws/install", "/tmp/x", "/"] {
            let text = placed(Layout::Catkin, Some(hidden)).expect_err("cannot be seen").to_string();
            assert!(text.contains("-DCMAKE_INSTALL_PREFIX=/opt/p"), "{text}");
            for layout in [Layout::Merged, Layout::Isolated] {
                assert_eq!(placed(layout, Some(hidden)).expect("elsewhere"), otherwise);
            }
        }
    }
}
