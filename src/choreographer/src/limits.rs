//! Limits as the API has them, as the engine takes them, and those that no kernel takes.

use crate::decide::demand;

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

/// Limits that no kernel takes, or that may not be asked for.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Unusable(String);

/// Refuses a weight that only an operator may give: of more than the cores that these limits promise.
pub fn check_weight(limits: &api::Limits) -> Result<(), Unusable> {
    let most = demand::most_weight(limits);
    match limits.cpu_weight {
        Some(weight) if weight > most => Err(Unusable(format!(
            "cpu_weight = {weight} is more than {most}, which is the most here: 1000 for each core asked for with cpus, \
             100 without; ask for more cores, or have an operator give more by cloudroidctl set"
        ))),
        _ => Ok(()),
    }
}

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
