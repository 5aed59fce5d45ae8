//! The engine of this host: one shim process and one directory per servant.

use std::collections::HashMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, Weak};

use api::{Grants, KeptLog};

use async_trait::async_trait;
use tokio::sync::{Semaphore, oneshot};
use tokio::task::JoinSet;
use tracing::Instrument;

use crate::Error;
use crate::cgroup::CgroupParent;
use crate::container::{ContainerSpec, Profile};
use crate::engine::{AdoptedServants, EndedServant, Engine, LogLine, ServantHandle};
use crate::launch::{self, ExitRecord, RuntimeRecord};
pub use crate::launch::{GracePeriods, Isolation};
use crate::logs::{self, DirectoryWatches};
use crate::quotas::Quotas;
use crate::spec::{Limits, Size, Spec};
use crate::uids;

mod connection;
mod ended_logs;
pub mod grants;
mod handle;
mod pool;
mod resources;
mod start;
mod sweep;
mod validate;

pub use handle::LocalServant;
use resources::NoResources;
pub use resources::Resources;

/// Number of ended servants whose remains are removed concurrently.
const SWEEPS: usize = 16;
/// Number of servants of an earlier daemon that are examined concurrently.
const LOOKS: usize = 64;

/// Default base of the servants' uid ranges: 1879048192, the first of the 4094 ranges that systemd's documentation of
/// user ids lists as unused. Ranges for `/etc/subuid` grow from 100000, those of systemd-nspawn from 524288; a range
/// chosen among either would collide sooner or later.
pub const DEFAULT_UID_BASE: u32 = 0x7000_0000;

/// Configuration of the local engine.
#[derive(Debug, Clone)]
pub struct LocalEngineConfig {
    /// Directory with one subdirectory per servant; owned by this engine alone. Absolute.
    pub home_servants_dir: PathBuf,
    /// Directory of the logs that are kept of ended servants; on the same file system, owned by this engine alone.
    /// Absolute.
    pub kept_logs_dir: PathBuf,
    /// Program, with its arguments, that calls [`crate::shim::run`], such as `[/usr/bin/cloudroidd, shim]`.
    pub shim_command: Vec<OsString>,
    /// Path of the static `cloudroid-init`.
    pub init: PathBuf,
    /// Limits used where a spec has none.
    pub default_limits: Limits,
    /// Memory and CPU limits of each shim. Its processor time is also bounded by its servant's.
    pub shim_limits: Limits,
    /// Bounds on what each servant may write.
    pub quotas: Quotas,
    /// First uid of the first range; see [`DEFAULT_UID_BASE`].
    pub uid_base: u32,
    /// Lock file by which all engines of the host know which ranges are taken.
    pub uid_locks: PathBuf,
    /// Policy for limits that this host cannot enforce.
    pub isolation: Isolation,
    /// Time for nodes to end when the servant is stopped.
    pub grace: GracePeriods,
    /// Resources of this host that services may be granted.
    pub allow: grants::Allow,
}

impl LocalEngineConfig {
    /// Uses defaults for everything else: logs in `ended` beside the servants, 1 GiB of memory, 512 processes,
    /// unlimited cores; for shims 256 MiB and half a core.
    pub fn new(home_servants_dir: PathBuf, shim_command: Vec<OsString>, init: PathBuf) -> Self {
        Self {
            kept_logs_dir: home_servants_dir.with_file_name("ended"),
            home_servants_dir,
            shim_command,
            init,
            default_limits: Limits { memory: Some(Size(1 << 30)), pids: Some(512), ..Limits::default() },
            shim_limits: Limits { cpus: Some(0.5), memory: Some(Size(256 << 20)), ..Limits::default() },
            quotas: Quotas::default(),
            uid_base: DEFAULT_UID_BASE,
            uid_locks: uids::LOCKS.into(),
            isolation: Isolation::Require,
            grace: GracePeriods::default(),
            allow: grants::Allow::default(),
        }
    }
}

/// Starts and finds servants on this host. Cheap to clone.
#[derive(Clone)]
pub struct LocalEngine {
    shared: Arc<EngineShared>,
    resources: Arc<dyn Resources>,
}

struct EngineShared {
    config: LocalEngineConfig,
    parent: CgroupParent,
    networks: pool::NetworkPool,
    /// Watches of directories in which logs are followed.
    watches: Arc<DirectoryWatches>,
    /// Servants with a live handle, by id.
    servants: Mutex<HashMap<String, Weak<LocalServant>>>,
}

impl Drop for EngineShared {
    fn drop(&mut self) {
        self.parent.remove_if_unused();
    }
}

impl LocalEngine {
    /// Examines the host and creates the servants' directory. Needs root. It has no images until it is given
    /// [`Resources`].
    pub fn new(config: LocalEngineConfig) -> Result<Self, Error> {
        if !nix::unistd::geteuid().is_root() {
            let source = std::io::Error::from(std::io::ErrorKind::PermissionDenied);
            return Err(Error::Call { call: "running containers as another user than root (run it as root)", source });
        }
        let directory = &config.home_servants_dir;
        std::fs::create_dir_all(directory).map_err(Error::file("make", directory))?;
        for program in [Some(config.init.as_path()), config.shim_command.first().map(Path::new)].into_iter().flatten() {
            std::fs::metadata(program).map_err(Error::file("find the program", program))?;
        }
        let parent = CgroupParent::find()?;
        let networks = pool::NetworkPool::default();
        Ok(Self {
            shared: Arc::new(EngineShared {
                config,
                parent,
                networks,
                watches: Arc::default(),
                servants: Mutex::default(),
            }),
            resources: Arc::new(NoResources),
        })
    }

    /// Sets the `resources` that provide images and hosts.
    pub fn with_resources(self, resources: Arc<dyn Resources>) -> Self {
        Self { resources, ..self }
    }

    /// Returns a servant of this engine that has a live handle.
    pub fn servant(&self, id: &str) -> Option<Arc<LocalServant>> {
        let servants = self.shared.servants.lock();
        let servants = servants.unwrap_or_else(PoisonError::into_inner);
        servants.get(id).and_then(Weak::upgrade)
    }

    /// Returns what this host can limit: the cgroup version, the controllers, and what is missing.
    pub fn cgroups(&self) -> &CgroupParent {
        &self.shared.parent
    }

    /// Creates network namespaces in advance, so that the next servants start sooner.
    pub fn warm_up(&self) {
        let shared = self.shared.clone();
        privilege::run_sync(move || shared.networks.refill());
    }

    /// Converts a spec to the description of a container on this host.
    async fn resolve(&self, spec: Spec) -> Result<ContainerSpec, Error> {
        let layers = self.resources.layers(&spec.image).await;
        let layers = layers.map_err(|source| Error::Image { image: spec.image, source })?;
        let granted = self.resolve_grants(&spec.grants)?;
        Ok(ContainerSpec {
            id: spec.id,
            layers,
            writable: None,
            profile: Profile::Servant,
            limits: spec.limits,
            environment: granted.merge_environment(&spec.environment),
            nodes: spec.nodes,
            owned_directories: Vec::new(),
            mounts: granted.mounts,
            hosts: granted.hosts,
            resident: spec.resident,
        })
    }

    fn resolve_grants(&self, grants: &Grants) -> Result<grants::ResolvedGrants, Error> {
        let allow = &self.shared.config.allow;
        Ok(grants::resolve(grants, allow, &*self.resources)?)
    }

    /// Starts a container that is described in terms of this host, like [`Engine::start`].
    pub async fn start_container(&self, spec: ContainerSpec) -> Result<Arc<LocalServant>, Error> {
        let (sender, receiver) = oneshot::channel();
        let shared = self.shared.clone();
        let id = spec.id.clone();
        // In a separate task: if the caller is cancelled half-way, the partial servant is still ended properly.
        let _began = privilege::run_sync(move || {
            let starting = async move {
                let outcome = start::start(&shared, spec).await;
                if let Err(Ok(unwanted)) = sender.send(outcome) {
                    if let Err(error) = unwanted.stop().await {
                        tracing::warn!(%error, "an abandoned servant could not be stopped");
                    }
                }
            };
            tokio::spawn(starting.in_current_span())
        });
        let gone = |_| Error::Start { id, reason: "the engine is shutting down".into() };
        let servant = receiver.await.map_err(gone)??;
        self.shared.register(&servant);
        Ok(servant)
    }

    /// Adopts a servant; `None` if nothing of it runs.
    async fn adopt_one(&self, id: &str, directory: &Path) -> Result<Option<Arc<LocalServant>>, Error> {
        // Unreadable records belong to servants that were only partly created.
        let runtime: Option<RuntimeRecord> = launch::read_record(&directory.join(launch::RUNTIME)).unwrap_or_default();
        let Some(runtime) = runtime else {
            return Ok(None);
        };
        let Some(pidfd) = runtime.shim.open_pidfd().map_err(Error::call("looking for a shim"))? else {
            return Ok(None);
        };
        let place = handle::ServantLocation {
            id,
            directory,
            kept_logs: &self.shared.config.kept_logs_dir,
            watches: &self.shared.watches,
        };
        match handle::adopt(place, &runtime, pidfd).await {
            Ok(servant) => {
                self.shared.register(&servant);
                Ok(Some(servant))
            }
            Err(error) => {
                tracing::warn!(%error, id, "a shim does not answer and is stopped");
                Ok(None)
            }
        }
    }
}

impl EngineShared {
    /// Makes the servant available by its id for as long as it has a handle.
    fn register(&self, servant: &Arc<LocalServant>) {
        let servants = self.servants.lock();
        let mut servants = servants.unwrap_or_else(PoisonError::into_inner);
        servants.retain(|_, held| held.strong_count() > 0);
        servants.insert(servant.id().to_owned(), Arc::downgrade(servant));
    }
}

#[async_trait]
impl Engine for LocalEngine {
    async fn start(&self, spec: Spec) -> Result<Arc<dyn ServantHandle>, Error> {
        let engine = self.clone();
        privilege::run(async move {
            let spec = engine.resolve(spec).await?;
            Ok(engine.start_container(spec).await? as Arc<dyn ServantHandle>)
        })
        .await
    }

    async fn adopt(&self) -> Result<AdoptedServants, Error> {
        let engine = self.clone();
        privilege::run(async move { engine.adopt_all().await }).await
    }

    async fn sweep(&self, ended: &[EndedServant]) -> Vec<Error> {
        let (engine, ended) = (self.clone(), ended.to_vec());
        privilege::run(async move { engine.sweep_all(&ended).await }).await
    }

    async fn kept_logs(&self) -> Result<Vec<KeptLog>, Error> {
        let config = &self.shared.config;
        let (kept, servants) = (config.kept_logs_dir.clone(), config.home_servants_dir.clone());
        let listed = privilege::spawn_blocking(move || ended_logs::list_logs(&kept, &servants)).await;
        listed.unwrap_or_else(|panic| std::panic::resume_unwind(panic.into_panic()))
    }

    async fn read_kept_log(&self, id: &str, last: usize) -> Vec<LogLine> {
        logs::read_last(self.shared.config.kept_logs_dir.join(id).join(logs::FILE), last, None).await
    }

    async fn remove_kept_logs(&self, ids: Vec<String>) -> Vec<Error> {
        let kept = self.shared.config.kept_logs_dir.clone();
        let removed = privilege::spawn_blocking(move || {
            ids.iter().filter_map(|id| ended_logs::remove_log(&kept.join(id)).err()).collect()
        });
        removed.await.unwrap_or_else(|panic| std::panic::resume_unwind(panic.into_panic()))
    }

    fn check_grants(&self, grants: &Grants) -> Result<Vec<String>, Error> {
        let (engine, grants) = (self.clone(), grants.clone());
        privilege::run_sync(move || Ok(engine.resolve_grants(&grants)?.unfulfilled))
    }
}

/// Result of examining a servant's directory.
enum FoundServant {
    Running(Arc<LocalServant>),
    Ended(EndedServant),
}

impl LocalEngine {
    /// Examines directories concurrently, since a shim that does not answer is waited for.
    async fn adopt_all(&self) -> Result<AdoptedServants, Error> {
        let home = &self.shared.config.home_servants_dir;
        let entries = std::fs::read_dir(home).map_err(Error::file("read", home))?;
        let turns = Arc::new(Semaphore::new(LOOKS));
        let mut looks = JoinSet::new();
        for entry in entries {
            let entry = entry.map_err(Error::file("read", home))?;
            let (engine, turns) = (self.clone(), Arc::clone(&turns));
            looks.spawn(async move {
                let _turn = turns.acquire().await;
                engine.inspect_directory(&entry).await
            });
        }
        let mut adopted = AdoptedServants::default();
        for found in looks.join_all().await {
            match found {
                Ok(FoundServant::Running(servant)) => adopted.running.push(servant),
                Ok(FoundServant::Ended(ended)) => adopted.ended.push(ended),
                Err(error) => adopted.failures.push(error),
            }
        }
        Ok(adopted)
    }

    async fn inspect_directory(&self, entry: &std::fs::DirEntry) -> Result<FoundServant, Error> {
        let directory = entry.path();
        if !entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            // Not ours: it is left alone.
            return Err(Error::Stray { path: directory });
        }
        let id = entry.file_name().to_string_lossy().into_owned();
        if let Some(servant) = self.adopt_one(&id, &directory).await? {
            return Ok(FoundServant::Running(servant));
        }
        let exit: Option<ExitRecord> = launch::read_record(&directory.join(launch::EXIT)).unwrap_or_default();
        let state = exit.map(|exit| exit.state);
        Ok(FoundServant::Ended(EndedServant { id, state, keep: None }))
    }

    async fn sweep_all(&self, ended: &[EndedServant]) -> Vec<Error> {
        let config = &self.shared.config;
        // Removals that take long do not block others.
        let turns = Arc::new(Semaphore::new(SWEEPS));
        let mut sweeps = JoinSet::new();
        for ended in ended {
            let (ended, directory) = (ended.clone(), config.home_servants_dir.join(&ended.id));
            let kept = config.kept_logs_dir.clone();
            let turns = Arc::clone(&turns);
            sweeps.spawn(async move {
                let _turn = turns.acquire().await;
                let keeping = match ended.keep {
                    Some(about) => ended_logs::keep_log(&kept, &directory, about).await.map(drop),
                    None => Ok(()),
                };
                [keeping, sweep::sweep(&ended.id, &directory).await]
            });
        }
        let swept = sweeps.join_all().await.into_iter().flatten();
        swept.filter_map(Result::err).collect()
    }
}
