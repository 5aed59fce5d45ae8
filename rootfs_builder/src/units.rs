//! The packages of a workspace, each compiled by itself and kept by itself.
//!
//! A package sees its own sources, what of the pushed tree is no package's, and the install spaces of the packages
//! that its package.xml names (and of those that they name), put over each other like layers. That is all its key is
//! made of, so a change costs the changed package and those that need it, and what was compiled before another
//! package failed stays compiled.
//!
//! Some packages use others that they do not name, because they happen to come earlier. Where one fails for want of
//! something it was not shown, it is compiled again with everything in sight, and its key says so.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs;
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use foreign::Visit;
use image::Digest;
use package::manifest::Kind;
use package::workspace::{Package, Workspace};
use ros::flavour::Version;
use rustix::fs::FileType;

use crate::build::Build;
use crate::compile::{self, Compiled, Log, Order, Task, Unit};
use crate::error::{Error, IoAt};
use crate::install::{Made, set_mode};
use crate::key::{self, Key};
use crate::merge::lay_over;
use crate::workshop::Packing;

/// What of a package.xml counts as needing another package of the workspace.
const NEEDS: [Kind; 5] = [
    Kind::Buildtool,
    Kind::BuildtoolExport,
    Kind::Build,
    Kind::BuildExport,
    Kind::Exec,
];

/// More install spaces than this are put into one directory for a container: the kernel mounts 500 layers at most.
const MOST_SPACES: usize = 64;

/// What compilers, linkers, CMake and Python say when something is not there.
const ABSENT: [&str; 7] = [
    "No such file or directory",
    "cannot find",
    "Could not find",
    "could not find",
    "not found",
    "No module named",
    "does not exist",
];

/// Packages with what their keys are made of.
struct Units {
    root: PathBuf,
    units: Vec<Unit>,
    /// Of each, those before it that it needs, directly or not.
    needs: Vec<Vec<usize>>,
    /// Of each, the hash of its own sources.
    sources: Vec<String>,
    /// Of everything pushed.
    all: String,
    /// What no package holds, and its hash.
    rest: PathBuf,
    rest_hash: String,
    /// What all of them are compiled with.
    ground: String,
}

/// Whether a package sees all or only what it names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Sight {
    Named,
    All,
}

impl Units {
    /// Reads the sources of a workspace. `place`: an empty directory of this build. Blocking.
    fn read(
        workspace: &Workspace,
        build_key: String,
        below: &[Digest],
        place: &Path,
    ) -> Result<Self, Error> {
        let packages = &workspace.packages;
        let root = workspace.root.clone();
        compile::open_up(&root)?;
        let mut own = BTreeSet::new();
        let mut sources = Vec::new();
        for package in packages {
            // It may stand behind a link that stays inside, as the workspace was searched.
            let directory = root.join(&package.path);
            let directory = directory.canonicalize().at("opening", &directory)?;
            sources.push(key::sources(&directory)?);
            own.insert(directory);
        }
        let rest = place.join("rest");
        fs::create_dir(&rest).at("making", &rest)?;
        if !own.contains(&root) {
            link_tree(&root, &rest, &own)?;
        }
        Ok(Self {
            units: packages.iter().map(unit).collect(),
            needs: needs(packages),
            sources,
            all: key::sources(&root)?,
            rest_hash: key::sources(&rest)?,
            rest,
            root,
            ground: Key::new("unit-ground")
                .with("build", build_key)
                .with_all("below", below.iter().map(Digest::to_string))
                .finish(),
        })
    }

    /// The key of a package. `keys`: those of all before it.
    fn key(&self, index: usize, sight: Sight, keys: &[String]) -> String {
        let unit = &self.units[index];
        let key = Key::new("unit").with("ground", &self.ground).with(
            "unit",
            format!("{} {} {}", unit.name, unit.path.display(), unit.build_type),
        );
        match sight {
            Sight::Named => key
                .with("sees", "named")
                .with("sources", &self.sources[index])
                .with("rest", &self.rest_hash)
                .with_all("needs", self.needs[index].iter().map(|&need| &keys[need])),
            Sight::All => key
                .with("sees", "all")
                .with("sources", &self.all)
                .with_all("needs", &keys[..index]),
        }
        .finish()
    }

    /// Names of earlier packages that a package is not shown.
    fn hidden(&self, index: usize) -> Vec<&str> {
        (0..index)
            .filter(|earlier| !self.needs[index].contains(earlier))
            .map(|earlier| self.units[earlier].name.as_str())
            .collect()
    }

    /// Whether what a build said may come from what it was not shown: it misses something, and that may be in a
    /// package before it that it does not name, or is looked for among another package's sources.
    fn misses_something(&self, index: usize, said: &str) -> bool {
        let hidden = self.hidden(index);
        let elsewhere = |line: &str| {
            let others = self.units.iter().enumerate();
            others
                .filter(|(other, unit)| *other != index && !unit.path.as_os_str().is_empty())
                .any(|(_, unit)| line.contains(&*unit.path.to_string_lossy()))
        };
        said.lines().any(|line| {
            hidden.iter().any(|name| line.contains(name))
                || ABSENT.iter().any(|words| line.contains(words))
                    && (!hidden.is_empty() || elsewhere(line))
        })
    }

    /// A directory with what a package may see of the sources. Blocking.
    fn view(&self, index: usize, place: &Path) -> Result<PathBuf, Error> {
        let path = &self.units[index].path;
        if path.as_os_str().is_empty() {
            return Ok(self.root.clone());
        }
        let view = place.join(format!("view-{index}"));
        fs::create_dir_all(view.join(path)).at("making", &view)?;
        let from = self.root.join(path);
        let from = from.canonicalize().at("opening", &from)?;
        link_tree(&from, &view.join(path), &BTreeSet::new())?;
        link_tree(&self.rest, &view, &BTreeSet::new())?;
        // The directories are new, and the compiling user is another.
        compile::open_up(&view)?;
        Ok(view)
    }
}

fn unit(package: &Package) -> Unit {
    Unit {
        name: package.manifest.name.clone(),
        path: package.path.clone(),
        build_type: package.manifest.build_type.clone(),
    }
}

/// Of each package, the earlier ones that it needs, and those that they need.
fn needs(packages: &[Package]) -> Vec<Vec<usize>> {
    let mut all: Vec<Vec<usize>> = Vec::new();
    for (index, package) in packages.iter().enumerate() {
        let named = package.manifest.needs(&NEEDS);
        let mut found = BTreeSet::new();
        for (earlier, other) in packages[..index].iter().enumerate() {
            if named.contains(other.manifest.name.as_str())
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

/// Links all files below `from` into `to`, without the directories in `skip` and what version control keeps at the
/// top of a workspace; what is in `to` already stays. Blocking.
fn link_tree(from: &Path, to: &Path, skip: &BTreeSet<PathBuf>) -> Result<(), Error> {
    foreign::walk(from, |entry| {
        if entry.path.as_os_str().is_empty() {
            return Ok(Visit::Into);
        }
        let (path, target) = (entry.shown(), to.join(entry.path));
        match entry.kind() {
            FileType::Directory if skip.contains(&path) => return Ok(Visit::Skip),
            FileType::Directory if target.is_dir() => {}
            FileType::Directory => fs::create_dir(&target).at("making", &target)?,
            _ if target.symlink_metadata().is_ok() => {}
            FileType::Symlink => {
                let link = OsString::from_vec(entry.link()?);
                std::os::unix::fs::symlink(link, &target).at("linking", &target)?;
            }
            _ => {
                if fs::hard_link(&path, &target).is_err() {
                    fs::copy(&path, &target).at("copying", &path)?;
                }
            }
        }
        Ok::<_, Error>(Visit::Into)
    })
}

/// The package layer: of packages from the cache as far as they are there, and compiled now. `below`: base, toolchain
/// and build dependencies.
pub(crate) async fn compiled(
    build: &Build<'_>,
    workspace: Workspace,
    below: Vec<Digest>,
) -> Result<Made, Error> {
    let shop = &build.shop;
    let place = shop.site.fresh("sources")?;
    let units = {
        let (below, place) = (below.clone(), place.clone());
        let key = build.base.build_key();
        let read = move || Units::read(&workspace, key, &below, &place);
        Arc::new(crate::blocking::spawn(read).await??)
    };
    let count = units.units.len();
    let mut making = Making {
        build,
        units,
        below,
        place,
        keys: Vec::new(),
        diff_ids: Vec::new(),
    };
    let missing = making.missing().await?;
    if missing.is_empty()
        && let Some(diff_id) = fetched(build, &making.whole_key()).await?
    {
        return Ok(Made::one(diff_id, true));
    }
    let mut log = Log::create(&build.log)?;
    if missing.len() > 1 {
        making.check(&missing, &mut log).await?;
    }
    for index in 0..count {
        if making.diff_ids[index].is_none() {
            making.unit(index, &mut log).await?;
        }
    }
    making.merged().await
}

/// The layer of a key in the cache.
async fn fetched(build: &Build<'_>, key: &str) -> Result<Option<Digest>, Error> {
    let entry = build.shop.cached(key).await?;
    Ok(entry
        .and_then(|entry| entry.layer)
        .map(|layer| layer.diff_id))
}

/// A workspace while its packages become layers.
struct Making<'a> {
    build: &'a Build<'a>,
    units: Arc<Units>,
    below: Vec<Digest>,
    /// For views of the sources.
    place: PathBuf,
    /// Of each package: what it has in the cache, or would have if it is compiled with what it names.
    keys: Vec<String>,
    /// Of each package that is compiled and at hand.
    diff_ids: Vec<Option<Digest>>,
}

impl Making<'_> {
    /// Finds all keys; gives the packages that are not in the cache.
    async fn missing(&mut self) -> Result<Vec<usize>, Error> {
        let mut missing = Vec::new();
        for index in 0..self.units.units.len() {
            let (key, found) = self.look(index).await?;
            if !found {
                missing.push(index);
            }
            self.keys.push(key);
            self.diff_ids.push(None);
        }
        Ok(missing)
    }

    /// The key under which a package is in the cache, or the one it is to have.
    async fn look(&self, index: usize) -> Result<(String, bool), Error> {
        let named = self.units.key(index, Sight::Named, &self.keys);
        let all = self.units.key(index, Sight::All, &self.keys);
        let layers = self.build.shop.layers.clone();
        Ok(crate::blocking::spawn(move || {
            if layers.has(&named) {
                (named, true)
            } else if layers.has(&all) {
                (all, true)
            } else {
                (named, false)
            }
        })
        .await?)
    }

    /// Looks at all packages that are not compiled yet, on those that are: see [`Task::Check`].
    async fn check(&mut self, missing: &[usize], log: &mut Log) -> Result<(), Error> {
        let build = self.build;
        for index in 0..self.keys.len() {
            if !missing.contains(&index) {
                self.diff_ids[index] = fetched(build, &self.keys[index]).await?;
            }
        }
        let doing = match build.base.ros {
            Version::Ros1 => "configuring",
            Version::Ros2 => "looking at",
        };
        build
            .progress
            .step(&format!("{doing} {} packages", missing.len()))
            .await;
        let there: Vec<usize> = (0..self.keys.len()).collect();
        let place = |need: &usize| missing.iter().position(|index| index == need);
        let order = Order {
            base: &build.base,
            layers: self.trees(&there).await?,
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
        let directory = compile::run(&build.shop, Task::Check, &order, log, build.progress)
            .await?
            .directory;
        crate::blocking::spawn(move || Ok(foreign::remove(&directory)?)).await?
    }

    /// One package: from the cache, or compiled now.
    async fn unit(&mut self, index: usize, log: &mut Log) -> Result<(), Error> {
        let build = self.build;
        let named = self.units.key(index, Sight::Named, &self.keys);
        let turn = build.shop.turn(&named).await;
        let (key, found) = self.look(index).await?;
        if found && let Some(diff_id) = fetched(build, &key).await? {
            (self.keys[index], self.diff_ids[index]) = (key, Some(diff_id));
            return Ok(());
        }
        let (units, place) = (self.units.clone(), self.place.clone());
        let view = crate::blocking::spawn(move || units.view(index, &place)).await??;
        let begun = log.len();
        let needs = self.units.needs[index].clone();
        let (key, made, turn) = match self.attempt(index, &needs, &view, log).await {
            Ok(made) => (named, made, turn),
            Err(Error::BuildFailed { .. })
                if self.units.misses_something(index, &log.since(begun)) =>
            {
                drop(turn);
                let key = self.units.key(index, Sight::All, &self.keys);
                let turn = build.shop.turn(&key).await;
                let earlier: Vec<usize> = (0..index).collect();
                let root = self.units.root.clone();
                let made = self.attempt(index, &earlier, &root, log).await?;
                let text = format!(
                    "{} uses other packages of the workspace that its package.xml does not name: it is compiled \
                     again whenever any of them changes",
                    self.units.units[index].name
                );
                build.progress.warn(text).await;
                (key, made, turn)
            }
            Err(error) => return Err(error),
        };
        let packing = Packing {
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

    /// Compiles one package on some of those before it.
    async fn attempt(
        &self,
        index: usize,
        on: &[usize],
        source: &Path,
        log: &mut Log,
    ) -> Result<Compiled, Error> {
        let build = self.build;
        let order = Order {
            base: &build.base,
            layers: self.trees(on).await?,
            source,
            units: vec![(&self.units.units[index], Vec::new())],
            workspace: &self.units.units,
        };
        compile::run(&build.shop, Task::Compile, &order, log, build.progress).await
    }

    /// Trees of what is below all, and of those of these packages that are at hand.
    async fn trees(&self, packages: &[usize]) -> Result<Vec<PathBuf>, Error> {
        let shop = &self.build.shop;
        let mut trees = shop.extracted(&self.below).await?;
        let packages = packages.iter().filter_map(|&index| self.diff_ids[index]);
        let packages: Vec<Digest> = packages.collect();
        let spaces = shop.extracted(&packages).await?;
        if spaces.len() <= MOST_SPACES {
            trees.extend(spaces);
        } else {
            let whole = shop.site.fresh("spaces")?;
            set_mode(&whole, 0o755)?;
            let into = whole.clone();
            crate::blocking::spawn(move || {
                spaces.iter().try_for_each(|space| lay_over(space, &into))
            })
            .await??;
            trees.push(whole);
        }
        Ok(trees)
    }

    fn whole_key(&self) -> String {
        Key::new("workspace").with_all("unit", &self.keys).finish()
    }

    /// The layer of the image: all packages over each other, as if they had been installed one after the other.
    async fn merged(self) -> Result<Made, Error> {
        let shop = &self.build.shop;
        let key = self.whole_key();
        let turn = shop.turn(&key).await;
        if let Some(diff_id) = fetched(self.build, &key).await? {
            return Ok(Made::one(diff_id, true));
        }
        self.build.progress.step("packing the package").await;
        let directory = shop.site.fresh("package")?;
        let tree = directory.join("tree");
        fs::create_dir(&tree).at("making", &tree)?;
        let diff_ids: Vec<Digest> = self.diff_ids.iter().copied().flatten().collect();
        let (trees, into) = (shop.extracted(&diff_ids).await?, tree.clone());
        crate::blocking::spawn(move || trees.iter().try_for_each(|tree| lay_over(tree, &into)))
            .await??;
        let made_from = self.units.units.iter().map(|unit| unit.name.clone());
        let packing = Packing {
            key,
            made_from: made_from.collect(),
            tree,
            options: compile::package_options(&self.build.base, servant::rootfs::COMPILE_USER),
            directory,
            turn,
        };
        let diff_id = shop.pack(packing, |_| Ok(())).await?;
        Ok(Made::one(diff_id, false))
    }
}

#[cfg(test)]
mod tests;
