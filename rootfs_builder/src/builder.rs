//! The build pipeline from a push to an image: which layers, in which order, from the cache or built now.

use std::collections::{BTreeSet, HashMap};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{Digest, Store};
use package::foreseen::{self, SourceProblem};
use package::workspace::{PushedDirectory, Workspace};
use servant::sandbox::Sandbox;
use servant::spec::Limits;
use tokio::sync::mpsc;

use crate::apt::Sources;
use crate::archive::Archive;
use crate::base::{self, Base};
use crate::bootstrap;
use crate::build::Build;
use crate::cache::{LayerCache, LayerEntry};
use crate::debian_package::Deb;
use crate::error::{Error, IoContext};
use crate::event::{BuildEvent, Progress};
use crate::indexed::IndexedPackages;
use crate::install::LayerSet;
use crate::pushed::InspectedTree;
use crate::removal::PendingRemovals;
use crate::request::{BuildOutcome, PushRequest, PushSource};
use crate::sandbox::{self, BuildSite};
use crate::stock::BaseStock;
use crate::workshop::{BuildContext, KeyLocks, PushLabel};
use crate::{
    advice, blocking, choice, imported, keys, launch, packaged, prebuilt, pushed, seal, source, sources, stock, unused,
    wheels,
};

/// Default base for packages that support ROS 1.
pub const DEFAULT_BASE: &str = "bookworm-ros1";

/// Maximum number of logs of failed builds.
const LOGS_KEPT: usize = 50;

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

/// Returns the key of the note with the layers to keep for a base.
pub(crate) fn keep_note_key(base: &str) -> String {
    format!("keep-{base}")
}

enum PushContent<'a> {
    Tree(PushedDirectory),
    Packaged(&'a str),
}

impl PushContent<'_> {
    /// Returns the main package, as far as known.
    fn name(&self) -> String {
        match self {
            Self::Tree(pushed) => {
                let packages = pushed::sort_by_importance(pushed.packages());
                packages.into_iter().next().unwrap_or_default()
            }
            Self::Packaged(name) => (*name).to_owned(),
        }
    }
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

    /// Builds the image of a push. To cancel, drop the future: containers and blocking work are ended and the build's
    /// directory is removed ([`Builder::wait_removed`]). Nothing is tagged, so a failed build has no effect on anyone.
    pub async fn build(&self, request: &PushRequest, events: mpsc::Sender<BuildEvent>) -> Result<BuildOutcome, Error> {
        blocking::cancellable(self.make(request, events)).await
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

    /// Waits until the containers of a build have ended and its directory is removed.
    pub async fn wait_removed(&self, id: &str) {
        self.removals.wait(id).await;
    }

    async fn make(&self, request: &PushRequest, events: mpsc::Sender<BuildEvent>) -> Result<BuildOutcome, Error> {
        let progress = &Progress::new(events);
        let store = self.config.store.clone();
        let hold = blocking::spawn(move || store.hold()).await??;
        let asked = Arc::new(request.clone());
        let (bases, of) = (self.config.bases_dir.clone(), Arc::clone(&asked));
        let choice::ChosenBase { base, note } =
            blocking::spawn_reader(move || choice::choose_base(&bases, of.base.as_deref(), &of.source)).await??;
        if let Some(note) = note {
            progress.warn(note).await;
        }
        let site = BuildSite::new(
            &self.config.build_dir,
            &request.id,
            self.config.sandbox.clone(),
            self.config.limits.or(sandbox::default_limits()),
            self.removals.clone(),
        )?;
        // Before anything is downloaded: what was pushed may not be a package at all.
        let what = match &request.source {
            PushSource::Tree(path) => {
                let (tree, of, on) = (path.clone(), Arc::clone(&asked), base.clone());
                let inspect = move || pushed::inspect_pushed(&tree, &on, &of.package_query());
                let InspectedTree { mut pushed, left_out } = blocking::spawn_reader(inspect).await??;
                if let PushedDirectory::Source(workspace) = pushed {
                    tell_selection(&workspace, &left_out, progress).await;
                    let (of, on) = (Arc::clone(&asked), base.clone());
                    let read = move || {
                        ask_what_to_run(&of, &workspace, &on)?;
                        let problems = find_source_problems(&of, &workspace, &on)?;
                        Ok::<_, Error>((workspace, problems))
                    };
                    let (workspace, problems) = blocking::spawn_reader(read).await??;
                    for problem in problems.iter().take(MOST_PROBLEMS) {
                        progress.warn(problem.to_string()).await;
                    }
                    if problems.len() > MOST_PROBLEMS {
                        progress.warn(format!("{} more like these", problems.len() - MOST_PROBLEMS)).await;
                    }
                    let tree = path.clone();
                    blocking::spawn(move || seal::seal(&tree)).await??;
                    pushed = PushedDirectory::Source(workspace);
                }
                PushContent::Tree(pushed)
            }
            PushSource::Packaged(name) => PushContent::Packaged(name),
        };
        if !matches!(what, PushContent::Tree(PushedDirectory::Source(_))) && request.has_build_options() {
            return Err(Error::NothingToCompile);
        }
        let push = PushLabel { id: request.id.clone(), name: request.name.clone().unwrap_or_else(|| what.name()) };
        let shop = BuildContext::new(site, self.layers.clone(), self.turns.clone(), push, progress.clone());
        let archive = self.archive(&shop, &base, progress).await?;
        match &what {
            PushContent::Tree(pushed) => check_dependencies(&archive, &base, request, pushed)?,
            PushContent::Packaged(_) => drop(keys::mapped_packages(&archive, &base, &request.map)?),
        }
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
        let build = Build { shop, base, archive, base_layer, tools, request, progress, log };
        sweep_logs(&self.config.logs_dir);
        let cache = self.config.cache_dir.clone();
        let swept = cache.clone();
        blocking::spawn(move || unused::sweep(&swept)).await?;
        let work = async {
            let made = match what {
                PushContent::Tree(PushedDirectory::Source(workspace)) => source::build(&build, workspace).await?,
                PushContent::Tree(PushedDirectory::Installed(space)) => prebuilt::build(&build, space).await?,
                PushContent::Packaged(name) => packaged::build(&build, name).await?,
            };
            build.finish(made, hold).await
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
        blocking::spawn(move || unused::shrink(&cache, most)).await?;
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
        notes.flatten().chain(imported::image_layers(&self.config.bases_dir)).collect()
    }

    async fn archive(&self, shop: &BuildContext, base: &Base, progress: &Progress) -> Result<Arc<Archive>, Error> {
        // Opening may take minutes: whoever waits is told for whom.
        let _turn = shop.lock_key(&format!("archive of {}", base.name)).await;
        let mut archives = self.archives.lock().await;
        if let Some(opened) = archives.get_mut(&base.name)
            && opened.archive.is_fresh()
            && opened.base.image == base.image
        {
            opened.base = base.clone();
            return Ok(opened.archive.clone());
        }
        progress.step(&format!("reading the package lists of {}", base.name)).await;
        let scratch = shop.site.directory("sources")?;
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
        archives.insert(base.name.clone(), OpenedArchive::from_parts(base, &archive));
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

/// Fails before compiling if the sources show that the push must state what to run, or that there is no such launch
/// file. Blocking; reads what was pushed.
fn ask_what_to_run(request: &PushRequest, workspace: &Workspace, base: &Base) -> Result<(), Error> {
    let version = base.ros.ros_version();
    if let Some(launch) = &request.launch
        && foreseen::lacks_launch_file(workspace, launch, version)
    {
        let foreseen = foreseen::scan_sources(workspace, version);
        return Err(Error::NotInPackage {
            what: "launch file",
            name: launch.clone(),
            known: launch::join_names(&foreseen.launch_files),
            elsewhere: String::new(),
        });
    }
    if request.launch.is_some() || !request.nodes.is_empty() {
        return Ok(());
    }
    let foreseen = foreseen::scan_sources(workspace, version);
    if !foreseen.must_be_chosen() {
        return Ok(());
    }
    Err(Error::NothingToRun {
        executables: launch::join_names(&foreseen.executables),
        launch_files: launch::join_names(&foreseen.launch_files),
        more: "; nothing is compiled yet, so there may be more",
    })
}

/// Maximum number of mistakes in build files that are named.
const MOST_PROBLEMS: usize = 20;
/// Maximum number of packages that are named when they are not built.
const NAMED: usize = 12;

/// Tells which packages are not built.
async fn tell_selection(workspace: &Workspace, left_out: &[String], progress: &Progress) {
    if left_out.is_empty() {
        return;
    }
    let built = workspace.packages.len();
    let more = if left_out.len() > NAMED { ", …" } else { "" };
    let names = left_out[..left_out.len().min(NAMED)].join(", ");
    let all = built + left_out.len();
    progress.step(&format!("building {built} of {all} packages; not needed, or skipped: {names}{more}")).await;
}

/// Returns mistakes in build files; fails if no program is left because of them. Blocking; reads what was pushed.
fn find_source_problems(
    request: &PushRequest,
    workspace: &Workspace,
    base: &Base,
) -> Result<Vec<SourceProblem>, Error> {
    let version = base.ros.ros_version();
    let problems = foreseen::find_problems(workspace, version);
    let is_own = |node: &String| {
        let program = node.split_whitespace().next().unwrap_or_default();
        let package = program.split_once('/').map(|(package, _)| package);
        package.is_none_or(|package| workspace.packages.iter().any(|own| own.manifest.name == package))
    };
    let runs_own = request.launch.is_none() && request.nodes.iter().all(is_own);
    if runs_own && foreseen::has_no_programs(workspace, version) {
        let problems: Vec<String> = problems.iter().map(ToString::to_string).collect();
        return Err(Error::NoPrograms { problems: problems.join("; ") });
    }
    Ok(problems)
}

/// Reports unresolvable dependencies now and not after minutes of preparation. In install spaces many may be in a base
/// that does not exist yet; there they are reported once it can be inspected.
fn check_dependencies(
    archive: &Archive,
    base: &Base,
    request: &PushRequest,
    pushed: &PushedDirectory,
) -> Result<(), Error> {
    if !base.has_distributions_ros() {
        return Ok(());
    }
    let own = pushed::names(pushed.packages());
    let mut asked = pushed::required_keys(pushed.packages());
    if matches!(pushed, PushedDirectory::Installed(_)) {
        asked.build.clear();
    }
    let there = IndexedPackages::default();
    keys::resolve_keys(archive, base, &request.map, &own, &asked, &there)?;
    Ok(())
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
    for (_, path) in logs.iter().rev().skip(LOGS_KEPT) {
        let _ = fs::remove_file(path);
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use async_trait::async_trait;
    use servant::container::ContainerSpec;
    use servant::sandbox::SandboxContainer;

    use super::*;

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
                let refused = builder.build(&request, sender).await.expect_err("no package");
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
        assert!(!directory.path().join("2.log").exists() && directory.path().join("3.log").exists());
    }
}
