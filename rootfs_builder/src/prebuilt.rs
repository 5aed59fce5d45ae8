//! An install space that was compiled elsewhere: placed where it was compiled for.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use package::workspace::{InstallSpace, Layout};

use crate::build::{Build, Parts};
use crate::compile;
use crate::error::{Error, IoAt};
use crate::indexed::Indexed;
use crate::install::{Made, set_mode};
use crate::key::{self, Key};
use crate::keys::{self, Needed};
use crate::workshop::Packing;
use crate::{pushed, source};

/// Where a servant has scratch space: what an image holds there cannot be seen.
const HIDDEN: [&str; 7] = ["/dev", "/proc", "/root", "/run", "/sys", "/tmp", "/var"];

/// Packs it and finds what it needs.
pub(crate) async fn build(build: &Build<'_>, space: InstallSpace) -> Result<Parts, Error> {
    let packages = pushed::by_importance(&space.packages);
    let prefix = place(&space, &build.base.build.prefix, &packages)?;
    let (own, asked) = (
        pushed::names(&space.packages),
        pushed::asked(&space.packages),
    );
    // Compiled already: what it was compiled with is of no interest.
    let asked = Needed {
        build: BTreeMap::new(),
        ..asked
    };
    let there = Indexed {
        build: pushed::tools(&asked),
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
    let python = pushed::has_python(&space.root);
    let package = packed(build, &space, &prefix).await?;
    let needed = source::needed_by(build, &package).await?;
    let dependencies = source::dependencies(build, &resolved, &needed, python).await?;
    Ok(Parts {
        packages,
        versions: pushed::versions(&space.packages),
        dependencies,
        package,
        prefix: Some(prefix),
    })
}

/// Where it is put: where it was built for, if that can be seen. Without a prefix nothing in it cares where it is; scripts
/// of ROS 2 can be told.
fn place(space: &InstallSpace, otherwise: &Path, packages: &[String]) -> Result<PathBuf, Error> {
    let Some(prefix) = &space.prefix else {
        return Ok(otherwise.to_owned());
    };
    let is_usable = prefix.is_absolute() && prefix != Path::new("/");
    let is_hidden = HIDDEN.iter().any(|hidden| prefix.starts_with(hidden));
    match space.layout {
        _ if is_usable && !is_hidden => Ok(prefix.clone()),
        Layout::Merged | Layout::Isolated => Ok(otherwise.to_owned()),
        Layout::Catkin => Err(Error::Prefix {
            prefix: prefix.clone(),
            package: packages.first().cloned().unwrap_or_default(),
        }),
    }
}

async fn packed(build: &Build<'_>, space: &InstallSpace, prefix: &Path) -> Result<Made, Error> {
    let root = &space.root;
    let root = root.canonicalize().at("opening", root)?;
    let hashed = root.clone();
    let content = crate::blocking::spawn(move || key::tree(&hashed)).await??;
    let key = Key::new("prebuilt")
        .with("content", content)
        .with("prefix", prefix.as_os_str().as_encoded_bytes())
        .finish();
    let shop = &build.shop;
    let turn = shop.turn(&key).await;
    if let Some(entry) = shop.cached(&key).await?
        && let Some(layer) = entry.layer
    {
        return Ok(Made::one(layer.diff_id, true));
    }
    build.progress.step("packing the install space").await;
    let directory = shop.site.fresh("prebuilt")?;
    let tree = directory.join("tree");
    let target = tree.join(prefix.strip_prefix("/").unwrap_or(prefix));
    let parent = target.parent().unwrap_or(&tree).to_owned();
    fs::create_dir_all(&parent).at("making", &parent)?;
    for directory in parent
        .ancestors()
        .take_while(|directory| directory.starts_with(&tree))
    {
        set_mode(directory, 0o755)?;
    }
    // The pushed tree is this build's own: moving it costs nothing.
    fs::rename(&root, &target).at("moving", &root)?;
    let opened = target.clone();
    crate::blocking::spawn(move || compile::open_up(&opened)).await??;
    let packing = Packing {
        key,
        made_from: pushed::names(&space.packages).into_iter().collect(),
        tree,
        options: compile::package_options(&build.base, 0),
        directory,
        turn,
    };
    Ok(Made::one(shop.pack(packing, |_| Ok(())).await?, false))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_space_is_where_it_was_built_for_if_that_can_be_seen() {
        let otherwise = Path::new("/opt/cloudroid/install");
        let placed = |layout, prefix: Option<&str>| {
            let space = InstallSpace {
                root: PathBuf::new(),
                layout,
                prefix: prefix.map(PathBuf::from),
                packages: Vec::new(),
            };
            place(&space, otherwise, &["p".to_owned()])
        };
        for layout in [Layout::Catkin, Layout::Merged, Layout::Isolated] {
            let ours = Path::new("/home/me/ws/install");
            assert_eq!(placed(layout, ours.to_str()).expect("can be seen"), ours);
            assert_eq!(placed(layout, None).expect("anywhere"), otherwise);
        }
        for hidden in ["/root/ws/install", "/tmp/x", "/"] {
            let text = placed(Layout::Catkin, Some(hidden))
                .expect_err("cannot be seen")
                .to_string();
            assert!(text.contains("-DCMAKE_INSTALL_PREFIX=/opt/p"), "{text}");
            for layout in [Layout::Merged, Layout::Isolated] {
                assert_eq!(placed(layout, Some(hidden)).expect("elsewhere"), otherwise);
            }
        }
    }
}
