//! The limits of a servant: changed while it works, for people, for the engine.

use super::{Choreographer, Error, handle};

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
        promise.change(self.inner.promised_for(&wanted))?;
        if let Err(error) = container
            .set_limits(engine_limits(&handle::with_weight(change)))
            .await
        {
            // What the kernel took of it before it refused the rest is taken back.
            let earlier = engine_limits(&before.or(handle.limits()));
            let _ = container.set_limits(earlier).await;
            let _ = promise.change(self.inner.promised_for(&before));
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

/// Limits as the API shows them.
pub(super) fn limits_of(limits: &servant::spec::Limits) -> api::Limits {
    api::Limits {
        cpus: limits.cpus,
        cpu_weight: limits.cpu_weight,
        memory: limits.memory.map(api::Size),
        memory_high: limits.memory_high.map(api::Size),
        pids: limits.pids,
        io_read: limits.io_read.map(api::Size),
        io_write: limits.io_write.map(api::Size),
        cpuset: limits.cpuset.map(api::CpuSet),
    }
}

/// Limits as the engine takes them.
pub fn engine_limits(limits: &api::Limits) -> servant::spec::Limits {
    servant::spec::Limits {
        cpus: limits.cpus,
        cpu_weight: limits.cpu_weight,
        memory: limits.memory.map(|memory| memory.0),
        memory_high: limits.memory_high.map(|memory| memory.0),
        pids: limits.pids,
        io_read: limits.io_read.map(|bytes| bytes.0),
        io_write: limits.io_write.map(|bytes| bytes.0),
        cpuset: limits.cpuset.map(|set| set.0),
    }
}

/// Limits that no kernel takes.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Unusable(String);

/// Refuses limits that no kernel takes.
pub fn check(limits: &api::Limits) -> Result<(), Unusable> {
    let refused = |words: String| Err(Unusable(words));
    if let Some(cpus) = limits.cpus
        && !(cpus.is_finite() && (0.01..=4096.0).contains(&cpus))
    {
        return refused(format!("cpus = {cpus} is not between 0.01 and 4096"));
    }
    if let Some(weight) = limits.cpu_weight
        && !(1..=10_000).contains(&weight)
    {
        return refused(format!("cpu_weight = {weight} is not between 1 and 10000"));
    }
    if let Some(memory) = limits.memory
        && memory.0 < 4 << 20
    {
        return refused(format!(
            "memory = {memory} is too little for any node; at least 4M"
        ));
    }
    for (name, limit) in [
        ("memory_high", limits.memory_high),
        ("io_read", limits.io_read),
        ("io_write", limits.io_write),
    ] {
        if limit == Some(api::Size(0)) {
            return refused(format!(
                "{name} = 0 would stop the servant; leave it out for no limit"
            ));
        }
    }
    if let Some(pids) = limits.pids
        && pids < 4
    {
        return refused(format!("pids = {pids} is too few for any node; at least 4"));
    }
    Ok(())
}
