//! The task that makes and ends warm containers, as is decided from what robots asked for.

use std::sync::Arc;

use catalogue::names;
use futures_util::FutureExt;
use futures_util::future::join_all;
use tokio::time::Instant;

use super::{LEAD, NOBODY, UNMADE, Warm};
use crate::Error;
use crate::decide::forecast::INTERVAL;
use crate::decide::warm_pool::{
    Budget, Demand, Missing, Wanted, Warm as Facts, deserving, missing, sizes, stale,
};
use crate::lives::{Inner, reaching, starting};
use store::{NewEvent, RevisionRecord, ServantRecord};

/// Makes and ends warm containers as they are needed, for ever.
pub(crate) async fn keep(inner: Arc<Inner>) {
    loop {
        tokio::select! {
            () = inner.warm_pool.look.notified() => {}
            () = tokio::time::sleep(INTERVAL), if inner.warm_pool.is_restless(&inner) => {}
        }
        if let Err(error) = tidy(&inner, true).await {
            tracing::warn!("no warm container could be made: {error}");
        }
    }
}

/// What the services are to have: of the revisions that robots are given, the most deserving first.
fn wanted(inner: &Inner) -> Result<Vec<(Arc<RevisionRecord>, Demand)>, Error> {
    let mut wanted = Vec::new();
    let published = inner.state.service_names()?;
    let now = Instant::now().into_std();
    let asked_for = inner.warm_pool.kept.lock().asked_for.clone();
    for service in deserving(&published, &asked_for, inner.options.warm_pool) {
        let Some(revision) = inner.state.current(&service)? else {
            continue;
        };
        let kept = inner.warm_pool.kept.lock();
        let arrivals = kept.arrivals.get(&service);
        let lead = kept.leads.get(&service);
        let demand = Demand {
            rate: arrivals.map_or(0.0, |arrivals| arrivals.expected(now)),
            lead: lead.map_or(LEAD, |lead| lead.mean),
            nodes: runs_ahead(inner, &revision)
                .then(|| inner.promised(&revision.plan.limits).memory),
        };
        wanted.push((revision, demand));
    }
    for (service, number) in inner.rollouts.candidates() {
        let of = |wanted: &(Arc<RevisionRecord>, Demand)| wanted.0.service == service;
        let demand = wanted.iter().find(|it| of(it)).map(|it| it.1);
        if let (Some(demand), Some(revision)) = (demand, inner.state.revision(&service, number)?) {
            // Few robots get it: one is enough.
            wanted.push((
                revision,
                Demand {
                    rate: 0.0,
                    ..demand
                },
            ));
        }
    }
    Ok(wanted)
}

/// Whether the revision's nodes may run without a robot: not with what they would hold from another servant, nor while they
/// fail.
fn runs_ahead(inner: &Inner, revision: &RevisionRecord) -> bool {
    let grants = &revision.plan.grants;
    let holds = !grants.devices.is_empty() || !grants.volumes.is_empty();
    let failing = inner.back_offs.refusal(&revision.service, NOBODY, revision);
    // Where no container can be made, others' nodes run.
    let unmade = inner
        .back_offs
        .is_failing(&revision.service, UNMADE, revision);
    let shared = revision.plan.shared.is_some();
    !revision.plan.nodes.is_empty() && !holds && !shared && failing.is_none() && !unmade
}

/// Ends those that are not wanted any more and makes, if so told, those that are missing.
pub(crate) async fn tidy(inner: &Arc<Inner>, make_missing: bool) -> Result<(), Error> {
    let pool = &inner.warm_pool;
    let _turn = pool.turn.lock().await;
    let revisions = wanted(inner)?;
    let demands: Vec<Demand> = revisions.iter().map(|(_, demand)| *demand).collect();
    let budget = Budget {
        memory: inner.options.warm_memory,
        nodes: inner.options.warm_nodes,
    };
    let sizes = sizes(&demands, budget);
    let wanted: Vec<Wanted<'_>> = revisions
        .iter()
        .zip(sizes)
        .map(|((revision, _), size)| Wanted {
            service: &revision.service,
            revision: revision.number,
            image: &revision.image,
            size,
        })
        .collect();
    let removed: Vec<Warm> = {
        let mut kept = pool.kept.lock();
        let facts: Vec<Facts<'_>> = kept.pool.iter().map(Warm::facts).collect();
        let ends = stale(&facts, &wanted);
        let ends: Vec<String> = ends.iter().map(|end| end.id.to_owned()).collect();
        // A service that is to have none any more.
        kept.leads
            .retain(|service, _| wanted.iter().any(|it| it.service == service));
        let removed: Vec<Warm> = ends.iter().filter_map(|id| kept.take(id)).collect();
        for warm in &removed {
            let promised = warm.promised(inner).unwrap_or_default();
            let id = warm.container.id().to_owned();
            kept.ending.insert(id, promised);
        }
        removed
    };
    for warm in &removed {
        report_dead(inner, warm).await;
    }
    join_all(removed.into_iter().map(|warm| warm.end(inner))).await;
    if !make_missing {
        return Ok(());
    }
    for ((revision, _), wanted) in revisions.iter().zip(&wanted) {
        loop {
            let lacks = {
                let mut kept = pool.kept.lock();
                let facts: Vec<Facts<'_>> = kept.pool.iter().map(Warm::facts).collect();
                let lacks = match missing(&facts, wanted) {
                    Missing::Nothing => None,
                    Missing::Containers(_) => Some(None),
                    Missing::Nodes(id) => Some(Some(id.to_owned())),
                };
                if let (None | Some(Some(_)), Some(lead)) =
                    (&lacks, kept.leads.get_mut(wanted.service))
                {
                    lead.complete();
                }
                lacks
            };
            let Some(nodes_of) = lacks.filter(|_| !inner.is_ending()) else {
                break;
            };
            let warm = match nodes_of {
                // Others are made all the same.
                None => match make_or_tell(inner, revision).await {
                    Some(warm) => warm,
                    None => break,
                },
                // Capacity is not there, or somebody took it meanwhile.
                Some(id) => match heat(inner, &id).await {
                    Some(warm) => warm,
                    None => break,
                },
            };
            let fresh = !warm.nodes;
            if let Some(unwanted) = pool.put(warm) {
                unwanted.end(inner).await;
                break;
            }
            if !fresh {
                // Whoever began to wait while the nodes were started did not find what is promised to them.
                inner.make_room();
            }
            if fresh && let Some(lead) = pool.kept.lock().leads.get_mut(&revision.service) {
                lead.replaced(Instant::now());
            }
        }
    }
    Ok(())
}

/// Of one whose nodes have failed before a robot had them: that is told, and counts as a servant's failure.
async fn report_dead(inner: &Inner, warm: &Warm) {
    if !warm.nodes || warm.runs() {
        return;
    }
    let service = &warm.revision.service;
    let mut how = "it ended".to_owned();
    for node in &warm.revision.plan.nodes {
        if let Some(Ok(exit)) = warm.container.wait_node(&node.name).now_or_never() {
            let limits = warm.limits;
            how = format!("{} {}", node.name, reach::how_it_ended(&exit, &limits));
        }
    }
    let about = NewEvent {
        service: Some(service),
        ..NewEvent::default()
    };
    let message = format!("a servant of {service} that was kept ready for a robot failed: {how}");
    inner.journal.warning("warm-failed", &message, &about);
    let back_offs = &inner.back_offs;
    back_offs.failed(
        service,
        NOBODY,
        &warm.revision,
        None,
        &format!("lost {how}"),
    );
}

/// A container, unless those of its service cannot be made; then that is told, and tried again after a pause.
async fn make_or_tell(inner: &Arc<Inner>, revision: &Arc<RevisionRecord>) -> Option<Warm> {
    let (service, back_offs) = (&revision.service, &inner.back_offs);
    if back_offs.refusal(service, UNMADE, revision).is_some() {
        return None;
    }
    match make(inner, Arc::clone(revision)).await {
        Ok(warm) => {
            back_offs.recovered(service, UNMADE);
            Some(warm)
        }
        Err(error) => {
            let about = NewEvent {
                service: Some(service),
                ..NewEvent::default()
            };
            let message =
                format!("no servant of {service} can be made before its robot comes: {error}");
            inner.journal.warning("warm-failed", &message, &about);
            let reason = format!("could not be made ahead: {error}");
            back_offs.failed(service, UNMADE, revision, None, &reason);
            None
        }
    }
}

async fn make(inner: &Arc<Inner>, revision: Arc<RevisionRecord>) -> Result<Warm, Error> {
    let id = names::servant_id(&revision.service);
    let limits = inner.of_push(&revision).limits();
    let spec = starting::spec(inner, &id, &revision, &limits, Vec::new())?;
    let container = inner.engine.start(spec).await?;
    let limit = inner.options.start;
    let reached = tokio::time::timeout(limit, reaching::open(inner, &revision, &container)).await;
    match reached {
        Ok(Ok(reach)) => Ok(Warm {
            container,
            reach,
            limits,
            nodes: false,
            permit: None,
            revision,
        }),
        failed => {
            container.stop().await?;
            tracing::debug!(
                "warm container {id}: {:?}",
                failed.map(|reached| reached.err())
            );
            Err(Error::Internal("reaching a warm container's ROS Master"))
        }
    }
}

/// Starts the nodes in one of the pool, which is in nobody's reach meanwhile. What they may use is promised from here on, where
/// it is free and nobody waits for it.
async fn heat(inner: &Arc<Inner>, id: &str) -> Option<Warm> {
    let mut warm = inner.warm_pool.kept.lock().take(id)?;
    let revision = Arc::clone(&warm.revision);
    let wanted = inner.promised(&revision.plan.limits);
    let Some(permit) = inner.admission.admit_now(wanted) else {
        if let Some(unwanted) = inner.warm_pool.put(warm) {
            unwanted.end(inner).await;
        }
        return None;
    };
    let record = ServantRecord {
        id: id.to_owned(),
        service: revision.service.clone(),
        revision: revision.number,
        robot: NOBODY.to_owned(),
        anonymous: true,
        created: store::now(),
        limits: api::Limits::default(),
        terms: None,
    };
    warm.permit = Some(permit);
    // A daemon that is killed now finds out by this that nobody misses it.
    let recorded = inner.state.add_servant(&record);
    warm.nodes = true;
    let nodes = revision.plan.nodes.iter().cloned();
    let started = join_all(nodes.map(|node| warm.container.start_node(node))).await;
    if recorded.is_err() || started.iter().any(Result::is_err) {
        let (service, reason) = (&revision.service, "could not be started");
        inner
            .back_offs
            .failed(service, NOBODY, &revision, None, reason);
        warm.end(inner).await;
        return None;
    }
    Some(warm)
}

/// Takes a warm container back that its robot left unused, or ends it.
pub(crate) async fn give_back(inner: &Inner, warm: Warm) {
    if let Some(unwanted) = inner.warm_pool.put(warm) {
        unwanted.end(inner).await;
    }
}

/// Ends all of them and makes no more.
pub(crate) async fn end_all(inner: &Inner) {
    let all = {
        let mut kept = inner.warm_pool.kept.lock();
        kept.closed = true;
        std::mem::take(&mut kept.pool)
    };
    join_all(all.into_iter().map(|warm| warm.end(inner))).await;
    // One that is being made just now is ended by whoever makes it.
    let _turn = inner.warm_pool.turn.lock().await;
}
