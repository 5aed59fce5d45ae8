//! The build pipeline from a push to an image: which layers, in which order, from the cache or built now.

use std::collections::{BTreeSet, HashMap};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{Digest, Store};
use package::workspace::PushedDirectory;
use servant::sandbox::Sandbox;
use servant::spec::Limits;
use tokio::sync::mpsc;

use crate::apt::Sources;
use crate::archive::Archive;
use crate::base::{self, Base};
use crate::bootstrap;
use crate::build::Build;
use crate::cache::{LayerCache, LayerEntry, keep_note_key};
use crate::debian_package::Deb;
use crate::error::{Error, IoContext};
use crate::event::{BuildEvent, Progress};
use crate::inspect::{InspectedPush, PushContent};
use crate::install::LayerSet;
use crate::removal::PendingRemovals;
use crate::request::{BuildResult, PushRequest, PushSource};
use crate::sandbox::{self, BuildSite};
use crate::stock::BaseStock;
use crate::workshop::{BuildContext, KeyLocks, PushLabel};
use crate::{advice, blocking, cache_cleanup, packaged, prebuilt, seal, source, sources, stock, wheels};

/// Maximum number of logs of failed builds.
const MAX_LOGS: usize = 50;

/// Configuration of a builder.
#[derive(Clone)]
pub struct Config {
    /// Cache shared between daemons: layers, downloaded packages, lists.
    pub cache_dir: PathBuf,
    /// Maximum size of the layers and packages in the cache; those not used for longest are removed first.
    pub cache_bytes: u64,
    /// Directory of the base definitions.
    pub bases_dir: PathBuf,
    /// Directory of the definitions of bases that were made from images, which are in the other one, too; outlives it.
    pub imported_dir: PathBuf,
    /// Work directory, with a directory per build; cleaned up by the caller that starts the daemon.
    pub build_dir: PathBuf,
    /// Directory of the complete build logs.
    pub logs_dir: PathBuf,
    /// Package sources.
    pub sources: Sources,
    /// Image store.
    pub store: Arc<Store>,
    /// Runs the programs of builds.
    pub sandbox: Arc<dyn Sandbox>,
    /// Limits of each sandbox (default: half of the machine's memory, 4096 processes and threads, and the cores that
    /// servants leave idle).
    pub limits: Limits,
}

/// Builds images. Cheap to share in an `Arc`; several builds may run concurrently.
pub struct Builder {
    config: Config,
    layers: LayerCache,
    turns: KeyLocks,
    removals: PendingRemovals,
    archives: tokio::sync::Mutex<HashMap<String, OpenedArchive>>,
}

/// A base with its archive, as of the last push.
struct OpenedArchive {
    base: Base,
    archive: Arc<Archive>,
}

impl OpenedArchive {
    fn from_parts(base: &Base, archive: &Arc<Archive>) -> Self {
        Self { base: base.clone(), archive: archive.clone() }
    }
}

impl Builder {
    /// Prepares the cache.
    pub fn new(config: Config) -> Result<Self, Error> {
        for path in [&config.cache_dir, &config.build_dir, &config.logs_dir] {
            fs::create_dir_all(path).io_context("making", path)?;
        }
        let layers = LayerCache::new(&config.cache_dir, config.store.clone())?;
        Ok(Self {
            config,
            layers,
            turns: KeyLocks::default(),
            removals: PendingRemovals::default(),
            archives: Default::default(),
        })
    }

    /// Builds the image of a push, or an underlay. To cancel, drop the future: containers and blocking work are ended,
    /// what was compiled or installed completely is still packed into the cache, and the build's directory is removed
    /// ([`Builder::wait_removed`]). Nothing is tagged, so a failed build has no effect on anyone.
    pub async fn build(
        &self,
        request: &PushRequest,
        inspected: InspectedPush,
        events: mpsc::Sender<BuildEvent>,
    ) -> Result<BuildResult, Error> {
        blocking::cancellable(self.make(request, inspected, events)).await
    }

    /// Returns the directory of layers and packages.
    pub fn cache_dir(&self) -> &Path {
        &self.config.cache_dir
    }

    /// Returns the cache of layers.
    pub(crate) fn layers(&self) -> &LayerCache {
        &self.layers
    }

    /// Returns the directory of the base definitions.
    pub(crate) fn bases_dir(&self) -> &Path {
        &self.config.bases_dir
    }

    /// Returns the directory that keeps the definitions of bases that were made from images.
    pub(crate) fn imported_dir(&self) -> &Path {
        &self.config.imported_dir
    }

    /// Returns the work directory.
    pub(crate) fn build_dir(&self) -> &Path {
        &self.config.build_dir
    }

    /// Gives up the packing that cancelled builds have left, since the daemon ends.
    pub fn stop_packing(&self) {
        self.layers.packings().give_up_all();
    }

    /// Gives up the packing that a cancelled build has left, since there is no room for it.
    pub fn give_up_packing(&self, id: &str) {
        self.layers.packings().give_up(id);
    }

    /// Waits until the containers of a build have ended, its complete layers are in the cache, and its directory is
    /// removed.
    pub async fn wait_removed(&self, id: &str) {
        self.removals.wait(id).await;
        self.layers.packings().forget(id);
    }

    async fn make(
        &self,
        request: &PushRequest,
        inspected: InspectedPush,
        events: mpsc::Sender<BuildEvent>,
    ) -> Result<BuildResult, Error> {
        let progress = &Progress::new(events);
        let store = self.config.store.clone();
        let hold = blocking::spawn(move || store.hold()).await??;
        let site = BuildSite::new(
            &self.config.build_dir,
            &request.id,
            self.config.sandbox.clone(),
            self.config.limits.or(sandbox::default_limits()),
            self.removals.clone(),
        )?;
        let push = inspected.label(request);
        let InspectedPush { base, content, foundation } = inspected;
        if let (PushContent::Tree(PushedDirectory::Source(_)), PushSource::Tree(tree)) = (&content, &request.source) {
            let tree = tree.clone();
            blocking::spawn(move || seal::seal(&tree)).await??;
        }
        let archive = self.archive(&push, &base, progress).await?;
        let shop = BuildContext::new(site, self.layers.clone(), self.turns.clone(), push, progress.clone());
        let (layers, of) = (self.layers.clone(), base.clone());
        let imported = blocking::spawn(move || stock::find_imported(&layers, &of)).await??;
        let (base_layer, archive) = match &imported {
            Some(stock) => (stock.layer_set(), archive),
            None => {
                let (layer, archive) = self.base_layer(&shop, &base, archive, progress).await?;
                (wheels::add_runtime_wheels(&shop, &base, layer, progress).await?, archive)
            }
        };
        let tools = imported.as_ref().and_then(BaseStock::tool_layers);
        let log = self.config.logs_dir.join(format!("{}.log", request.id));
        let base = base.with_cmake_arguments(&request.cmake_args);
        let build = Build { shop, base, archive, base_layer, foundation, tools, request, progress, log };
        sweep_logs(&self.config.logs_dir);
        let cache = self.config.cache_dir.clone();
        let swept = cache.clone();
        blocking::spawn(move || cache_cleanup::sweep(&swept)).await?;
        let work = async {
            let made = match content {
                PushContent::Tree(PushedDirectory::Source(workspace)) => source::build(&build, workspace).await?,
                PushContent::Tree(PushedDirectory::Installed(space)) => prebuilt::build(&build, space).await?,
                PushContent::Packaged(name) => packaged::build(&build, &name).await?,
            };
            match made.contents {
                Some(_) => build.finish_underlay(made, hold).await.map(|made| BuildResult::Underlay(Box::new(made))),
                None => build.finish(made, hold).await.map(|made| BuildResult::Service(Box::new(made))),
            }
        };
        let outcome = work.await;
        // What was installed and compiled before a failure is kept: the next push continues there.
        let settled = build.shop.wait_until_packed().await;
        if settled.is_ok()
            && imported.is_none()
            && let Err(error) = stock::record(&build).await
        {
            tracing::warn!("cannot record what base {} has: {error}", build.base.name);
        }
        // A failed build also fills the cache.
        let most = self.config.cache_bytes;
        blocking::spawn(move || cache_cleanup::shrink(&cache, most)).await?;
        let outcome = outcome?;
        settled?;
        Ok(outcome)
    }

    /// Finds missing dependencies in `words`, output of a node of an image on this base, and returns the `push` options
    /// that add them. Empty if there are none.
    pub async fn advice(&self, base: &str, words: &str) -> Vec<String> {
        // Nothing is read from disk, since the caller may not be allowed to.
        let archives = self.archives.lock().await;
        match archives.get(base) {
            Some(OpenedArchive { base, archive }) => {
                advice::advise_for_output(words, advice::AdviceIndex::for_base(archive, base))
            }
            None => Vec::new(),
        }
    }

    /// Returns the layers that no image needs but the next build will, by diff-id: bases and toolchains. To be kept by
    /// the store's garbage collector; otherwise they are imported from the cache again, but for those of bases that
    /// were made from images, which only the store has.
    pub fn layers_to_keep(&self) -> BTreeSet<Digest> {
        let names = base::names(&self.config.bases_dir).unwrap_or_default();
        let notes = names.iter().filter_map(|name| self.layers.read_note::<Vec<Digest>>(&keep_note_key(name)));
        notes.flatten().chain(base::image_layers(&self.config.bases_dir)).collect()
    }

    /// Returns the archive of a base for a push, which reads the package lists if they are old.
    pub(crate) async fn archive(
        &self,
        push: &PushLabel,
        base: &Base,
        progress: &Progress,
    ) -> Result<Arc<Archive>, Error> {
        // Opening may take minutes: whoever waits is told for whom. Advice and other bases do not wait.
        let _turn = self.turns.lock(&format!("archive of {}", base.name), push, progress).await;
        if let Some(opened) = self.archives.lock().await.get_mut(&base.name)
            && opened.archive.is_fresh()
            && opened.base.image == base.image
        {
            opened.base = base.clone();
            return Ok(opened.archive.clone());
        }
        progress.step(&format!("reading the package lists of {}", base.name)).await;
        let scratch = sandbox::create_build_directory(&self.config.build_dir, &push.id)?.join("sources");
        fs::create_dir_all(&scratch).io_context("making", &scratch)?;
        let opened = async {
            if base.image.as_ref().is_some_and(|image| image.debian.is_empty()) {
                return Err(Error::NoDpkg);
            }
            let sources = sources::source_lines(&self.config.sources, base, &scratch).await?;
            Archive::open(&self.config.cache_dir, sources, false, progress).await
        };
        let archive = match opened.await {
            Ok(archive) => archive,
            Err(error) => {
                let (layers, of) = (self.layers.clone(), base.clone());
                let index = blocking::spawn(move || stock::open_index(&layers, &of)).await??;
                let Some(archive) = index else {
                    return Err(error);
                };
                let words = format!("only packages of the imported base {} can be used now: {error}", base.name);
                progress.warn(words).await;
                archive
            }
        };
        let archive = match &base.image {
            Some(image) => archive.with_installed(image),
            None => archive,
        };
        let archive = Arc::new(archive);
        self.archives.lock().await.insert(base.name.clone(), OpenedArchive::from_parts(base, &archive));
        Ok(archive)
    }

    async fn base_layer(
        &self,
        shop: &BuildContext,
        base: &Base,
        archive: Arc<Archive>,
        progress: &Progress,
    ) -> Result<(LayerSet, Arc<Archive>), Error> {
        let resolved = bootstrap::resolve_base(shop, &archive, base).await?;
        let key = bootstrap::base_key(base, &resolved);
        let _turn = shop.lock_key(&key).await;
        if let Some(entry) = shop.get_cached(&key).await? {
            return Ok((to_layer_set(&entry, true), archive));
        }
        let entry = bootstrap::make_base_layer(shop, base, &archive.sources, progress).await?;
        let (made, layer) = (to_layer_set(&entry, false), entry.layer);
        let present: BTreeSet<&String> = entry.made_from.iter().collect();
        let all_there = resolved.iter().all(|deb| present.contains(&deb.to_string()));
        shop.put_cached(&key, entry).await?;
        if all_there {
            return Ok((made, archive));
        }
        // The archive has changed since the lists were fetched: fetch them again, so that what is resolved from now on
        // is consistent, and store the layer under what it contains.
        let archive = Arc::new(Archive::open(&self.config.cache_dir, archive.sources.clone(), true, progress).await?);
        self.archives.lock().await.insert(base.name.clone(), OpenedArchive::from_parts(base, &archive));
        let resolved = bootstrap::resolve_base(shop, &archive, base).await?;
        if let Some(layer) = layer {
            let made_from = resolved.iter().map(Deb::to_string).collect();
            let entry = LayerEntry { layer: Some(layer), made_from };
            shop.put_cached(&bootstrap::base_key(base, &resolved), entry).await?;
        }
        Ok((made, archive))
    }
}

fn to_layer_set(entry: &LayerEntry, cached: bool) -> LayerSet {
    let layer = entry.layer.map(|layer| LayerSet::single(layer.diff_id, cached));
    layer.unwrap_or_default()
}

/// Keeps the latest logs. Best effort: an extra log does no harm.
fn sweep_logs(directory: &Path) {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    let mut logs: Vec<_> = entries
        .filter(|entry| entry.path().extension().is_some_and(|extension| extension == "log"))
        .filter_map(|entry| Some((entry.metadata().ok()?.modified().ok()?, entry.path())))
        .collect();
    logs.sort();
    for (_, path) in logs.iter().rev().skip(MAX_LOGS) {
        let _ = fs::remove_file(path);
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use async_trait::async_trait;
    use servant::container::ContainerSpec;
    use servant::sandbox::SandboxContainer;

    use super::*;
    use crate::base::DEFAULT_BASE;

    /// A sandbox that must not be used.
    struct UnusedSandbox;

    #[async_trait]
    impl Sandbox for UnusedSandbox {
        async fn start_sandbox(&self, spec: ContainerSpec) -> Result<SandboxContainer, servant::Error> {
            panic!("container {} is started", spec.id)
        }
    }

    /// Creates a builder with the repository's bases, whose files are below `place` and which runs nothing.
    pub(crate) fn new_builder(place: &Path) -> Builder {
        new_builder_with(place, Path::new(env!("CARGO_MANIFEST_DIR")).join("../images"))
    }

    /// Creates a builder with the bases in a directory, whose files are below `place` and which runs nothing.
    pub(crate) fn new_builder_with(place: &Path, bases_dir: PathBuf) -> Builder {
        let at = |name: &str| place.join(name);
        let store = Store::open(&at("images"), &at("layers")).expect("a store");
        Builder::new(Config {
            cache_dir: at("cache"),
            cache_bytes: u64::MAX,
            bases_dir,
            imported_dir: at("imported"),
            build_dir: at("build"),
            logs_dir: at("logs"),
            sources: Sources::default(),
            store: Arc::new(store),
            sandbox: Arc::new(UnusedSandbox),
            limits: Limits::default(),
        })
        .expect("prepared")
    }

    /// Gives a base an archive with fresh lists: `contents` are the lines of its index, `names` its packages.
    pub(crate) async fn put_archive(
        builder: &Builder,
        base: &str,
        place: &Path,
        (contents, names): (&str, &[&str]),
    ) -> Arc<Archive> {
        let base = base::load(&builder.config.bases_dir, base).expect("valid");
        let root = place.join(format!("apt-{}", base.name));
        let apt = crate::apt::Apt::open(&root, "").expect("prepared");
        fs::write(root.join("updated"), "").expect("written");
        let lists = [crate::contents::tests::list(&root, "c.gz", contents)];
        let archive = Arc::new(Archive {
            apt,
            contents: crate::contents::Contents::open(&root, &lists).expect("read").into(),
            candidates: crate::candidates::tests::candidates_named(names),
            stamp: "today".to_owned(),
            sources: String::new(),
        });
        builder.archives.lock().await.insert(base.name.clone(), OpenedArchive::from_parts(&base, &archive));
        archive
    }

    /// Creates the context of a build that runs nothing.
    pub(crate) fn new_context(builder: &Builder, id: &str) -> BuildContext {
        let Config { build_dir, sandbox, limits, .. } = &builder.config;
        let site = BuildSite::new(build_dir, id, sandbox.clone(), *limits, builder.removals.clone()).expect("made");
        let progress = Progress::new(mpsc::channel(1).0);
        BuildContext::new(site, builder.layers.clone(), builder.turns.clone(), PushLabel::default(), progress)
    }

    #[tokio::test]
    async fn what_is_no_package_is_refused_before_anything_is_made_for_it() {
        let place = tempfile::tempdir().expect("a directory");
        let at = |name: &str| place.path().join(name);
        let builder = new_builder(place.path());
        let trees = [
            &[][..],
            &["README", "notes/todo.txt"],
            &["src/node.py", "launch/it.launch"],
            &["install/setup.sh", "install/.catkin"],
            &["setup.sh", ".catkin", "lib/p/node"],
        ];
        for (number, files) in trees.iter().enumerate() {
            for base in [None, Some(DEFAULT_BASE), Some("bookworm-jazzy-wheels")] {
                let tree = at(&format!("pushed-{number}-{}", base.unwrap_or("any")));
                for file in *files {
                    let file = tree.join(file);
                    fs::create_dir_all(file.parent().expect("one")).expect("made");
                    fs::write(file, "").expect("written");
                }
                fs::create_dir_all(&tree).expect("made");
                let request = PushRequest {
                    id: "p1".to_owned(),
                    source: PushSource::Tree(tree),
                    base: base.map(str::to_owned),
                    ..PushRequest::default()
                };
                let (sender, mut events) = mpsc::channel(100);
                let refused = builder.inspect(&request, sender).await.expect_err("no package");
                let text = refused.to_string();
                assert!(text.contains("package.xml"), "{files:?} {base:?}: {text}");
                assert_eq!(events.recv().await, None, "nothing is begun");
                let made = fs::read_dir(at("build")).expect("listed").count();
                assert_eq!(made, 0, "{files:?} {base:?}");
            }
        }
    }

    #[tokio::test]
    async fn a_missing_module_is_advised_without_reading_definitions() {
        let place = tempfile::tempdir().expect("a directory");
        let mut builder = new_builder(place.path());
        let text = "usr/lib/python3/dist-packages/scipy/__init__.py python/python3-scipy\n";
        for name in [DEFAULT_BASE, "bookworm-jazzy-wheels"] {
            put_archive(&builder, name, place.path(), (text, &["python3-scipy"])).await;
        }
        // A stranger's thread, which asks for the advice, can open nothing there.
        builder.config.bases_dir = place.path().join("unreadable");
        for name in [DEFAULT_BASE, "bookworm-jazzy-wheels"] {
            let advice = builder.advice(name, "ModuleNotFoundError: No module named 'scipy.linalg'").await;
            assert_eq!(advice, ["the Python module scipy is missing: push with `--with python3-scipy`"], "{name}");
        }
    }

    #[test]
    fn only_the_newest_logs_are_kept() {
        let directory = tempfile::tempdir().expect("a directory");
        for number in 0..MAX_LOGS + 3 {
            let path = directory.path().join(format!("{number}.log"));
            let file = fs::File::create(path).expect("made");
            let time = std::time::UNIX_EPOCH + std::time::Duration::from_secs(number as u64);
            file.set_modified(time).expect("set");
        }
        fs::write(directory.path().join("other.txt"), "").expect("written");
        sweep_logs(directory.path());
        let left = fs::read_dir(directory.path()).expect("listed").count();
        assert_eq!(left, MAX_LOGS + 1);
        assert!(!directory.path().join("2.log").exists() && directory.path().join("3.log").exists());
    }
}
