//! Whether one more servant would fit: collects the facts for [`decide::fit`](crate::decide::fit).

use std::collections::{BTreeMap, HashMap};
use std::time::Duration;

use api::Measure;
use futures_util::future::join_all;
use tokio::time::Instant;

use super::controller::{goal, rates_of, usage};
use super::warm_facts;
use crate::decide::Amount;
use crate::decide::controller::{Goal, Measured};
use crate::decide::fit::{Fit, Neighbour, fit};
use crate::{Choreographer, Error};

/// How long is looked at what others use.
const LOOKS: Duration = Duration::from_millis(300);

impl Choreographer {
    /// How one more servant of a service, for a robot that states this, would fit beside those that live now.
    pub async fn fit(&self, service: &str, stated: api::Stated) -> Result<api::Fit, Error> {
        let inner = &self.inner;
        let revision = inner.catalogue.current(service)?;
        let stated = match stated.is_empty() {
            true => BTreeMap::new(),
            false => [(String::new(), stated)].into(),
        };
        let terms = inner.terms(&stated, &revision)?;
        let priority = terms.priority;
        let expected = terms.rows.iter().find(|row| row.measure == Measure::Rrt);
        let expected = expected.map(|row| api::Expected {
            rrt: row.value,
            from: format!("row {} of the dictionary", row.id),
        });
        let shared = revision.plan.shared.is_some();
        // A group's servants are no robot's.
        let asked = match shared {
            true => inner.of_push(&revision),
            false => inner.asked(terms),
        };
        let uses = self.uses().await;
        let warm = inner.warm_pool.promised(inner);
        let servants = inner.servants.lock();
        let now = Instant::now().into_std();
        let of_robots = servants.all.values().filter(|handle| !handle.is_place());
        let neighbours = of_robots.clone().map(|handle| Neighbour {
            servant: inner.facts(handle),
            uses: uses.get(&handle.id).copied().unwrap_or_default(),
            measured: inner.recent.of(&handle.id, now),
        });
        let ahead = warm_facts(&warm).map(|servant| Neighbour {
            servant,
            uses: 0,
            measured: None,
        });
        let others: Vec<Neighbour<'_>> = ahead.chain(neighbours).collect();
        let of_service = of_robots.filter(|handle| handle.service() == service);
        let group = of_service.clone().filter(|handle| !handle.is_ending());
        let group = shared.then(|| group.count() as u64);
        let measured = of_service.filter_map(|handle| inner.recent.of(&handle.id, now));
        let expected = expected.or_else(|| as_others(service, measured));
        let book = inner.admission.book();
        let wanted = match group {
            // One more robot is one more of theirs.
            Some(1..) => Amount::NONE,
            _ => inner.promised(&asked.promised()),
        };
        let cores = (inner.options.cores * 1000.0).round() as u64;
        let fit = match group {
            Some(1..) => Fit::NOTHING,
            _ => fit((wanted, priority), &book, cores, &others),
        };
        let cores = |millicpus: u64| millicpus as f64 / 1000.0;
        let (waiting, free) = (book.waiting(), book.capacity().minus(book.promised()));
        let costs = fit.costs.into_iter().filter_map(|cost| {
            let handle = servants.all.get(&cost.id)?;
            let seconds = |milliseconds: f64| milliseconds / 1000.0;
            Some(api::Cost {
                robot: handle.robot.clone(),
                service: handle.service().to_owned(),
                servant: cost.id,
                cpus: cores(cost.uses),
                left: cores(cost.left),
                rrt: cost.times.map(|(now, _)| seconds(now)),
                later: cost.times.map(|(_, then)| seconds(then)),
                accepts: goal(inner, handle).and_then(Goal::bound).map(seconds),
            })
        });
        Ok(api::Fit {
            cpus: wanted.cpus(),
            memory: api::Size(wanted.memory),
            free_cpus: free.cpus(),
            free_memory: api::Size(free.memory),
            waiting,
            stalled: book.stalled().map(str::to_owned),
            never: book.check(wanted).err().map(|refused| refused.to_string()),
            full: book.full().filter(|_| !fit.now).is_some(),
            now: fit.now,
            ends: fit.ends,
            lacking_cpus: fit.lacking.cpus(),
            lacking_memory: api::Size(fit.lacking.memory),
            costs: costs.collect(),
            more: fit.more,
            beyond_cpus: fit.beyond.cpus(),
            beyond_memory: api::Size(fit.beyond.memory),
            expected,
            shared: group,
        })
    }

    /// Thousandths of a core that each servant uses now, by id.
    async fn uses(&self) -> HashMap<String, u64> {
        let all = self.servants().into_iter();
        let looking = all.filter_map(|handle| {
            let container = handle.container()?;
            Some(async move {
                let before = usage(&container).await?;
                let began = Instant::now();
                tokio::time::sleep(LOOKS).await;
                let after = usage(&container).await?;
                let (used, _) = rates_of(&before, &after, began.elapsed())?;
                Some((handle.id.clone(), used))
            })
        });
        join_all(looking).await.into_iter().flatten().collect()
    }
}

/// What robots of the same service wait for their answers now: the median of them.
fn as_others(service: &str, measured: impl Iterator<Item = Measured>) -> Option<api::Expected> {
    let mut totals: Vec<f64> = measured.map(|measured| measured.total).collect();
    totals.sort_unstable_by(f64::total_cmp);
    let median = totals.get(totals.len() / 2)?;
    let robots = match totals.len() {
        1 => "the robot".to_owned(),
        count => format!("{count} robots"),
    };
    Some(api::Expected {
        rrt: median / 1000.0,
        from: format!("what {robots} of {service} measured lately"),
    })
}
