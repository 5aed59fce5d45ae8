//! From a push to an image: which layers, in which order, from the cache or made now.

use std::collections::{BTreeSet, HashMap};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{Digest, Store};
use package::foreseen;
use package::workspace::{Pushed, Workspace};
use ros::flavour::Version;
use servant::sandbox::Sandbox;
use servant::spec::Limits;
use tokio::sync::mpsc;

use crate::apt::{Deb, Sources};
use crate::archive::Archive;
use crate::base::{self, Base};
use crate::bootstrap;
use crate::build::Build;
use crate::cache::{Entry, Layers};
use crate::error::{Error, IoAt};
use crate::event::{BuildEvent, Progress};
use crate::indexed::Indexed;
use crate::install::Made;
use crate::removal::Removals;
use crate::request::{BuildOutcome, PushRequest, Source};
use crate::sandbox::{self, Site};
use crate::workshop::{Push, Turns, Workshop};
use crate::{
    advice, blocking, choice, keys, launch, packaged, prebuilt, pushed, seal, source, sources,
    unused, wheels,
};

/// The base taken when none is named, for what can be built for ROS 1.
pub const DEFAULT_BASE: &str = "bookworm-ros1";

/// Logs of failed builds that are kept.
const LOGS_KEPT: usize = 50;

/// What a builder works with.
#[derive(Clone)]
pub struct Config {
    /// Shared between daemons: layers, downloaded packages, lists.
    pub cache_dir: PathBuf,
    /// Bytes of layers and packages in it; beyond them those are removed that were not used for longest.
    pub cache_bytes: u64,
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
    /// What runs programs of builds.
    pub sandbox: Arc<dyn Sandbox>,
    /// Limits of each sandbox. By default half of the machine's memory, 4096 processes and threads, and the cores that
    /// servants leave.
    pub limits: Limits,
}

/// Makes images. Cheap to share in an `Arc`; several builds may run at once.
pub struct Builder {
    config: Config,
    layers: Layers,
    turns: Turns,
    removals: Removals,
    archives: tokio::sync::Mutex<HashMap<String, Opened>>,
}

/// A base with its archive, as the last push found them.
struct Opened {
    base: Base,
    archive: Arc<Archive>,
}

/// Where the layers to keep for a base are noted.
pub(crate) fn kept(base: &str) -> String {
    format!("keep-{base}")
}

enum What<'a> {
    Tree(Pushed),
    Packaged(&'a str),
}

impl What<'_> {
    /// The package that it is about, as far as that shows.
    fn name(&self) -> String {
        match self {
            Self::Tree(pushed) => {
                let packages = pushed::by_importance(pushed.packages());
                packages.into_iter().next().unwrap_or_default()
            }
            Self::Packaged(name) => (*name).to_owned(),
        }
    }
}

impl Opened {
    fn of(base: &Base, archive: &Arc<Archive>) -> Self {
        Self {
            base: base.clone(),
            archive: archive.clone(),
        }
    }
}

impl Builder {
    /// Prepares the cache.
    pub fn new(config: Config) -> Result<Self, Error> {
        for path in [&config.cache_dir, &config.build_dir, &config.logs_dir] {
            fs::create_dir_all(path).at("making", path)?;
        }
        let layers = Layers::new(&config.cache_dir, config.store.clone())?;
        Ok(Self {
            config,
            layers,
            turns: Turns::default(),
            removals: Removals::default(),
            archives: Default::default(),
        })
    }

    /// Makes the image of a push. To cancel, drop the future: containers and blocking work are ended and the build's
    /// directory is removed ([`Builder::removed`]). Nothing is tagged, so a failed build changes nothing for anyone.
    pub async fn build(
        &self,
        request: &PushRequest,
        events: mpsc::Sender<BuildEvent>,
    ) -> Result<BuildOutcome, Error> {
        blocking::cancellable(self.make(request, events)).await
    }

    /// Where layers and packages are kept.
    pub fn cache_dir(&self) -> &Path {
        &self.config.cache_dir
    }

    /// Returns when the containers of a build have ended and its directory is removed.
    pub async fn removed(&self, id: &str) {
        self.removals.done(id).await;
    }

    async fn make(
        &self,
        request: &PushRequest,
        events: mpsc::Sender<BuildEvent>,
    ) -> Result<BuildOutcome, Error> {
        let progress = &Progress::new(events);
        let store = self.config.store.clone();
        let hold = blocking::spawn(move || store.hold()).await??;
        let choice::Chosen { base, note } = privilege::reading(|| {
            choice::choose(
                &self.config.bases_dir,
                request.base.as_deref(),
                &request.source,
            )
        })?;
        if let Some(note) = note {
            progress.warn(note).await;
        }
        let site = Site::new(
            &self.config.build_dir,
            &request.id,
            self.config.sandbox.clone(),
            self.config.limits.or(&sandbox::default_limits()),
            self.removals.clone(),
        )?;
        // Before anything is downloaded: what was pushed may not be a package at all.
        let what = match &request.source {
            Source::Tree(path) => {
                let pushed = privilege::reading(|| pushed::inspect(path, &base))?;
                if let Pushed::Source(workspace) = &pushed {
                    ask_what_to_run(request, workspace, &base)?;
                    let tree = path.clone();
                    blocking::spawn(move || seal::seal(&tree)).await??;
                }
                What::Tree(pushed)
            }
            Source::Packaged(name) => What::Packaged(name),
        };
        let push = Push {
            id: request.id.clone(),
            name: request.name.clone().unwrap_or_else(|| what.name()),
        };
        let shop = Workshop::new(
            site,
            self.layers.clone(),
            self.turns.clone(),
            push,
            progress.clone(),
        );
        let archive = self.archive(&shop, &base, progress).await?;
        match &what {
            What::Tree(pushed) => early(&archive, &base, request, pushed)?,
            What::Packaged(_) => drop(keys::mapped(&archive, &base, &request.map)?),
        }
        let (base_layer, archive) = self.base_layer(&shop, &base, archive, progress).await?;
        let base_layer = wheels::on_base(&shop, &base, base_layer, progress).await?;
        let log = self.config.logs_dir.join(format!("{}.log", request.id));
        let build = Build {
            shop,
            base,
            archive,
            base_layer,
            request,
            progress,
            log,
        };
        sweep_logs(&self.config.logs_dir);
        let cache = self.config.cache_dir.clone();
        let swept = cache.clone();
        blocking::spawn(move || unused::sweep(&swept)).await?;
        let work = async {
            let made = match what {
                What::Tree(Pushed::Source(workspace)) => source::build(&build, workspace).await?,
                What::Tree(Pushed::Installed(space)) => prebuilt::build(&build, space).await?,
                What::Packaged(name) => packaged::build(&build, name).await?,
            };
            build.finish(made, hold).await
        };
        let outcome = work.await;
        // What was installed and compiled before something failed is not lost: the next push begins there.
        let settled = build.shop.settled().await;
        // A failed build leaves as much in the cache.
        let most = self.config.cache_bytes;
        blocking::spawn(move || unused::shrink(&cache, most)).await?;
        let outcome = outcome?;
        settled?;
        Ok(outcome)
    }

    /// Finds in `words`, output of a node of an image on this base, what is missing, and the options of `push` that add it.
    /// Empty if the output names nothing missing.
    pub async fn advice(&self, base: &str, words: &str) -> Vec<String> {
        // Nothing is read here: whoever asks may have no right to.
        let archives = self.archives.lock().await;
        match archives.get(base) {
            Some(Opened { base, archive }) => {
                advice::for_words(words, advice::Known::of(archive, base))
            }
            None => Vec::new(),
        }
    }

    /// Layers that no image needs and the next build will: bases and toolchains, by diff-id. For the store's garbage
    /// collector to keep; without them they are imported from the cache again.
    pub fn keep(&self) -> BTreeSet<Digest> {
        let names = base::names(&self.config.bases_dir).unwrap_or_default();
        let notes = names
            .iter()
            .filter_map(|name| self.layers.note::<Vec<Digest>>(&kept(name)));
        notes.flatten().collect()
    }

    async fn archive(
        &self,
        shop: &Workshop,
        base: &Base,
        progress: &Progress,
    ) -> Result<Arc<Archive>, Error> {
        let mut archives = self.archives.lock().await;
        if let Some(opened) = archives.get_mut(&base.name)
            && opened.archive.is_fresh()
        {
            opened.base = base.clone();
            return Ok(opened.archive.clone());
        }
        let scratch = shop.site.directory("sources")?;
        let sources = sources::lines(&self.config.sources, base, &scratch).await?;
        let archive =
            Arc::new(Archive::open(&self.config.cache_dir, sources, false, progress).await?);
        archives.insert(base.name.clone(), Opened::of(base, &archive));
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
        let _turn = shop.turn(&key).await;
        if let Some(entry) = shop.cached(&key).await? {
            return Ok((made_of(&entry, true), archive));
        }
        let entry = bootstrap::make(shop, base, &archive.sources, progress).await?;
        let (made, layer) = (made_of(&entry, false), entry.layer);
        let present: BTreeSet<&String> = entry.made_from.iter().collect();
        let all_there = resolved
            .iter()
            .all(|deb| present.contains(&deb.to_string()));
        shop.keep(&key, entry).await?;
        if all_there {
            return Ok((made, archive));
        }
        // The archive has moved on since the lists were fetched: fetch them, so that what is resolved from now on
        // fits, and know the layer by what is in it.
        let archive = Arc::new(
            Archive::open(
                &self.config.cache_dir,
                archive.sources.clone(),
                true,
                progress,
            )
            .await?,
        );
        self.archives
            .lock()
            .await
            .insert(base.name.clone(), Opened::of(base, &archive));
        let resolved = bootstrap::resolve(shop, &archive, base).await?;
        if let Some(layer) = layer {
            let made_from = resolved.iter().map(Deb::to_string).collect();
            let entry = Entry {
                layer: Some(layer),
                made_from,
            };
            shop.keep(&bootstrap::key(base, &resolved), entry).await?;
        }
        Ok((made, archive))
    }
}

/// Asks what to run before time is spent on compiling, where the sources show that it will have to be asked. Blocking.
fn ask_what_to_run(request: &PushRequest, workspace: &Workspace, base: &Base) -> Result<(), Error> {
    if request.launch.is_some() || !request.nodes.is_empty() {
        return Ok(());
    }
    let foreseen = privilege::reading(|| foreseen::foresee(workspace, base.ros.bus()));
    if !foreseen.must_be_chosen() {
        return Ok(());
    }
    Err(Error::NothingToRun {
        executables: launch::list(&foreseen.executables),
        launch_files: launch::list(&foreseen.launch_files),
        more: "; nothing is compiled yet, so there may be others",
    })
}

/// Says what nothing provides now, and not after minutes of preparations. Of ROS 2 much may be in a base that is not made
/// yet: there it is said once that can be looked at.
fn early(
    archive: &Archive,
    base: &Base,
    request: &PushRequest,
    pushed: &Pushed,
) -> Result<(), Error> {
    if base.ros != Version::Ros1 {
        return Ok(());
    }
    let own = pushed::names(pushed.packages());
    let mut asked = pushed::asked(pushed.packages());
    if matches!(pushed, Pushed::Installed(_)) {
        asked.build.clear();
    }
    let there = Indexed::default();
    keys::resolve(archive, base, &request.map, &own, &asked, &there)?;
    Ok(())
}

fn made_of(entry: &Entry, cached: bool) -> Made {
    let layer = entry.layer.map(|layer| Made::one(layer.diff_id, cached));
    layer.unwrap_or_default()
}

/// Keeps the newest logs. Best effort: a log too many hurts nobody.
fn sweep_logs(directory: &Path) {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    let mut logs: Vec<_> = entries
        .filter(|entry| {
            entry
                .path()
                .extension()
                .is_some_and(|extension| extension == "log")
        })
        .filter_map(|entry| Some((entry.metadata().ok()?.modified().ok()?, entry.path())))
        .collect();
    logs.sort();
    for (_, path) in logs.iter().rev().skip(LOGS_KEPT) {
        let _ = fs::remove_file(path);
    }
}

#[cfg(test)]
mod tests {
    use async_trait::async_trait;
    use servant::container::ContainerSpec;
    use servant::sandbox::Sandboxed;

    use super::*;

    /// No container is to be started.
    struct Unasked;

    #[async_trait]
    impl Sandbox for Unasked {
        async fn sandbox(&self, spec: ContainerSpec) -> Result<Sandboxed, servant::Error> {
            panic!("container {} is started", spec.id)
        }
    }

    #[tokio::test]
    async fn what_is_no_package_is_refused_before_anything_is_made_for_it() {
        let place = tempfile::tempdir().expect("a directory");
        let at = |name: &str| place.path().join(name);
        let store = Store::open(&at("images"), &at("layers")).expect("a store");
        let builder = Builder::new(Config {
            cache_dir: at("cache"),
            cache_bytes: u64::MAX,
            bases_dir: Path::new(env!("CARGO_MANIFEST_DIR")).join("../images"),
            build_dir: at("build"),
            logs_dir: at("logs"),
            sources: Sources::default(),
            store: Arc::new(store),
            sandbox: Arc::new(Unasked),
            limits: Limits::default(),
        })
        .expect("prepared");
        let trees = [
            &[][..],
            &["README", "notes/todo.txt"],
            &["src/node.py", "launch/it.launch"],
            &["install/setup.sh", "install/.catkin"],
            &["setup.sh", ".catkin", "lib/p/node"],
        ];
        for (number, files) in trees.iter().enumerate() {
            for base in [None, Some(DEFAULT_BASE), Some("noble-jazzy")] {
                let tree = at(&format!("pushed-{number}-{}", base.unwrap_or("any")));
                for file in *files {
                    let file = tree.join(file);
                    fs::create_dir_all(file.parent().expect("one")).expect("made");
                    fs::write(file, "").expect("written");
                }
                fs::create_dir_all(&tree).expect("made");
                let request = PushRequest {
                    id: "p1".to_owned(),
                    source: Source::Tree(tree),
                    base: base.map(str::to_owned),
                    ..PushRequest::default()
                };
                let (sender, mut events) = mpsc::channel(100);
                let refused = builder
                    .build(&request, sender)
                    .await
                    .expect_err("no package");
                let text = refused.to_string();
                assert!(text.contains("package.xml"), "{files:?} {base:?}: {text}");
                assert_eq!(events.recv().await, None, "nothing is begun");
                let made = fs::read_dir(at("build")).expect("listed").count();
                assert_eq!(made, 0, "{files:?} {base:?}");
            }
        }
    }

    #[test]
    fn only_the_newest_logs_are_kept() {
        let directory = tempfile::tempdir().expect("a directory");
        for number in 0..LOGS_KEPT + 3 {
            let path = directory.path().join(format!("{number}.log"));
            let file = fs::File::create(path).expect("made");
            let time = std::time::UNIX_EPOCH + std::time::Duration::from_secs(number as u64);
            file.set_modified(time).expect("set");
        }
        fs::write(directory.path().join("other.txt"), "").expect("written");
        sweep_logs(directory.path());
        let left = fs::read_dir(directory.path()).expect("listed").count();
        assert_eq!(left, LOGS_KEPT + 1);
        assert!(
            !directory.path().join("2.log").exists() && directory.path().join("3.log").exists()
        );
    }
}
