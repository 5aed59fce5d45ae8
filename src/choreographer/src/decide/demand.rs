//! Derives a servant's limits and its promise from the requested limits.

use api::{Limits, Terms};

use super::Amount;

/// Weight of a servant without promised cores: the kernel's default.
const LEAST_WEIGHT: u64 = 100;

/// Limits of a servant by their source.
#[derive(Debug, Clone)]
pub struct LimitSources {
    /// Set by the operator at run time; promised.
    pub set: Limits,
    /// Set by its robot and by the push of its package; promised.
    pub terms: Terms,
    /// Defaults for the rest.
    pub default: Limits,
}

impl LimitSources {
    /// Returns the promised limits.
    pub fn promised_limits(&self) -> Limits {
        self.set.or(self.terms.limits)
    }

    /// Returns the limits that it is to have.
    pub fn limits(&self) -> Limits {
        with_default_weight(self.promised_limits()).or(self.default)
    }
}

/// Adds the default weight of servants with promised cores, which get them before others: a thousand for each core,
/// while others have a hundred in all. A requested weight stays.
pub fn with_default_weight(asked: Limits) -> Limits {
    Limits { cpu_weight: asked.cpu_weight.or(asked.cpus.map(weight_for_cpus)), ..asked }
}

/// Bounds the weight to the one of the promised cores, so that a deployer's service does not outweigh the promises to
/// others.
pub fn with_bounded_weight(asked: Limits) -> Limits {
    Limits { cpu_weight: asked.cpu_weight.map(|weight| weight.min(max_weight(&asked))), ..asked }
}

/// Returns the maximum weight of these limits without an operator's permission.
pub fn max_weight(asked: &Limits) -> u64 {
    asked.cpus.map_or(LEAST_WEIGHT, weight_for_cpus)
}

fn weight_for_cpus(cpus: f64) -> u64 {
    ((cpus * 1000.0).round() as u64).clamp(LEAST_WEIGHT, 10_000)
}

/// Returns the capacity promised to a servant with these limits; resources without a limit are taken from `reserve`,
/// which is cores and bytes.
pub fn promised_amount(asked: &Limits, reserve: (f64, u64)) -> Amount {
    Amount::new(asked.cpus.unwrap_or(reserve.0), asked.memory.map_or(reserve.1, |memory| memory.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_promise_of_cores_weighs_more_than_none() {
        let weight = |cpus, cpu_weight| {
            let asked = Limits { cpus, cpu_weight, ..Limits::default() };
            with_default_weight(asked).cpu_weight
        };
        for (cpus, asked, gets) in [
            (None, None, None),
            (Some(0.01), None, Some(100)),
            (Some(1.5), None, Some(1500)),
            (Some(64.0), None, Some(10_000)),
            (Some(1.5), Some(7), Some(7)),
            (None, Some(7), Some(7)),
        ] {
            assert_eq!(weight(cpus, asked), gets, "{cpus:?} {asked:?}");
        }
    }

    #[test]
    fn a_bounded_weight_is_what_its_cores_weigh_at_most() {
        for (cpus, asked, gets) in [
            (None, None, None),
            (None, Some(7), Some(7)),
            (None, Some(10_000), Some(100)),
            (Some(1.5), Some(10_000), Some(1500)),
            (Some(1.5), Some(7), Some(7)),
            (Some(1.5), None, None),
        ] {
            let asked = Limits { cpus, cpu_weight: asked, ..Limits::default() };
            assert_eq!(with_bounded_weight(asked).cpu_weight, gets, "{asked:?}");
        }
    }

    #[test]
    fn limits_that_were_asked_for_are_promised_and_others_reserved() {
        let reserve = (0.25, 64);
        let of = |cpus, memory: Option<u64>| Limits { cpus, memory: memory.map(api::Size), ..Limits::default() };
        for (cpus, memory, gets) in [
            (None, None, Amount::new(0.25, 64)),
            (Some(2.0), None, Amount::new(2.0, 64)),
            (None, Some(9), Amount::new(0.25, 9)),
            (Some(0.1), Some(0), Amount::new(0.1, 0)),
        ] {
            assert_eq!(promised_amount(&of(cpus, memory), reserve), gets);
        }
    }
}
