//! The engine: its programs and its servants.

use std::collections::BTreeMap;
use std::sync::Arc;

use api::{Grants, KeptLog};
use async_trait::async_trait;
use futures_util::FutureExt;
use futures_util::future::BoxFuture;
use parking_lot::Mutex;
use servant::Error;
use servant::engine::{AdoptedServants, ContainerState, EndedServant, Engine, LogLine, ServantHandle};
use servant::spec::Spec;
use tokio::runtime::Handle;

use crate::process::Process;
use crate::servants::MemoryServant;

type Program = Arc<dyn Fn(Process) -> BoxFuture<'static, i32> + Send + Sync>;

/// Starts servants that are tasks of this process. Cheap to clone; all clones are the same engine, which outlives its
/// users as containers outlive a daemon.
#[derive(Clone)]
pub struct MemoryEngine {
    world: Arc<EngineState>,
}

/// Servants, images and limits of the engine.
pub(crate) struct EngineState {
    /// Runtime of the nodes, from wherever their servants are started.
    pub(crate) runtime: Handle,
    programs: Mutex<BTreeMap<String, Program>>,
    servants: Mutex<BTreeMap<String, Arc<MemoryServant>>>,
    started: Mutex<Vec<Spec>>,
    /// Images that cannot be started, each with the reason.
    broken: Mutex<BTreeMap<String, String>>,
    /// Kept logs of ended servants, by id.
    kept: Mutex<BTreeMap<String, (KeptLog, Vec<LogLine>)>>,
    /// Ids of servants with leftovers that cannot be removed.
    leftovers: Mutex<Vec<String>>,
    /// Devices, volumes and hosts that may be granted.
    allowed: Mutex<Grants>,
}

impl EngineState {
    pub(crate) fn program(&self, path: &str) -> Option<Program> {
        self.programs.lock().get(path).cloned()
    }

    pub(crate) fn servant(&self, id: &str) -> Option<Arc<MemoryServant>> {
        self.servants.lock().get(id).cloned()
    }

    pub(crate) fn forget(&self, id: &str) {
        self.servants.lock().remove(id);
    }

    /// Keeps the lines of a servant's log; returns `about` with their size.
    pub(crate) fn keep_log(&self, mut about: KeptLog, lines: Vec<LogLine>) -> KeptLog {
        about.bytes = api::Size(lines.iter().map(|line| line.line.len() as u64).sum());
        self.kept.lock().insert(about.servant.clone(), (about.clone(), lines));
        about
    }
}

impl Default for MemoryEngine {
    /// Creates an engine whose nodes run on the current runtime.
    fn default() -> MemoryEngine {
        MemoryEngine {
            world: Arc::new(EngineState {
                runtime: Handle::current(),
                programs: Mutex::default(),
                servants: Mutex::default(),
                started: Mutex::default(),
                broken: Mutex::default(),
                kept: Mutex::default(),
                leftovers: Mutex::default(),
                allowed: Mutex::default(),
            }),
        }
    }
}

impl MemoryEngine {
    /// Installs a program in every image; `run` returns its exit code.
    pub fn program<F>(&self, path: &str, run: impl Fn(Process) -> F + Send + Sync + 'static)
    where
        F: Future<Output = i32> + Send + 'static,
    {
        let program: Program = Arc::new(move |process| run(process).boxed());
        let programs = &mut *self.world.programs.lock();
        programs.insert(path.to_owned(), program);
    }

    /// Makes further starts of servants of this image fail with this reason.
    pub fn break_image(&self, image: &str, reason: &str) {
        let broken = &mut *self.world.broken.lock();
        broken.insert(image.to_owned(), reason.to_owned());
    }

    /// Sets which grants are allowed from now on.
    pub fn allow(&self, grants: Grants) {
        *self.world.allowed.lock() = grants;
    }

    /// Makes the next sweep fail to remove something of a servant.
    pub fn leave_behind(&self, id: &str) {
        self.world.leftovers.lock().push(id.to_owned());
    }

    /// Returns an existing servant, ended or not.
    pub fn servant(&self, id: &str) -> Option<Arc<MemoryServant>> {
        self.world.servant(id)
    }

    /// Returns the ids of the existing servants, ended or not.
    pub fn servants(&self) -> Vec<String> {
        self.world.servants.lock().keys().cloned().collect()
    }

    /// Returns the specifications of all servants that were requested, in their order.
    pub fn started_specs(&self) -> Vec<Spec> {
        self.world.started.lock().clone()
    }
}

#[async_trait]
impl Engine for MemoryEngine {
    async fn start(&self, spec: Spec) -> Result<Arc<dyn ServantHandle>, Error> {
        self.world.started.lock().push(spec.clone());
        self.check_grants(&spec.grants)?;
        if let Some(reason) = self.world.broken.lock().get(&spec.image) {
            return Err(Error::Start { id: spec.id, reason: reason.clone() });
        }
        let servant = MemoryServant::new(&spec, Arc::downgrade(&self.world));
        {
            let mut servants = self.world.servants.lock();
            if servants.contains_key(&spec.id) {
                return Err(Error::Exists { id: spec.id });
            }
            servants.insert(spec.id, Arc::clone(&servant));
        }
        for node in spec.nodes {
            // A missing program is reported by an event, as in a container.
            let _ = servant.run(node);
        }
        Ok(servant)
    }

    async fn adopt(&self) -> Result<AdoptedServants, Error> {
        let mut adopted = AdoptedServants::default();
        let servants: Vec<_> = self.world.servants.lock().values().cloned().collect();
        for servant in servants {
            let state: ContainerState = servant.state().borrow().clone();
            if !state.is_over() {
                adopted.running.push(servant);
                continue;
            }
            adopted.ended.push(EndedServant { id: servant.id().to_owned(), state: Some(state), keep: None });
        }
        Ok(adopted)
    }

    async fn sweep(&self, ended: &[EndedServant]) -> Vec<Error> {
        for ended in ended {
            if let (Some(about), Some(servant)) = (&ended.keep, self.world.servant(&ended.id)) {
                self.world.keep_log(about.clone(), servant.logs(usize::MAX, None).await);
            }
            self.world.forget(&ended.id);
        }
        let left = |id| Error::LeftOver { id, what: "a cgroup".to_owned() };
        let leftovers = std::mem::take(&mut *self.world.leftovers.lock());
        leftovers.into_iter().map(left).collect()
    }

    async fn kept_logs(&self) -> Result<Vec<KeptLog>, Error> {
        Ok(self.world.kept.lock().values().map(|(about, _)| about.clone()).collect())
    }

    async fn read_kept_log(&self, id: &str, last: usize) -> Vec<LogLine> {
        let mut lines = self.world.kept.lock().get(id).map(|(_, lines)| lines.clone()).unwrap_or_default();
        lines.split_off(lines.len().saturating_sub(last))
    }

    async fn remove_kept_logs(&self, ids: Vec<String>) -> Vec<Error> {
        self.world.kept.lock().retain(|id, _| !ids.contains(id));
        Vec::new()
    }

    fn check_grants(&self, grants: &Grants) -> Result<Vec<String>, Error> {
        let allowed = self.world.allowed.lock();
        let refused = |kind: &'static str, name: &str| {
            Err(Error::Grant(servant::local::grants::GrantError::NotAllowed { kind, name: name.to_owned() }))
        };
        for device in &grants.devices {
            if !allowed.devices.contains(device) {
                return refused("device", device);
            }
        }
        for volume in &grants.volumes {
            if !allowed.volumes.contains(volume) {
                return refused("volume", &volume.source);
            }
        }
        for host in &grants.egress {
            if !allowed.egress.contains(host) {
                return refused("egress", host);
            }
        }
        Ok(Vec::new())
    }
}
