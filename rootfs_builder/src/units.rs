//! Separate compilation and caching of the packages of a workspace.
//!
//! A package sees its own sources, the files of the pushed tree outside all packages, and the install spaces of the
//! packages that its package.xml names (and of their dependencies), stacked like layers. Its key covers exactly that,
//! so a change affects only the changed package and those that depend on it, and packages compiled before a failure
//! stay compiled.
//!
//! Some packages use others without declaring it, which works because those happen to be built before. If such a
//! package fails because something is missing, it is compiled again with everything visible, and its key covers that.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs;
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use foreign::Visit;
use image::Digest;
use package::manifest::Kind;
use package::provided::Providers;
use package::workspace::{Package, Workspace};
use ros::flavour::Version;
use rustix::fs::FileType;

use crate::build::Build;
use crate::compile::{self, BuildLog, BuildUnit, CompileOrder, CompileOutput, Task};
use crate::error::{Error, IoContext};
use crate::install::LayerSet;
use crate::key::{self, Key};
use crate::merge::overlay_tree;
use crate::modes::set_mode;
use crate::underlay::UnderlayLayer;
use crate::workshop::PackJob;

/// Kinds of dependencies that make another package of the workspace visible.
const NEEDS: [Kind; 5] = [Kind::Buildtool, Kind::BuildtoolExport, Kind::Build, Kind::BuildExport, Kind::Exec];

/// Maximum number of install spaces mounted separately in a container; more are merged into one directory, since the
/// kernel mounts at most 500 layers.
const MOST_SPACES: usize = 64;

/// Messages of compilers, linkers, CMake and Python about missing files.
const ABSENT: [&str; 7] = [
    "No such file or directory",
    "cannot find",
    "Could not find",
    "could not find",
    "not found",
    "No module named",
    "does not exist",
];

/// Packages of a workspace, with the inputs of their keys.
struct WorkspaceUnits {
    root: PathBuf,
    units: Vec<BuildUnit>,
    /// Direct and indirect dependencies of each package among the earlier ones.
    needs: Vec<Vec<usize>>,
    /// Hash of each package's own sources.
    sources: Vec<String>,
    /// Hash of everything that was pushed.
    all: String,
    /// Directory with the files outside all packages; its hash is `rest_hash`.
    rest: PathBuf,
    rest_hash: String,
    /// Key of the common build environment.
    ground: String,
}

/// Visibility of the sources to a package: everything, or only its declared dependencies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum SourceVisibility {
    Named,
    All,
}

impl WorkspaceUnits {
    /// Reads the sources of a workspace. `place` is an empty directory of this build. Blocking.
    fn read(workspace: &Workspace, build_key: String, below: &[Digest], place: &Path) -> Result<Self, Error> {
        let packages = &workspace.packages;
        let root = workspace.root.clone();
        compile::make_readable(&root)?;
        let mut own = BTreeSet::new();
        let mut sources = Vec::new();
        for package in packages {
            // The package may be behind a link that stays inside, as in the search of the workspace.
            let directory = root.join(&package.path);
            let directory = directory.canonicalize().io_context("opening", &directory)?;
            sources.push(key::hash_sources(&directory)?);
            own.insert(directory);
        }
        for package in &workspace.left_out {
            let directory = root.join(package);
            own.insert(directory.canonicalize().io_context("opening", &directory)?);
        }
        let rest = place.join("rest");
        fs::create_dir(&rest).io_context("making", &rest)?;
        if !own.contains(&root) {
            link_tree(&root, &rest, &own)?;
        }
        Ok(Self {
            units: packages.iter().map(unit_from_package).collect(),
            needs: resolve_needs(packages),
            sources,
            all: key::hash_sources(&root)?,
            rest_hash: key::hash_sources(&rest)?,
            rest,
            root,
            ground: Key::new("unit-ground")
                .input("build", build_key)
                .inputs("below", below.iter().map(Digest::to_string))
                .finish(),
        })
    }

    /// Returns the key of a package; `keys` are those of all earlier packages.
    fn key(&self, index: usize, sight: SourceVisibility, keys: &[String]) -> String {
        let unit = &self.units[index];
        let key = Key::new("unit")
            .input("ground", &self.ground)
            .input("unit", format!("{} {} {}", unit.name, unit.path.display(), unit.build_type));
        match sight {
            SourceVisibility::Named => key
                .input("sees", "named")
                .input("sources", &self.sources[index])
                .input("rest", &self.rest_hash)
                .inputs("needs", self.needs[index].iter().map(|&need| &keys[need])),
            SourceVisibility::All => {
                key.input("sees", "all").input("sources", &self.all).inputs("needs", &keys[..index])
            }
        }
        .finish()
    }

    /// Returns the names of earlier packages that are not visible to a package.
    fn hidden_packages(&self, index: usize) -> Vec<&str> {
        (0..index)
            .filter(|earlier| !self.needs[index].contains(earlier))
            .map(|earlier| self.units[earlier].name.as_str())
            .collect()
    }

    /// Returns whether a failed build may be due to limited visibility: its output reports something missing that may
    /// be in an earlier, undeclared package, or among another package's sources.
    fn misses_something(&self, index: usize, said: &str) -> bool {
        let hidden = self.hidden_packages(index);
        let elsewhere = |line: &str| {
            let others = self.units.iter().enumerate();
            others
                .filter(|(other, unit)| *other != index && !unit.path.as_os_str().is_empty())
                .any(|(_, unit)| line.contains(&*unit.path.to_string_lossy()))
        };
        said.lines().any(|line| {
            hidden.iter().any(|name| line.contains(name))
                || ABSENT.iter().any(|words| line.contains(words)) && (!hidden.is_empty() || elsewhere(line))
        })
    }

    /// Creates a directory with the sources visible to a package. Blocking.
    fn make_view(&self, index: usize, place: &Path) -> Result<PathBuf, Error> {
        let path = &self.units[index].path;
        if path.as_os_str().is_empty() {
            return Ok(self.root.clone());
        }
        let view = place.join(format!("view-{index}"));
        fs::create_dir_all(view.join(path)).io_context("making", &view)?;
        let from = self.root.join(path);
        let from = from.canonicalize().io_context("opening", &from)?;
        link_tree(&from, &view.join(path), &BTreeSet::new())?;
        link_tree(&self.rest, &view, &BTreeSet::new())?;
        // The directories are new, and the compiling user is a different one.
        compile::make_readable(&view)?;
        Ok(view)
    }
}

fn unit_from_package(package: &Package) -> BuildUnit {
    BuildUnit {
        name: package.manifest.name.clone(),
        path: package.path.clone(),
        build_type: package.manifest.build_type.clone(),
    }
}

/// Returns, for each package, its direct and indirect dependencies among the earlier ones.
fn resolve_needs(packages: &[Package]) -> Vec<Vec<usize>> {
    let providers = Providers::new(packages);
    let mut all: Vec<Vec<usize>> = Vec::new();
    for (index, package) in packages.iter().enumerate() {
        let named = package.manifest.needs(&NEEDS);
        let provided = providers.find_all(&package.manifest);
        let mut found = BTreeSet::new();
        for (earlier, other) in packages[..index].iter().enumerate() {
            if named.contains(other.manifest.name.as_str())
                || provided.contains(&earlier)
                || package.manifest.needs_group_of(&other.manifest)
            {
                found.insert(earlier);
                found.extend(&all[earlier]);
            }
        }
        all.push(found.into_iter().collect());
    }
    all
}

/// Links all files below `from` into `to`, except the directories in `skip` and those of version control at the top of
/// a workspace; existing files in `to` are kept. Blocking.
fn link_tree(from: &Path, to: &Path, skip: &BTreeSet<PathBuf>) -> Result<(), Error> {
    foreign::walk(from, |entry| {
        if entry.path.as_os_str().is_empty() {
            return Ok(Visit::Into);
        }
        let (path, target) = (entry.display_path(), to.join(entry.path));
        match entry.kind() {
            FileType::Directory if skip.contains(&path) => return Ok(Visit::Skip),
            FileType::Directory if target.is_dir() => {}
            FileType::Directory => fs::create_dir(&target).io_context("making", &target)?,
            _ if target.symlink_metadata().is_ok() => {}
            FileType::Symlink => {
                let link = OsString::from_vec(entry.read_link()?);
                std::os::unix::fs::symlink(link, &target).io_context("linking", &target)?;
            }
            _ => {
                if fs::hard_link(&path, &target).is_err() {
                    fs::copy(&path, &target).io_context("copying", &path)?;
                }
            }
        }
        Ok::<_, Error>(Visit::Into)
    })
}

/// A compiled workspace.
pub(crate) struct CompiledWorkspace {
    /// Layer of the image.
    pub(crate) package: LayerSet,
    /// Layer as a part of an underlay, if it becomes one.
    pub(crate) underlay: Option<UnderlayLayer>,
}

/// Owner of the files in a layer of all packages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum MergedOwner {
    /// Root, as in images.
    Root,
    /// The compiling user, who can add to it.
    CompilingUser,
}

/// Returns the package layer: packages from the cache as far as possible, and others compiled now. `below` are base,
/// toolchain, build dependencies and underlays.
pub(crate) async fn compile_workspace(
    build: &Build<'_>,
    workspace: Workspace,
    below: Vec<Digest>,
) -> Result<CompiledWorkspace, Error> {
    let shop = &build.shop;
    let place = shop.site.fresh_directory("sources")?;
    let units = {
        let (below, place) = (below.clone(), place.clone());
        let key = build.base.build_key();
        let read = move || WorkspaceUnits::read(&workspace, key, &below, &place);
        Arc::new(crate::blocking::spawn(read).await??)
    };
    let count = units.units.len();
    let mut making = WorkspaceBuild { build, units, below, place, keys: Vec::new(), diff_ids: Vec::new() };
    let missing = making.find_missing().await?;
    if missing.is_empty()
        && let Some(made) = making.find_merged().await?
    {
        return Ok(made);
    }
    let mut log = BuildLog::create(&build.log)?;
    if missing.len() > 1 {
        making.check_packages(&missing, &mut log).await?;
    }
    for index in 0..count {
        if making.diff_ids[index].is_none() {
            making.build_unit(index, &mut log).await?;
        }
    }
    let package = making.merge_layers(MergedOwner::Root).await?;
    let mut underlay = None;
    if build.request.as_underlay {
        let compile = making.merge_layers(MergedOwner::CompilingUser).await?;
        underlay = to_underlay(&package, &compile);
    }
    Ok(CompiledWorkspace { package, underlay })
}

fn to_underlay(run: &LayerSet, compile: &LayerSet) -> Option<UnderlayLayer> {
    Some(UnderlayLayer { run: run.diff_ids().next()?, compile: compile.diff_ids().next()? })
}

/// Returns the cached layer of a key.
async fn cached_layer(build: &Build<'_>, key: &str) -> Result<Option<Digest>, Error> {
    let entry = build.shop.get_cached(key).await?;
    Ok(entry.and_then(|entry| entry.layer).map(|layer| layer.diff_id))
}

/// State of compiling a workspace.
struct WorkspaceBuild<'a> {
    build: &'a Build<'a>,
    units: Arc<WorkspaceUnits>,
    below: Vec<Digest>,
    /// Directory for the visible sources of each package.
    place: PathBuf,
    /// For each package, its key in the cache, or the one it will have if it compiles with its declared dependencies.
    keys: Vec<String>,
    /// For each package, its layer if it is compiled and extracted.
    diff_ids: Vec<Option<Digest>>,
}

impl WorkspaceBuild<'_> {
    /// Computes all keys; returns the packages that are not in the cache.
    async fn find_missing(&mut self) -> Result<Vec<usize>, Error> {
        let mut missing = Vec::new();
        for index in 0..self.units.units.len() {
            let (key, found) = self.find_key(index).await?;
            if !found {
                missing.push(index);
            }
            self.keys.push(key);
            self.diff_ids.push(None);
        }
        Ok(missing)
    }

    /// Returns the key of a package, and whether it is in the cache.
    async fn find_key(&self, index: usize) -> Result<(String, bool), Error> {
        let named = self.units.key(index, SourceVisibility::Named, &self.keys);
        let all = self.units.key(index, SourceVisibility::All, &self.keys);
        let layers = self.build.shop.layers.clone();
        Ok(crate::blocking::spawn(move || {
            if layers.contains(&named) {
                (named, true)
            } else if layers.contains(&all) {
                (all, true)
            } else {
                (named, false)
            }
        })
        .await?)
    }

    /// Checks all packages that are not compiled yet, on top of those that are; see [`Task::Check`].
    async fn check_packages(&mut self, missing: &[usize], log: &mut BuildLog) -> Result<(), Error> {
        let build = self.build;
        for index in 0..self.keys.len() {
            if !missing.contains(&index) {
                self.diff_ids[index] = cached_layer(build, &self.keys[index]).await?;
            }
        }
        let doing = match build.base.ros {
            Version::Ros1 => "configuring",
            Version::Ros2 => "looking at",
        };
        build.progress.step(&format!("{doing} {} packages", missing.len())).await;
        let there: Vec<usize> = (0..self.keys.len()).collect();
        let place = |need: &usize| missing.iter().position(|index| index == need);
        let order = CompileOrder {
            base: &build.base,
            layers: self.layer_trees(&there).await?,
            source: &self.units.root,
            units: missing
                .iter()
                .map(|&index| {
                    let needs = self.units.needs[index].iter().filter_map(place).collect();
                    (&self.units.units[index], needs)
                })
                .collect(),
            workspace: &self.units.units,
        };
        let directory = compile::run_task(&build.shop, Task::Check, &order, log, build.progress).await?.directory;
        crate::blocking::spawn(move || Ok(foreign::remove(&directory)?)).await?
    }

    /// Gets a package from the cache, or compiles it.
    async fn build_unit(&mut self, index: usize, log: &mut BuildLog) -> Result<(), Error> {
        let build = self.build;
        let named = self.units.key(index, SourceVisibility::Named, &self.keys);
        let turn = build.shop.lock_key(&named).await;
        let (key, found) = self.find_key(index).await?;
        if found && let Some(diff_id) = cached_layer(build, &key).await? {
            (self.keys[index], self.diff_ids[index]) = (key, Some(diff_id));
            return Ok(());
        }
        let (units, place) = (self.units.clone(), self.place.clone());
        let view = crate::blocking::spawn(move || units.make_view(index, &place)).await??;
        let begun = log.len();
        let needs = self.units.needs[index].clone();
        let (key, made, turn) = match self.compile_unit(index, &needs, &view, log).await {
            Ok(made) => (named, made, turn),
            Err(Error::BuildFailed { .. }) if self.units.misses_something(index, &log.text_since(begun)) => {
                drop(turn);
                let key = self.units.key(index, SourceVisibility::All, &self.keys);
                let turn = build.shop.lock_key(&key).await;
                let earlier: Vec<usize> = (0..index).collect();
                let root = self.units.root.clone();
                let made = self.compile_unit(index, &earlier, &root, log).await?;
                let text = format!(
                    "{} uses packages of the workspace that its package.xml does not name, so it is recompiled when \
                        any package changes",
                    self.units.units[index].name
                );
                build.progress.warn(text).await;
                (key, made, turn)
            }
            Err(error) => return Err(error),
        };
        let packing = PackJob {
            key: key.clone(),
            made_from: vec![self.units.units[index].name.clone()],
            tree: made.tree,
            options: compile::unit_options(&build.base, made.uid_offset),
            directory: made.directory,
            turn,
        };
        let diff_id = build.shop.pack(packing, |_| Ok(())).await?;
        (self.keys[index], self.diff_ids[index]) = (key, Some(diff_id));
        Ok(())
    }

    /// Compiles a package on top of some of the earlier ones.
    async fn compile_unit(
        &self,
        index: usize,
        on: &[usize],
        source: &Path,
        log: &mut BuildLog,
    ) -> Result<CompileOutput, Error> {
        let build = self.build;
        let order = CompileOrder {
            base: &build.base,
            layers: self.layer_trees(on).await?,
            source,
            units: vec![(&self.units.units[index], Vec::new())],
            workspace: &self.units.units,
        };
        compile::run_task(&build.shop, Task::Compile, &order, log, build.progress).await
    }

    /// Returns the trees of the common layers, and of those of these packages that are available.
    async fn layer_trees(&self, packages: &[usize]) -> Result<Vec<PathBuf>, Error> {
        let shop = &self.build.shop;
        let mut trees = shop.extract_layers(&self.below).await?;
        let packages = packages.iter().filter_map(|&index| self.diff_ids[index]);
        let packages: Vec<Digest> = packages.collect();
        let spaces = shop.extract_layers(&packages).await?;
        if spaces.len() <= MOST_SPACES {
            trees.extend(spaces);
        } else {
            let whole = shop.site.fresh_directory("spaces")?;
            set_mode(&whole, 0o755)?;
            let into = whole.clone();
            crate::blocking::spawn(move || spaces.iter().try_for_each(|space| overlay_tree(space, &into))).await??;
            trees.push(whole);
        }
        Ok(trees)
    }

    fn whole_key(&self, owner: MergedOwner) -> String {
        let name = match owner {
            MergedOwner::Root => "workspace",
            MergedOwner::CompilingUser => "underlay",
        };
        Key::new(name).inputs("unit", &self.keys).finish()
    }

    async fn find_layer(&self, owner: MergedOwner) -> Result<Option<LayerSet>, Error> {
        let found = cached_layer(self.build, &self.whole_key(owner)).await?;
        Ok(found.map(|diff_id| LayerSet::single(diff_id, true)))
    }

    /// Returns the cached layers of all packages, if there are all that are needed.
    async fn find_merged(&self) -> Result<Option<CompiledWorkspace>, Error> {
        let Some(package) = self.find_layer(MergedOwner::Root).await? else {
            return Ok(None);
        };
        if !self.build.request.as_underlay {
            return Ok(Some(CompiledWorkspace { package, underlay: None }));
        }
        let underlay = self.find_layer(MergedOwner::CompilingUser).await?;
        let underlay = underlay.and_then(|compile| to_underlay(&package, &compile));
        Ok(underlay.map(|underlay| CompiledWorkspace { package, underlay: Some(underlay) }))
    }

    /// Merges all packages into one layer, as if they had been installed one after the other.
    async fn merge_layers(&self, owner: MergedOwner) -> Result<LayerSet, Error> {
        let shop = &self.build.shop;
        let key = self.whole_key(owner);
        let turn = shop.lock_key(&key).await;
        if let Some(diff_id) = cached_layer(self.build, &key).await? {
            return Ok(LayerSet::single(diff_id, true));
        }
        self.build.progress.step("packing the package").await;
        let directory = shop.site.fresh_directory("package")?;
        let tree = directory.join("tree");
        fs::create_dir(&tree).io_context("making", &tree)?;
        let diff_ids: Vec<Digest> = self.diff_ids.iter().copied().flatten().collect();
        let (trees, into) = (shop.extract_layers(&diff_ids).await?, tree.clone());
        crate::blocking::spawn(move || trees.iter().try_for_each(|tree| overlay_tree(tree, &into))).await??;
        let made_from = self.units.units.iter().map(|unit| unit.name.clone());
        let packing = PackJob {
            key,
            made_from: made_from.collect(),
            tree,
            options: match owner {
                MergedOwner::Root => compile::package_options(&self.build.base, servant::rootfs::COMPILE_USER),
                MergedOwner::CompilingUser => compile::package_options(&self.build.base, 0),
            },
            directory,
            turn,
        };
        let diff_id = shop.pack(packing, |_| Ok(())).await?;
        Ok(LayerSet::single(diff_id, false))
    }
}

#[cfg(test)]
mod tests;
