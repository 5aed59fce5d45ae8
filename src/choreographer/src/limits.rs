//! Limits that may not be requested.

use api::limits::UnusableLimits;

use crate::decide::demand;

/// Refuses a weight that only an operator may set: more than the weight of the promised cores.
pub fn check_weight(limits: &api::Limits) -> Result<(), UnusableLimits> {
    let most = demand::max_weight(limits);
    match limits.cpu_weight {
        Some(weight) if weight > most => Err(UnusableLimits::new(format!(
            "cpu_weight = {weight} is more than the maximum {most}: 1000 per core requested with cpus, 100 without; \
                request more cores, or ask an operator to raise it with cloudroidctl set"
        ))),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_weight_beyond_the_promise_is_refused_with_the_way_to_more() {
        let asking = |cpus, cpu_weight| api::Limits { cpus, cpu_weight: Some(cpu_weight), ..api::Limits::default() };
        for (cpus, weight, is_refused) in
            [(None, 100, false), (None, 101, true), (Some(2.0), 2000, false), (Some(2.0), 2001, true)]
        {
            let outcome = check_weight(&asking(cpus, weight));
            assert_eq!(outcome.is_err(), is_refused, "{cpus:?} {weight}");
        }
        let refused = check_weight(&asking(None, 10_000)).unwrap_err().to_string();
        assert!(refused.contains("an operator"), "{refused}");
        assert_eq!(check_weight(&api::Limits::default()), Ok(()));
    }
}
