//! Whether one more servant would fit: collects the facts for [`decide::fit`](crate::decide::fit).

use crate::{Choreographer, Error};
use std::collections::{BTreeMap, HashMap};
use std::time::Duration;

use futures_util::future::join_all;
use tokio::time::Instant;

use super::controller::{rates_of, usage};
use crate::decide::fit::{Neighbour, fit};

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
        let limits = inner.asked(terms).promised();
        let uses = self.uses().await;
        let servants = inner.servants.lock();
        let others: Vec<Neighbour<'_>> = servants
            .all
            .values()
            .map(|handle| Neighbour {
                servant: inner.facts(handle),
                uses: uses.get(&handle.id).copied().unwrap_or_default(),
            })
            .collect();
        let book = inner.admission.book();
        let wanted = inner.promised(&limits);
        let cores = (inner.options.cores * 1000.0).round() as u64;
        let fit = fit(wanted, &book, cores, &others);
        let cores = |millicpus: u64| millicpus as f64 / 1000.0;
        let (waiting, free) = (book.waiting(), book.capacity().minus(book.promised()));
        Ok(api::Fit {
            cpus: wanted.cpus(),
            memory: api::Size(wanted.memory),
            free_cpus: free.cpus(),
            free_memory: api::Size(free.memory),
            waiting,
            stalled: book.stalled().map(str::to_owned),
            now: fit.now,
            ends: fit.ends,
            lacking_cpus: fit.lacking.cpus(),
            lacking_memory: api::Size(fit.lacking.memory),
            costs: fit
                .costs
                .into_iter()
                .map(|cost| {
                    let handle = servants.all.get(&cost.id);
                    api::Cost {
                        robot: handle
                            .map(|handle| handle.robot.clone())
                            .unwrap_or_default(),
                        service: handle
                            .map(|handle| handle.service().to_owned())
                            .unwrap_or_default(),
                        servant: cost.id,
                        cpus: cores(cost.uses),
                        left: cores(cost.left),
                    }
                })
                .collect(),
            more: fit.more,
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
