//! The engine: which programs there are, and which servants.

use std::collections::BTreeMap;
use std::sync::Arc;

use api::Grants;
use async_trait::async_trait;
use futures_util::FutureExt;
use futures_util::future::BoxFuture;
use parking_lot::Mutex;
use servant::Error;
use servant::engine::{Adopted, ContainerState, Ended, Engine, Servant};
use servant::spec::Spec;
use tokio::runtime::Handle;

use crate::process::Process;
use crate::servants::MemoryServant;

type Program = Arc<dyn Fn(Process) -> BoxFuture<'static, i32> + Send + Sync>;

/// Starts servants that are tasks of this process. Cheap to clone; all clones are the same engine, which outlives whoever
/// uses it, as containers outlive a daemon.
#[derive(Clone)]
pub struct MemoryEngine {
    world: Arc<World>,
}

/// The servants, images and limits of the engine.
pub(crate) struct World {
    /// Where nodes run, wherever their servants are asked for.
    pub(crate) runtime: Handle,
    programs: Mutex<BTreeMap<String, Program>>,
    servants: Mutex<BTreeMap<String, Arc<MemoryServant>>>,
    started: Mutex<Vec<Spec>>,
    /// Images that cannot be started, each with the reason.
    broken: Mutex<BTreeMap<String, String>>,
    /// Of what cannot be removed: the ids.
    leftovers: Mutex<Vec<String>>,
    /// Devices, volumes and hosts that may be granted.
    allowed: Mutex<Grants>,
}

impl World {
    pub(crate) fn program(&self, path: &str) -> Option<Program> {
        self.programs.lock().get(path).cloned()
    }

    pub(crate) fn servant(&self, id: &str) -> Option<Arc<MemoryServant>> {
        self.servants.lock().get(id).cloned()
    }

    pub(crate) fn forget(&self, id: &str) {
        self.servants.lock().remove(id);
    }
}

impl Default for MemoryEngine {
    /// One whose nodes run on the runtime of whoever makes it.
    fn default() -> MemoryEngine {
        MemoryEngine {
            world: Arc::new(World {
                runtime: Handle::current(),
                programs: Mutex::default(),
                servants: Mutex::default(),
                started: Mutex::default(),
                broken: Mutex::default(),
                leftovers: Mutex::default(),
                allowed: Mutex::default(),
            }),
        }
    }
}

impl MemoryEngine {
    /// Installs a program in every image; it gives its exit code.
    pub fn program<F>(&self, path: &str, run: impl Fn(Process) -> F + Send + Sync + 'static)
    where
        F: Future<Output = i32> + Send + 'static,
    {
        let program: Program = Arc::new(move |process| run(process).boxed());
        let programs = &mut *self.world.programs.lock();
        programs.insert(path.to_owned(), program);
    }

    /// From now on no servant of this image can be started, for this reason.
    pub fn breaks(&self, image: &str, reason: &str) {
        let broken = &mut *self.world.broken.lock();
        broken.insert(image.to_owned(), reason.to_owned());
    }

    /// From now on these may be granted.
    pub fn allow(&self, grants: Grants) {
        *self.world.allowed.lock() = grants;
    }

    /// Leaves something of a servant that the next sweep cannot remove.
    pub fn leave_behind(&self, id: &str) {
        self.world.leftovers.lock().push(id.to_owned());
    }

    /// A servant that is there, ended or not.
    pub fn servant(&self, id: &str) -> Option<Arc<MemoryServant>> {
        self.world.servant(id)
    }

    /// Ids of the servants that are there, ended or not.
    pub fn servants(&self) -> Vec<String> {
        self.world.servants.lock().keys().cloned().collect()
    }

    /// The specs of all servants that were asked for, in their order.
    pub fn started(&self) -> Vec<Spec> {
        self.world.started.lock().clone()
    }
}

#[async_trait]
impl Engine for MemoryEngine {
    async fn start(&self, spec: Spec) -> Result<Arc<dyn Servant>, Error> {
        self.world.started.lock().push(spec.clone());
        self.check(&spec.grants)?;
        if let Some(reason) = self.world.broken.lock().get(&spec.image) {
            return Err(Error::Start {
                id: spec.id,
                reason: reason.clone(),
            });
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
            // A program that is not there is an event, as in a container.
            let _ = servant.run(node);
        }
        Ok(servant)
    }

    async fn adopt(&self) -> Result<Adopted, Error> {
        let mut adopted = Adopted::default();
        let servants: Vec<_> = self.world.servants.lock().values().cloned().collect();
        for servant in servants {
            let state: ContainerState = servant.state().borrow().clone();
            if !state.is_over() {
                adopted.running.push(servant);
                continue;
            }
            adopted.ended.push(Ended {
                id: servant.id().to_owned(),
                state: Some(state),
            });
        }
        Ok(adopted)
    }

    async fn sweep(&self, ended: &[Ended]) -> Vec<Error> {
        for ended in ended {
            self.world.forget(&ended.id);
        }
        let left = |id| Error::LeftOver {
            id,
            what: "a cgroup".to_owned(),
        };
        let leftovers = std::mem::take(&mut *self.world.leftovers.lock());
        leftovers.into_iter().map(left).collect()
    }

    fn check(&self, grants: &Grants) -> Result<Vec<String>, Error> {
        let allowed = self.world.allowed.lock();
        let refused = |kind: &'static str, name: &str| {
            Err(Error::Grant(
                servant::local::grants::GrantError::NotAllowed {
                    kind,
                    name: name.to_owned(),
                },
            ))
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
