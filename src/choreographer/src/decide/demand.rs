//! What a servant needs: from the limits that somebody asked for to the limits that it gets and to what is promised to it.

use api::{Limits, Terms};

use super::Amount;

/// The weight of a servant that is promised no cores: the kernel's default.
const LEAST_WEIGHT: u64 = 100;

/// Limits of a servant, and where they come from.
#[derive(Debug, Clone)]
pub struct Asked {
    /// By the operator, of the servant at work: a promise.
    pub set: Limits,
    /// By its robot and by whoever pushed the package: a promise.
    pub terms: Terms,
    /// Where they said nothing.
    pub default: Limits,
}

impl Asked {
    /// Those that are promised to it.
    pub fn promised(&self) -> Limits {
        self.set.or(self.terms.limits)
    }

    /// The limits that it is to have.
    pub fn limits(&self) -> Limits {
        with_weight(self.promised()).or(self.default)
    }
}

/// Whoever is promised cores gets them before those who are not: a weight of a thousand for each core, where others have
/// a hundred in all, unless a weight was asked for.
pub fn with_weight(asked: Limits) -> Limits {
    Limits {
        cpu_weight: asked.cpu_weight.or(asked.cpus.map(weight_of)),
        ..asked
    }
}

/// These limits with no more weight than cores are promised by them: what a deployer asks for may not outweigh what others are
/// promised.
pub fn with_bounded_weight(asked: Limits) -> Limits {
    Limits {
        cpu_weight: asked
            .cpu_weight
            .map(|weight| weight.min(most_weight(&asked))),
        ..asked
    }
}

/// The most weight that these limits may have without an operator's word.
pub fn most_weight(asked: &Limits) -> u64 {
    asked.cpus.map_or(LEAST_WEIGHT, weight_of)
}

fn weight_of(cpus: f64) -> u64 {
    ((cpus * 1000.0).round() as u64).clamp(LEAST_WEIGHT, 10_000)
}

/// What of the machine is promised to a servant of these limits: what they say, else of `reserve`, which is cores and
/// bytes.
pub fn promised(asked: &Limits, reserve: (f64, u64)) -> Amount {
    Amount::new(
        asked.cpus.unwrap_or(reserve.0),
        asked.memory.map_or(reserve.1, |memory| memory.0),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_promise_of_cores_weighs_more_than_none() {
        let weight = |cpus, cpu_weight| {
            let asked = Limits {
                cpus,
                cpu_weight,
                ..Limits::default()
            };
            with_weight(asked).cpu_weight
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
            let asked = Limits {
                cpus,
                cpu_weight: asked,
                ..Limits::default()
            };
            assert_eq!(with_bounded_weight(asked).cpu_weight, gets, "{asked:?}");
        }
    }

    #[test]
    fn limits_that_were_asked_for_are_promised_and_others_reserved() {
        let reserve = (0.25, 64);
        let of = |cpus, memory: Option<u64>| Limits {
            cpus,
            memory: memory.map(api::Size),
            ..Limits::default()
        };
        for (cpus, memory, gets) in [
            (None, None, Amount::new(0.25, 64)),
            (Some(2.0), None, Amount::new(2.0, 64)),
            (None, Some(9), Amount::new(0.25, 9)),
            (Some(0.1), Some(0), Amount::new(0.1, 0)),
        ] {
            assert_eq!(promised(&of(cpus, memory), reserve), gets);
        }
    }
}
