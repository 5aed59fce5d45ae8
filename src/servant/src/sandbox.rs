//! Containers for builds. Only an engine of this host has them: what runs in one writes into a directory of this host, and
//! whoever started it has to know which user ids its files belong to.

use std::sync::Arc;

use async_trait::async_trait;

use crate::Error;
use crate::container::ContainerSpec;
use crate::engine::Servant;
use crate::local::LocalEngine;

/// A container for a build.
pub struct Sandboxed {
    /// What runs in it.
    pub servant: Arc<dyn Servant>,
    /// First host uid (= gid) of its range: what uid 0 inside is outside.
    pub uid_offset: u32,
}

/// Starts containers for builds.
#[async_trait]
pub trait Sandbox: Send + Sync + 'static {
    /// Starts one; returns once its init runs.
    async fn sandbox(&self, spec: ContainerSpec) -> Result<Sandboxed, Error>;
}

#[async_trait]
impl Sandbox for LocalEngine {
    async fn sandbox(&self, spec: ContainerSpec) -> Result<Sandboxed, Error> {
        let servant = self.start_container(spec).await?;
        let uid_offset = servant.uid_range().0;
        Ok(Sandboxed {
            servant,
            uid_offset,
        })
    }
}
