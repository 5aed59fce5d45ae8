//! The engine of this host: one shim process and one directory for each servant.

use std::collections::HashMap;
use std::error::Error as StdError;
use std::ffi::OsString;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, Weak};

use api::Grants;

use async_trait::async_trait;
use tokio::sync::{Semaphore, oneshot};
use tokio::task::JoinSet;

use crate::Error;
use crate::cgroup::Parent;
use crate::container::{ContainerSpec, Profile};
use crate::engine::{Adopted, Ended, Engine, Servant};
use crate::launch::{self, Exit, Runtime};
pub use crate::launch::{Grace, Isolation};
use crate::logs::Watches;
use crate::quotas::Quotas;
use crate::spec::{Limits, Spec};
use crate::uids;

mod connection;
pub mod grants;
mod handle;
mod pool;
mod start;
mod sweep;
mod validate;

pub use handle::LocalServant;

/// Ended servants of which what is left is removed beside each other.
const SWEEPS: usize = 16;

/// Where each servant's uid range is taken from by default: 1879048192, the first of the 4094 ranges that systemd's
/// documentation of user ids lists as unused. Ranges for `/etc/subuid` grow from 100000, those of systemd-nspawn from
/// 524288; both would collide sooner or later with one that we picked among them.
pub const DEFAULT_UID_BASE: u32 = 0x7000_0000;

/// What the engine of this host is told by those who know it.
#[async_trait]
pub trait Resources: Send + Sync + 'static {
    /// The extracted layers of an image, lowest first.
    async fn layers(&self, image: &str) -> Result<Vec<PathBuf>, Box<dyn StdError + Send + Sync>>;
    /// Names of the hosts that `HOST:PORT`s lead to, each with the loopback address inside that stands for it; or which of
    /// them is not allowed.
    fn hosts(
        &self,
        egress: &[String],
    ) -> Result<Vec<(IpAddr, String)>, Box<dyn StdError + Send + Sync>>;
}

/// Knows no image and no host: for whoever starts containers of layers alone.
struct NoResources;

#[async_trait]
impl Resources for NoResources {
    async fn layers(&self, _image: &str) -> Result<Vec<PathBuf>, Box<dyn StdError + Send + Sync>> {
        Err("this engine was given no images".into())
    }

    fn hosts(
        &self,
        egress: &[String],
    ) -> Result<Vec<(IpAddr, String)>, Box<dyn StdError + Send + Sync>> {
        match egress.first() {
            Some(name) => Err(format!("this engine gives no way out to {name}").into()),
            None => Ok(Vec::new()),
        }
    }
}

/// What the local engine needs to know.
#[derive(Debug, Clone)]
pub struct LocalEngineConfig {
    /// Where each servant has its directory; owned by this engine alone. Absolute.
    pub home_servants_dir: PathBuf,
    /// The program, and its arguments, that calls [`crate::shim::run`], such as `[/usr/bin/cloudroidd, shim]`.
    pub shim_command: Vec<OsString>,
    /// The static `cloudroid-init`.
    pub init: PathBuf,
    /// For what a spec leaves open.
    pub default_limits: Limits,
    /// For each servant's shim: memory and cores. Its processor time is bounded by its servant's, too.
    pub shim_limits: Limits,
    /// For each servant: what it may write.
    pub quotas: Quotas,
    /// First uid of the first range; see [`DEFAULT_UID_BASE`].
    pub uid_base: u32,
    /// By whose locks all engines of the host know which ranges are taken.
    pub uid_locks: PathBuf,
    /// Whether less isolation than asked for is accepted.
    pub isolation: Isolation,
    /// How long nodes have to end when the servant is stopped.
    pub grace: Grace,
    /// What of this host services may be given.
    pub allow: grants::Allow,
}

impl LocalEngineConfig {
    /// With defaults for everything else: 1 GiB of memory, 512 processes, no bound on cores; for shims 256 MiB and half a
    /// core.
    pub fn new(home_servants_dir: PathBuf, shim_command: Vec<OsString>, init: PathBuf) -> Self {
        Self {
            home_servants_dir,
            shim_command,
            init,
            default_limits: Limits {
                memory: Some(1 << 30),
                pids: Some(512),
                ..Limits::default()
            },
            shim_limits: Limits {
                cpus: Some(0.5),
                memory: Some(256 << 20),
                ..Limits::default()
            },
            quotas: Quotas::default(),
            uid_base: DEFAULT_UID_BASE,
            uid_locks: uids::LOCKS.into(),
            isolation: Isolation::Require,
            grace: Grace::default(),
            allow: grants::Allow::default(),
        }
    }
}

/// Starts and finds servants on this host. Cheap to clone.
#[derive(Clone)]
pub struct LocalEngine {
    shared: Arc<Shared>,
    resources: Arc<dyn Resources>,
}

struct Shared {
    config: LocalEngineConfig,
    parent: Parent,
    networks: pool::Networks,
    /// Of directories in which logs are followed.
    watches: Arc<Watches>,
    /// Those that somebody holds, by id.
    servants: Mutex<HashMap<String, Weak<LocalServant>>>,
}

impl Drop for Shared {
    fn drop(&mut self) {
        self.parent.remove_if_unused();
    }
}

impl LocalEngine {
    /// Looks at the host and makes the servants' directory. Needs root. It knows no images until it is told of
    /// [`Resources`].
    pub fn new(config: LocalEngineConfig) -> Result<Self, Error> {
        if !nix::unistd::geteuid().is_root() {
            let source = std::io::Error::from(std::io::ErrorKind::PermissionDenied);
            return Err(Error::Call {
                call: "running containers as another user than root (run it as root)",
                source,
            });
        }
        let directory = &config.home_servants_dir;
        std::fs::create_dir_all(directory).map_err(Error::file("make", directory))?;
        for program in [
            Some(config.init.as_path()),
            config.shim_command.first().map(Path::new),
        ]
        .into_iter()
        .flatten()
        {
            std::fs::metadata(program).map_err(Error::file("find the program", program))?;
        }
        let parent = Parent::find()?;
        let networks = pool::Networks::default();
        Ok(Self {
            shared: Arc::new(Shared {
                config,
                parent,
                networks,
                watches: Arc::default(),
                servants: Mutex::default(),
            }),
            resources: Arc::new(NoResources),
        })
    }

    /// The same engine, which asks `resources` what images and hosts are.
    pub fn with(self, resources: Arc<dyn Resources>) -> Self {
        Self { resources, ..self }
    }

    /// A servant of this engine that somebody holds.
    pub fn servant(&self, id: &str) -> Option<Arc<LocalServant>> {
        let servants = self.shared.servants.lock();
        let servants = servants.unwrap_or_else(PoisonError::into_inner);
        servants.get(id).and_then(Weak::upgrade)
    }

    /// What this host can limit: the cgroup version, the controllers, and what is amiss.
    pub fn cgroups(&self) -> &Parent {
        &self.shared.parent
    }

    /// Makes network namespaces ahead, so that the next servants start sooner.
    pub fn warm_up(&self) {
        let shared = self.shared.clone();
        privilege::now(move || shared.networks.refill());
    }

    /// What a servant's container is on this host.
    async fn resolve(&self, spec: Spec) -> Result<ContainerSpec, Error> {
        let layers = self.resources.layers(&spec.image).await;
        let layers = layers.map_err(|source| Error::Image {
            image: spec.image,
            source,
        })?;
        let granted = self.granted(&spec.grants)?;
        Ok(ContainerSpec {
            id: spec.id,
            layers,
            writable: None,
            profile: Profile::Servant,
            limits: spec.limits,
            environment: granted.environment_over(&spec.environment),
            nodes: spec.nodes,
            owned_directories: Vec::new(),
            mounts: granted.mounts,
            hosts: granted.hosts,
            resident: spec.resident,
        })
    }

    fn granted(&self, grants: &Grants) -> Result<grants::Granted, Error> {
        let allow = &self.shared.config.allow;
        Ok(grants::resolve(grants, allow, &*self.resources)?)
    }

    /// [`Engine::start`] of a container that is described by what there is on this host.
    pub async fn start_container(&self, spec: ContainerSpec) -> Result<Arc<LocalServant>, Error> {
        let (sender, receiver) = oneshot::channel();
        let shared = self.shared.clone();
        let id = spec.id.clone();
        // A task of its own: when the caller is cancelled half-way, what was half-made is still ended properly.
        let _began = privilege::now(move || {
            tokio::spawn(async move {
                let outcome = start::start(&shared, spec).await;
                if let Err(Ok(unwanted)) = sender.send(outcome) {
                    if let Err(error) = unwanted.stop().await {
                        tracing::warn!(%error, "a servant that nobody waited for could not be ended");
                    }
                }
            })
        });
        let gone = |_| Error::Start {
            id,
            reason: "the engine is shutting down".into(),
        };
        let servant = receiver.await.map_err(gone)??;
        self.shared.keep(&servant);
        Ok(servant)
    }

    /// None when nothing of it runs.
    async fn adopt_one(
        &self,
        id: &str,
        directory: &Path,
    ) -> Result<Option<Arc<LocalServant>>, Error> {
        // What cannot be read belongs to something half-made.
        let runtime: Option<Runtime> =
            launch::read(&directory.join(launch::RUNTIME)).unwrap_or_default();
        let Some(runtime) = runtime else {
            return Ok(None);
        };
        let Some(pidfd) = runtime
            .shim
            .open()
            .map_err(Error::call("looking for a shim"))?
        else {
            return Ok(None);
        };
        let place = handle::Place {
            id,
            directory,
            watches: &self.shared.watches,
        };
        match handle::adopt(place, &runtime, pidfd).await {
            Ok(servant) => {
                self.shared.keep(&servant);
                Ok(Some(servant))
            }
            Err(error) => {
                tracing::warn!(%error, id, "a shim does not answer and is ended");
                Ok(None)
            }
        }
    }
}

impl Shared {
    /// So that it is found by its id while somebody holds it.
    fn keep(&self, servant: &Arc<LocalServant>) {
        let servants = self.servants.lock();
        let mut servants = servants.unwrap_or_else(PoisonError::into_inner);
        servants.retain(|_, held| held.strong_count() > 0);
        servants.insert(servant.id().to_owned(), Arc::downgrade(servant));
    }
}

#[async_trait]
impl Engine for LocalEngine {
    async fn start(&self, spec: Spec) -> Result<Arc<dyn Servant>, Error> {
        let engine = self.clone();
        privilege::run(async move {
            let spec = engine.resolve(spec).await?;
            Ok(engine.start_container(spec).await? as Arc<dyn Servant>)
        })
        .await
    }

    async fn adopt(&self) -> Result<Adopted, Error> {
        let engine = self.clone();
        privilege::run(async move { engine.adopt_all().await }).await
    }

    async fn sweep(&self, ended: &[Ended]) -> Vec<Error> {
        let (engine, ended) = (self.clone(), ended.to_vec());
        privilege::run(async move { engine.sweep_all(&ended).await }).await
    }

    fn check(&self, grants: &Grants) -> Result<Vec<String>, Error> {
        let (engine, grants) = (self.clone(), grants.clone());
        privilege::now(move || Ok(engine.granted(&grants)?.unfulfilled))
    }
}

/// What a directory of a servant turned out to be.
enum Found {
    Running(Arc<LocalServant>),
    Ended(Ended),
}

impl LocalEngine {
    /// Looks at all at once: a shim that does not answer is waited for.
    async fn adopt_all(&self) -> Result<Adopted, Error> {
        let home = &self.shared.config.home_servants_dir;
        let entries = std::fs::read_dir(home).map_err(Error::file("read", home))?;
        let mut looks = JoinSet::new();
        for entry in entries {
            let entry = entry.map_err(Error::file("read", home))?;
            let engine = self.clone();
            looks.spawn(async move { engine.look(&entry).await });
        }
        let mut adopted = Adopted::default();
        for found in looks.join_all().await {
            match found {
                Ok(Found::Running(servant)) => adopted.running.push(servant),
                Ok(Found::Ended(ended)) => adopted.ended.push(ended),
                Err(error) => adopted.failures.push(error),
            }
        }
        Ok(adopted)
    }

    async fn look(&self, entry: &std::fs::DirEntry) -> Result<Found, Error> {
        let directory = entry.path();
        if !entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            // None of ours: it is left to whoever put it there.
            return Err(Error::Stray { path: directory });
        }
        let id = entry.file_name().to_string_lossy().into_owned();
        if let Some(servant) = self.adopt_one(&id, &directory).await? {
            return Ok(Found::Running(servant));
        }
        let exit: Option<Exit> = launch::read(&directory.join(launch::EXIT)).unwrap_or_default();
        let state = exit.map(|exit| exit.state);
        Ok(Found::Ended(Ended { id, state }))
    }

    async fn sweep_all(&self, ended: &[Ended]) -> Vec<Error> {
        let home = &self.shared.config.home_servants_dir;
        // What does not go is waited for, and keeps no other.
        let turns = Arc::new(Semaphore::new(SWEEPS));
        let mut sweeps = JoinSet::new();
        for ended in ended {
            let (id, directory) = (ended.id.clone(), home.join(&ended.id));
            let turns = Arc::clone(&turns);
            sweeps.spawn(async move {
                let _turn = turns.acquire().await;
                sweep::sweep(&id, &directory).await
            });
        }
        let swept = sweeps.join_all().await;
        swept.into_iter().filter_map(Result::err).collect()
    }
}
