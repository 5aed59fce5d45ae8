//! From a push to an image: which layers, in which order, from the cache or made now.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs;
use std::path::PathBuf;
use std::sync::Arc;

use package::workspace::Pushed;
use image::{ImageSpec, LayerInfo, Store};
use servant::engine::Engine;
use tokio::sync::mpsc;

use crate::apt::{Deb, Sources};
use crate::archive::Archive;
use crate::base::{self, Base};
use crate::bootstrap;
use crate::cache::Layers;
use crate::error::{Error, IoAt};
use crate::event::{BuildEvent, Progress};
use crate::install::{self, Addition, Made};
use crate::key::Key;
use crate::launch::{self, Ask, LaunchPlan};
use crate::request::{BuildOutcome, BuiltLayer, PushRequest, Source};
use crate::sandbox::Site;
use crate::workshop::{Turns, Workshop};
use crate::{keys, packaged, prebuilt, pushed, source, sources};

/// The base taken when none is named.
pub const DEFAULT_BASE: &str = "bookworm-ros1";

/// What a builder works with.
#[derive(Clone)]
pub struct Config {
    /// Shared between daemons: layers, downloaded packages, lists.
    pub cache_dir: PathBuf,
    /// Base definitions.
    pub bases_dir: PathBuf,
    /// Half-made things, one directory per build; swept by whoever starts the daemon.
    pub build_dir: PathBuf,
    /// Complete logs of builds.
    pub logs_dir: PathBuf,
    /// Where packages come from.
    pub sources: Sources,
    /// Where images go.
    pub store: Arc<Store>,
    /// What runs sandboxes.
    pub engine: Arc<dyn Engine>,
}

/// Makes images. Cheap to share in an `Arc`; several builds may run at once.
pub struct Builder {
    config: Config,
    layers: Layers,
    turns: Turns,
    archives: tokio::sync::Mutex<HashMap<String, Arc<Archive>>>,
}

enum What<'a> {
    Tree(Pushed),
    Packaged(&'a str),
}

/// What the three ways of pushing have in common while they work.
pub(crate) struct Build<'a> {
    pub(crate) shop: Workshop,
    pub(crate) base: Base,
    pub(crate) archive: Arc<Archive>,
    pub(crate) base_layer: Made,
    pub(crate) request: &'a PushRequest,
    pub(crate) progress: &'a Progress,
    pub(crate) log: PathBuf,
}

/// What one of them found and made.
pub(crate) struct Parts {
    /// ROS packages that the push is about, the one that gives its name first.
    pub(crate) packages: Vec<String>,
    pub(crate) version: String,
    pub(crate) dependencies: Made,
    pub(crate) package: Option<Made>,
    /// Its install space; none for one below `/usr`.
    pub(crate) prefix: Option<PathBuf>,
}

impl Builder {
    /// Prepares the cache.
    pub fn new(config: Config) -> Result<Self, Error> {
        for path in [&config.cache_dir, &config.build_dir, &config.logs_dir] {
            fs::create_dir_all(path).at("making", path)?;
        }
        let layers = Layers::new(&config.cache_dir, config.store.clone())?;
        Ok(Self { config, layers, turns: Turns::default(), archives: Default::default() })
    }

    /// Makes the image of a push. To cancel, drop the future: containers are ended and the build's directory is
    /// removed. Nothing is tagged, so a failed build changes nothing for anyone.
    pub async fn build(
        &self,
        request: &PushRequest,
        events: mpsc::Sender<BuildEvent>,
    ) -> Result<BuildOutcome, Error> {
        let progress = &Progress::new(events);
        let hold = self.config.store.hold()?;
        let base = base::load(&self.config.bases_dir, request.base.as_deref().unwrap_or(DEFAULT_BASE))?;
        let site = Site::new(&self.config.build_dir, &request.id, self.config.engine.clone())?;
        let shop = Workshop { site, layers: self.layers.clone(), turns: self.turns.clone() };
        // Before anything is downloaded: what was pushed may not be a package at all.
        let what = match &request.source {
            Source::Tree(path) => What::Tree(pushed::inspect(path, &base)?),
            Source::Packaged(name) => What::Packaged(name),
        };
        let archive = self.archive(&shop, &base, progress).await?;
        if let What::Tree(pushed) = &what {
            // What nothing provides is said now, not after minutes of preparations.
            let own = pushed::names(pushed.packages());
            let mut asked = pushed::asked(pushed.packages());
            if matches!(pushed, Pushed::Installed(_)) {
                asked.build.clear();
            }
            keys::resolve(&archive, &base, &request.map, &own, &asked)?;
        }
        let (base_layer, archive) = self.base_layer(&shop, &base, archive, progress).await?;
        let log = self.config.logs_dir.join(format!("{}.log", request.id));
        let build = Build { shop, base, archive, base_layer, request, progress, log };
        let made = match what {
            What::Tree(Pushed::Source(workspace)) => source::build(&build, workspace).await?,
            What::Tree(Pushed::Installed(space)) => prebuilt::build(&build, space).await?,
            What::Packaged(name) => packaged::build(&build, name).await?,
        };
        build.finish(made, hold).await
    }

    async fn archive(&self, shop: &Workshop, base: &Base, progress: &Progress) -> Result<Arc<Archive>, Error> {
        let mut archives = self.archives.lock().await;
        if let Some(archive) = archives.get(&base.name)
            && archive.is_fresh()
        {
            return Ok(archive.clone());
        }
        let scratch = shop.site.directory("sources")?;
        let sources = sources::lines(&self.config.sources, base, &scratch).await?;
        let archive = Arc::new(Archive::open(&self.config.cache_dir, sources, false, progress).await?);
        archives.insert(base.name.clone(), archive.clone());
        Ok(archive)
    }

    async fn base_layer(
        &self,
        shop: &Workshop,
        base: &Base,
        archive: Arc<Archive>,
        progress: &Progress,
    ) -> Result<(Made, Arc<Archive>), Error> {
        let resolved = bootstrap::resolve(shop, &archive, base).await?;
        let key = bootstrap::key(base, &resolved);
        let _turn = shop.turns.take(&key).await;
        if let Some(entry) = shop.cached(&key).await? {
            return Ok((Made { layer: entry.layer, cached: true }, archive));
        }
        let entry = bootstrap::make(shop, base, &archive.sources, progress).await?;
        let made = Made { layer: entry.layer, cached: false };
        let present: BTreeSet<&String> = entry.made_from.iter().collect();
        let all_there = resolved.iter().all(|deb| present.contains(&deb.to_string()));
        shop.keep(&key, entry).await?;
        if all_there {
            return Ok((made, archive));
        }
        // The archive has moved on since the lists were fetched: fetch them, so that what is resolved from now on
        // fits, and know the layer by what is in it.
        let archive =
            Arc::new(Archive::open(&self.config.cache_dir, archive.sources.clone(), true, progress).await?);
        self.archives.lock().await.insert(base.name.clone(), archive.clone());
        let resolved = bootstrap::resolve(shop, &archive, base).await?;
        if let Some(layer) = made.layer {
            let made_from = resolved.iter().map(Deb::to_string).collect();
            let entry = crate::cache::Entry { layer: Some(layer), made_from };
            shop.keep(&bootstrap::key(base, &resolved), entry).await?;
        }
        Ok((made, archive))
    }
}

impl Build<'_> {
    /// The base layer alone, as what others are put on.
    pub(crate) fn on_base(&self) -> Vec<LayerInfo> {
        self.base_layer.layer.into_iter().collect()
    }

    /// A layer with these Debian packages, and what they need, on top of `below`.
    pub(crate) async fn add(
        &self,
        name: &'static str,
        below: &[LayerInfo],
        packages: &BTreeSet<String>,
        extras: Vec<crate::deb::Member>,
    ) -> Result<Made, Error> {
        let debs = self.resolve(below, packages).await?;
        let addition = Addition { name, below, debs, extras };
        install::layer(&self.shop, &self.archive, &self.base, addition, self.progress).await
    }

    /// What is to be installed on top of `below`. Remembered: apt takes seconds.
    async fn resolve(&self, below: &[LayerInfo], packages: &BTreeSet<String>) -> Result<Vec<Deb>, Error> {
        if packages.is_empty() {
            return Ok(Vec::new());
        }
        let key = Key::new("resolved")
            .with("archive", &self.archive.stamp)
            .with_all("below", below.iter().map(|layer| layer.diff_id.to_string()))
            .with_all("package", packages)
            .finish();
        if let Some(debs) = self.shop.layers.note(&key) {
            return Ok(debs);
        }
        let trees = self.shop.extracted(below).await?;
        let status = trees.iter().rev().map(|tree| tree.join("var/lib/dpkg/status")).find(|path| path.is_file());
        let debs = self.archive.apt.resolve(status.as_deref(), packages).await?;
        self.shop.layers.keep_note(&key, &debs)?;
        Ok(debs)
    }

    /// Names given with `--with`: ROS packages first, then Debian ones.
    pub(crate) fn extra_packages(&self) -> Result<(BTreeSet<String>, BTreeSet<String>), Error> {
        let (mut ros, mut debs) = (BTreeSet::new(), BTreeSet::new());
        let mut missing = Vec::new();
        for name in &self.request.with {
            if !self.archive.contents.ros_package(name).is_empty() {
                ros.insert(name.clone());
            } else if self.archive.names.contains(name) {
                ros.extend(self.archive.contents.ros_packages_in(name).into_iter().map(str::to_owned));
                debs.insert(name.clone());
            } else {
                missing.push(crate::error::Unresolved {
                    key: name.clone(),
                    wanted_by: vec!["--with".into()],
                    similar: self.archive.similar(name),
                });
            }
        }
        if missing.is_empty() { Ok((ros, debs)) } else { Err(Error::Unresolved(missing)) }
    }

    /// Resolves what to run and writes the image.
    async fn finish(self, made: Parts, hold: image::Hold) -> Result<BuildOutcome, Error> {
        let mut layers = Vec::new();
        let parts = [("base", Some(&self.base_layer)), ("dependencies", Some(&made.dependencies)), ("package", made.package.as_ref())];
        for (name, part) in parts {
            if let Some(Made { layer: Some(info), cached }) = part {
                layers.push(BuiltLayer { name, info: *info, cached: *cached });
            }
        }
        let infos: Vec<LayerInfo> = layers.iter().map(|layer| layer.info).collect();
        let trees = self.shop.extracted(&infos).await?;
        self.progress.step("resolving what to run").await;
        let request = self.request;
        let ask = Ask {
            packages: made.packages.clone(),
            prefix: made.prefix.as_deref().map_or_else(String::new, |prefix| prefix.display().to_string()),
            launch: request.launch.clone().unwrap_or_default(),
            nodes: request.nodes.clone(),
            args: request.args.clone(),
            remaps: request.remaps.clone(),
            params: request.params.clone(),
        };
        let answer = launch::ask(&self.shop, trees.clone(), self.base.environment.clone(), &ask).await?;
        for warning in &answer.warnings {
            self.progress.warn(warning.as_str()).await;
        }
        let mut environment = self.base.environment.clone();
        environment.extend(answer.environment);
        // Where it works is made when it is run.
        for name in ["HOME", "ROS_LOG_DIR", "ROS_HOME", "ROS_MASTER_URI", "ROS_HOSTNAME"] {
            environment.remove(name);
        }
        let shares = pushed::shares(made.prefix.as_deref());
        let definitions =
            tokio::task::spawn_blocking(move || package::definitions::read(&trees, &shares)).await??;
        let package = made.packages.first().cloned().unwrap_or_default();
        let spec = ImageSpec {
            layers: infos,
            env: environment.clone(),
            labels: BTreeMap::from([
                ("org.cloudroid.package".to_owned(), package.clone()),
                ("org.cloudroid.base".to_owned(), self.base.name.clone()),
            ]),
            annotations: BTreeMap::from([
                ("org.opencontainers.image.title".to_owned(), package.clone()),
                ("org.opencontainers.image.version".to_owned(), made.version.clone()),
            ]),
            ..ImageSpec::default()
        };
        let store = self.shop.layers.store().clone();
        let image = tokio::task::spawn_blocking(move || store.put_image(&spec)).await??;
        // A log that tells of no failure is of no use to anyone.
        let _ = fs::remove_file(&self.log);
        Ok(BuildOutcome {
            package,
            version: made.version,
            base: self.base.name.clone(),
            image,
            layers,
            environment,
            plan: LaunchPlan { nodes: answer.nodes, parameters: answer.parameters },
            definitions,
            hold,
        })
    }
}
