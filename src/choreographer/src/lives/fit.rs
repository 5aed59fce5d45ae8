//! Predicts whether one more servant would fit: collects the facts for [`decide::fit`](crate::decide::fit).

use std::collections::{BTreeMap, HashMap};
use std::time::Duration;

use api::Measure;
use futures_util::future::join_all;
use tokio::time::Instant;

use super::controller::{read_usage, response_goal, usage_rates};
use super::warm_facts;
use crate::decide::Amount;
use crate::decide::controller::{MeasuredTimes, ResponseGoal};
use crate::decide::fit::{Fit, Neighbour, fit, forecast_by_use};
use crate::{Choreographer, Error};

/// Duration of sampling the usage of others.
const LOOKS: Duration = Duration::from_millis(300);

impl Choreographer {
    /// Predicts how one more servant of a service, for a robot with this statement, would fit beside the live ones.
    pub async fn fit(&self, service: &str, stated: api::Stated) -> Result<api::Fit, Error> {
        let inner = &self.inner;
        let revision = inner.catalogue.current_revision(service)?;
        let stated = if stated.is_empty() { BTreeMap::new() } else { [(String::new(), stated)].into() };
        let terms = inner.terms(&stated, &revision)?;
        let priority = terms.priority;
        let expected = terms.rows.iter().find(|row| row.measure == Measure::Rrt);
        let expected =
            expected.map(|row| api::Expected { rrt: row.value, from: format!("entry {} of the SLA table", row.id) });
        let shared = revision.plan.shared.is_some();
        // A group's servants belong to no robot.
        let asked = if shared { inner.push_limits(&revision) } else { inner.limit_sources(terms) };
        let uses = self.measure_uses().await;
        let warm = inner.warm_pool.promised_servants(inner);
        let servants = inner.servants.lock();
        let now = Instant::now().into_std();
        let of_robots = servants.all.values().filter(|handle| !handle.is_place());
        let neighbours = of_robots.clone().map(|handle| Neighbour {
            servant: inner.facts(handle),
            uses: uses.get(&handle.id).copied().unwrap_or_default(),
            measured: inner.recent.p95(&handle.id, now),
        });
        let ahead = warm_facts(&warm).map(|servant| Neighbour { servant, uses: 0, measured: None });
        let others: Vec<Neighbour<'_>> = ahead.chain(neighbours).collect();
        let of_service = of_robots.filter(|handle| handle.service() == service);
        let group = of_service.clone().filter(|handle| !handle.is_ending());
        let group = shared.then(|| group.count() as u64);
        let used_by_service: Vec<u64> = of_service.clone().filter_map(|handle| uses.get(&handle.id).copied()).collect();
        let measured = of_service.filter_map(|handle| inner.recent.p95(&handle.id, now));
        let expected = expected.or_else(|| expected_from_others(service, measured));
        let book = inner.admission.ledger();
        let wanted = match group {
            // One more robot shares the existing servants.
            Some(1..) => Amount::NONE,
            _ => inner.promised_amount(&asked.promised_limits()),
        };
        let cores = (inner.options.cores * 1000.0).round() as u64;
        let fit = match group {
            Some(1..) => Fit::NOTHING,
            _ => fit((wanted, priority), &book, cores, &others),
        };
        let used: u64 = uses.values().sum();
        let by_use = forecast_by_use(&used_by_service, used, cores, fit.more);
        let unused = cores.saturating_sub(used);
        let has_cores = shared || asked.promised_limits().cpus.is_some();
        let cores = |millicpus: u64| millicpus as f64 / 1000.0;
        let (waiting, free) = (book.waiting_count(), book.capacity().minus(book.promised_total()));
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
                accepts: response_goal(inner, handle).and_then(ResponseGoal::upper_bound).map(seconds),
            })
        });
        Ok(api::Fit {
            cpus: wanted.cpus(),
            memory: api::Size(wanted.memory),
            free_cpus: free.cpus(),
            free_memory: api::Size(free.memory),
            waiting,
            stalled: book.stall_reason().map(str::to_owned),
            never: book.check(wanted).err().map(|refused| refused.to_string()),
            full: book.full_queue_len().filter(|_| !fit.now).is_some(),
            now: fit.now,
            ends: fit.ends,
            lacking_cpus: fit.lacking.cpus(),
            lacking_memory: api::Size(fit.lacking.memory),
            costs: costs.collect(),
            more: fit.more,
            beyond_cpus: fit.beyond.cpus(),
            beyond_memory: api::Size(fit.beyond.memory),
            at_present_use: (!has_cores).then(|| api::UseForecast {
                unused_cpus: cores(unused),
                cpus: by_use.map(|found| cores(found.uses)),
                more: by_use.map(|found| found.more),
            }),
            expected,
            shared: group,
        })
    }

    /// Samples the cores that each servant uses now, in thousandths, by id.
    async fn measure_uses(&self) -> HashMap<String, u64> {
        let all = self.servants().into_iter();
        let looking = all.filter_map(|handle| {
            let container = handle.container()?;
            Some(async move {
                let before = read_usage(&container).await?;
                let began = Instant::now();
                tokio::time::sleep(LOOKS).await;
                let after = read_usage(&container).await?;
                let (used, _) = usage_rates(&before, &after, began.elapsed())?;
                Some((handle.id.clone(), used))
            })
        });
        join_all(looking).await.into_iter().flatten().collect()
    }
}

/// Returns the expected response time: the median over robots of the same service.
fn expected_from_others(service: &str, measured: impl Iterator<Item = MeasuredTimes>) -> Option<api::Expected> {
    let mut totals: Vec<f64> = measured.map(|measured| measured.total).collect();
    totals.sort_unstable_by(f64::total_cmp);
    let median = totals.get(totals.len() / 2)?;
    let robots = match totals.len() {
        1 => "the robot".to_owned(),
        count => format!("{count} robots"),
    };
    Some(api::Expected { rrt: median / 1000.0, from: format!("recent measurements of {robots} of {service}") })
}
