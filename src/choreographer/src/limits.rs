//! Limits as the API has them, as the engine takes them, and those that no kernel takes.

/// Limits as the API shows them.
pub(crate) fn limits_of(limits: &servant::spec::Limits) -> api::Limits {
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
