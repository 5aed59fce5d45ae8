//! Conversion of limits between the API and the engine, and their validation.

use crate::decide::demand;

/// Converts limits to the API's type.
pub(crate) fn to_api_limits(limits: &servant::spec::ResourceLimits) -> api::Limits {
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

/// Converts limits to the engine's type.
pub fn engine_limits(limits: &api::Limits) -> servant::spec::ResourceLimits {
    servant::spec::ResourceLimits {
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

/// The error of limits that no kernel accepts, or that may not be requested.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct UnusableLimits(String);

/// Refuses a weight that only an operator may set: more than the weight of the promised cores.
pub fn check_weight(limits: &api::Limits) -> Result<(), UnusableLimits> {
    let most = demand::max_weight(limits);
    match limits.cpu_weight {
        Some(weight) if weight > most => Err(UnusableLimits(format!(
            "cpu_weight = {weight} is more than the maximum {most}: 1000 per core requested with cpus, 100 without; \
                request more cores, or ask an operator to raise it with cloudroidctl set"
        ))),
        _ => Ok(()),
    }
}

/// Refuses limits that no kernel accepts.
pub fn check(limits: &api::Limits) -> Result<(), UnusableLimits> {
    let refused = |words: String| Err(UnusableLimits(words));
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
            "memory = {memory} is too little for any node; write at least 4M"
        ));
    }
    for (name, limit) in [
        ("memory_high", limits.memory_high),
        ("io_read", limits.io_read),
        ("io_write", limits.io_write),
    ] {
        if limit == Some(api::Size(0)) {
            return refused(format!(
                "{name} = 0 would stop the servant; omit it for no limit"
            ));
        }
    }
    if let Some(pids) = limits.pids
        && pids < 4
    {
        return refused(format!(
            "pids = {pids} is too few for any node; write at least 4"
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_weight_beyond_the_promise_is_refused_with_the_way_to_more() {
        let asking = |cpus, cpu_weight| api::Limits {
            cpus,
            cpu_weight: Some(cpu_weight),
            ..api::Limits::default()
        };
        for (cpus, weight, is_refused) in [
            (None, 100, false),
            (None, 101, true),
            (Some(2.0), 2000, false),
            (Some(2.0), 2001, true),
        ] {
            let outcome = check_weight(&asking(cpus, weight));
            assert_eq!(outcome.is_err(), is_refused, "{cpus:?} {weight}");
        }
        let refused = check_weight(&asking(None, 10_000)).unwrap_err().to_string();
        assert!(refused.contains("an operator"), "{refused}");
        assert_eq!(check_weight(&api::Limits::default()), Ok(()));
    }
}
