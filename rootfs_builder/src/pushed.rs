//! What was pushed, as far as a build asks.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use crate::compile::Unit;
use crate::error::{Error, IoAt};
use crate::manifest;

/// The two kinds of trees.
pub(crate) enum Pushed {
    /// To be compiled.
    Source(SourceTree),
    /// Compiled elsewhere.
    InstallSpace(InstallSpace),
}

/// One package or a workspace of several.
pub(crate) struct SourceTree {
    pub(crate) root: PathBuf,
    /// In the order of compiling.
    pub(crate) packages: Vec<PushedPackage>,
}

/// An install space.
pub(crate) struct InstallSpace {
    pub(crate) root: PathBuf,
    /// Where it was compiled for.
    pub(crate) prefix: PathBuf,
    pub(crate) packages: Vec<PushedPackage>,
}

/// A package of either.
pub(crate) struct PushedPackage {
    pub(crate) unit: Unit,
    pub(crate) version: String,
    /// rosdep keys and ROS packages asked for while compiling.
    pub(crate) build: BTreeSet<String>,
    /// The same at run time.
    pub(crate) run: BTreeSet<String>,
}

/// Looks at a pushed tree.
pub(crate) fn analyse(root: &Path) -> Result<Pushed, Error> {
    provisional::analyse(root)
}

/// Texts of the definitions in an image: below `/usr/share` and an install space.
pub(crate) fn definitions(trees: &[PathBuf], prefix: Option<&Path>) -> Result<BTreeMap<String, String>, Error> {
    let mut found = BTreeMap::new();
    for share in [Some(Path::new("/usr")), prefix].into_iter().flatten().map(|prefix| prefix.join("share")) {
        for tree in trees {
            let share = tree.join(share.strip_prefix("/").unwrap_or(&share));
            for package in fs::read_dir(&share).into_iter().flatten().flatten() {
                let name = package.file_name().to_string_lossy().into_owned();
                for kind in ["msg", "srv", "action"] {
                    for file in fs::read_dir(package.path().join(kind)).into_iter().flatten().flatten() {
                        let path = file.path();
                        if path.extension().is_some_and(|extension| extension == kind)
                            && let Some(stem) = path.file_stem().and_then(|stem| stem.to_str())
                        {
                            let text = fs::read(&path).at("reading", &path)?;
                            let text = String::from_utf8_lossy(&text).into_owned();
                            found.insert(format!("{name}/{kind}/{stem}"), text);
                        }
                    }
                }
            }
        }
    }
    Ok(found)
}

mod provisional {
    use super::*;

    pub(super) fn analyse(root: &Path) -> Result<Pushed, Error> {
        let mut packages = Vec::new();
        for entry in walkdir::WalkDir::new(root).sort_by_file_name() {
            let entry = entry.map_err(|e| Error::io("reading", root, e.into()))?;
            if entry.file_name() == "package.xml" {
                let text = fs::read_to_string(entry.path()).at("reading", entry.path())?;
                let relative = entry.path().parent().unwrap().strip_prefix(root).unwrap().to_owned();
                packages.push(manifest::pushed_package(&text, relative).map_err(|problem| Error::BadBase {
                    path: entry.path().to_owned(),
                    problem,
                })?);
            }
        }
        if packages.is_empty() {
            return Err(Error::BadBase { path: root.to_owned(), problem: "there is no package.xml".into() });
        }
        if root.join("setup.sh").is_file() && root.join("share").is_dir() {
            let text = fs::read_to_string(root.join("_setup_util.py")).unwrap_or_default();
            let prefix = text
                .lines()
                .find_map(|l| l.trim().strip_prefix("CMAKE_PREFIX_PATH = r'")?.split(['\'', ';']).next().map(PathBuf::from))
                .unwrap_or_else(|| "/opt/cloudroid/install".into());
            return Ok(Pushed::InstallSpace(InstallSpace { root: root.to_owned(), prefix, packages }));
        }
        // Topological.
        let names: BTreeSet<String> = packages.iter().map(|p| p.unit.name.clone()).collect();
        let mut ordered: Vec<PushedPackage> = Vec::new();
        while !packages.is_empty() {
            let done: BTreeSet<String> = ordered.iter().map(|p| p.unit.name.clone()).collect();
            let at = packages
                .iter()
                .position(|p| p.build.union(&p.run).all(|k| !names.contains(k) || done.contains(k)))
                .unwrap_or(0);
            ordered.push(packages.remove(at));
        }
        Ok(Pushed::Source(SourceTree { root: root.to_owned(), packages: ordered }))
    }
}
