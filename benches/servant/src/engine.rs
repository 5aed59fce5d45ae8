//! Our engine alone: from `start` to a container whose init runs, with the shim and the Master that the daemon has.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Result;
use bench_servant::binary;
use servant::container::ContainerSpec;
use servant::engine::Servant;
use servant::local::{Isolation, LocalEngine, LocalEngineConfig};
use tokio::runtime::Handle;

/// An engine of this program.
pub(crate) struct Ours<'a> {
    engine: LocalEngine,
    runtime: &'a Handle,
}

impl<'a> Ours<'a> {
    /// With its servants below `place`.
    pub(crate) fn prepare(place: &Path, runtime: &'a Handle) -> Result<Self> {
        let shim = vec![binary("cloudroidd")?.into_os_string(), "shim".into()];
        let mut config =
            LocalEngineConfig::new(place.join("servants"), shim, binary("cloudroid-init")?);
        config.isolation = Isolation::BestEffort;
        let engine = runtime.block_on(async { LocalEngine::new(config) })?;
        engine.warm_up();
        Ok(Self { engine, runtime })
    }

    /// Starts one, and ends it.
    pub(crate) fn time(&self, spec: ContainerSpec) -> Result<Duration> {
        self.runtime.block_on(async {
            let begun = Instant::now();
            let servant = self.engine.start_container(spec).await?;
            let took = begun.elapsed();
            servant.stop().await?;
            Ok(took)
        })
    }
}
