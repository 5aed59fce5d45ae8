//! Changes the limits of a servant while it works.

use crate::decide::demand::with_weight;
use crate::limits::limits_of;
use crate::{Choreographer, Error, engine_limits};

impl Choreographer {
    /// Changes the limits that are given, of a servant that runs; what is promised to it changes with them.
    pub async fn set_limits(&self, id: &str, change: api::Limits) -> Result<(), Error> {
        let handle = self.servant(id)?;
        let unreached = || Error::Servant {
            service: handle.service().to_owned(),
            robot: handle.robot.clone(),
            reason: "does not run, so that its limits cannot be changed".to_owned(),
            log: Vec::new(),
        };
        let container = handle.container().ok_or_else(unreached)?;
        // One change after the other: what is promised, in force and remembered must be of the same.
        let _turn = handle.limits_turn().await;
        let (before, wanted) = (handle.asked(), change.or(handle.asked()));
        let promise = handle.promise().ok_or_else(unreached)?;
        promise.change(self.inner.promised(&wanted))?;
        if let Err(error) = container
            .set_limits(engine_limits(&with_weight(change)))
            .await
        {
            // What the kernel took of it before it refused the rest is taken back.
            let earlier = engine_limits(&before.or(handle.limits()));
            let _ = container.set_limits(earlier).await;
            let _ = promise.change(self.inner.promised(&before));
            return Err(error.into());
        }
        handle.set_asked(wanted);
        self.inner.state.set_servant_limits(id, &wanted)?;
        let message = format!(
            "servant {id}: limits changed to {}",
            in_words(&limits_of(&container.enforced().limits))
        );
        self.inner
            .journal
            .info("limits-changed", &message, &handle.about());
        Ok(())
    }
}

/// Limits for people, by the names of the flags that set them.
fn in_words(limits: &api::Limits) -> String {
    let named = [
        ("cpus", limits.cpus.map(|cpus| cpus.to_string())),
        ("cpu-weight", limits.cpu_weight.map(|n| n.to_string())),
        ("cpuset", limits.cpuset.map(|cores| cores.to_string())),
        ("memory", limits.memory.map(|bytes| bytes.to_string())),
        ("memory-high", limits.memory_high.map(|n| n.to_string())),
        ("pids", limits.pids.map(|pids| pids.to_string())),
        ("io-read", limits.io_read.map(|bytes| bytes.to_string())),
        ("io-write", limits.io_write.map(|bytes| bytes.to_string())),
    ];
    let set = named
        .into_iter()
        .filter_map(|(name, value)| Some(format!("{name} {}", value?)));
    set.collect::<Vec<_>>().join(", ")
}
