//! Our engine alone: from `start` to a container whose init runs, including the shim and the Master, as in the daemon.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Result;
use servant::container::ContainerSpec;
use servant::engine::ServantHandle;
use servant::local::{Isolation, LocalEngine, LocalEngineConfig};
use support::binaries;
use tokio::runtime::Handle;

/// An engine inside this program.
pub(crate) struct BenchEngine<'a> {
    engine: LocalEngine,
    runtime: &'a Handle,
}

impl<'a> BenchEngine<'a> {
    /// Creates an engine with its servants below `place`.
    pub(crate) fn prepare(place: &Path, runtime: &'a Handle) -> Result<Self> {
        let shim = vec![binaries::path("cloudroidd").into_os_string(), "shim".into()];
        let mut config = LocalEngineConfig::new(place.join("servants"), shim, binaries::path("cloudroid-init"));
        config.isolation = Isolation::BestEffort;
        let engine = runtime.block_on(async { LocalEngine::new(config) })?;
        engine.warm_up();
        Ok(Self { engine, runtime })
    }

    /// Starts a servant, measures the time, and stops it.
    pub(crate) fn time_start(&self, spec: ContainerSpec) -> Result<Duration> {
        self.runtime.block_on(async {
            let begun = Instant::now();
            let servant = self.engine.start_container(spec).await?;
            let took = begun.elapsed();
            servant.stop().await?;
            Ok(took)
        })
    }
}
