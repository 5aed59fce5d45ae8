//! Containers for builds. Only the engine of this host has them: a build writes into a directory of this host, and its
//! caller must know the user ids of its files.

use std::sync::Arc;

use async_trait::async_trait;

use crate::Error;
use crate::container::ContainerSpec;
use crate::engine::ServantHandle;
use crate::local::LocalEngine;

/// A container for a build.
pub struct SandboxContainer {
    /// Handle of the running container.
    pub servant: Arc<dyn ServantHandle>,
    /// First host uid (= gid) of its range: uid 0 in the container as seen on the host.
    pub uid_offset: u32,
}

/// Starts containers for builds.
#[async_trait]
pub trait Sandbox: Send + Sync + 'static {
    /// Starts a container; returns once its init runs.
    async fn start_sandbox(&self, spec: ContainerSpec) -> Result<SandboxContainer, Error>;
}

#[async_trait]
impl Sandbox for LocalEngine {
    async fn start_sandbox(&self, spec: ContainerSpec) -> Result<SandboxContainer, Error> {
        let servant = self.start_container(spec).await?;
        let uid_offset = servant.uid_range().0;
        Ok(SandboxContainer { servant, uid_offset })
    }
}
