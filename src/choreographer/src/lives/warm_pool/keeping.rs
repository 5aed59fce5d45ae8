//! The task that makes and ends warm containers, depending on the requests of robots.

use std::sync::Arc;

use catalogue::names;
use futures_util::FutureExt;
use futures_util::future::join_all;
use tokio::time::Instant;
use tracing::Instrument;

use super::pool::{LEAD, WarmServant};
use super::{NOBODY, UNMADE};
use crate::Error;
use crate::decide::forecast::INTERVAL;
use crate::decide::warm_pool::{
    PoolBudget, PoolDemand, PoolShortage, WantedPool, WarmContainer as Facts, deserving_services, pool_shortage,
    pool_sizes, stale_containers,
};
use crate::lives::{ChoreographerInner, reaching, starting};
use store::{NewEvent, RevisionRecord, ServantRecord};

/// Makes and ends warm containers as needed, forever.
pub(crate) async fn run(inner: Arc<ChoreographerInner>) {
    loop {
        tokio::select! {
            () = inner.warm_pool.look.notified() => {}
            () = tokio::time::sleep(INTERVAL), if inner.warm_pool.needs_timer(&inner) => {}
        }
        if let Err(error) = tidy(&inner, true).await {
            tracing::warn!("cannot create a warm container: {error}");
        }
    }
}

/// Returns the revisions that are to have containers, with their demand, most deserving first.
fn wanted_revisions(inner: &ChoreographerInner) -> Result<Vec<(Arc<RevisionRecord>, PoolDemand)>, Error> {
    let mut wanted = Vec::new();
    let published = inner.state.service_names()?;
    let now = Instant::now().into_std();
    let asked_for = inner.warm_pool.kept.lock().asked_for.clone();
    for service in deserving_services(&published, &asked_for, inner.options.warm_pool) {
        let Some(revision) = inner.state.current_revision(&service)? else {
            continue;
        };
        let kept = inner.warm_pool.kept.lock();
        let arrivals = kept.arrivals.get(&service);
        let lead = kept.leads.get(&service);
        let demand = PoolDemand {
            rate: arrivals.map_or(0.0, |arrivals| arrivals.expected_rate(now)),
            lead: lead.map_or(LEAD, |lead| lead.mean),
            nodes: can_run_ahead(inner, &revision).then(|| inner.promised_amount(&revision.plan.limits).memory),
        };
        wanted.push((revision, demand));
    }
    for (service, number) in inner.rollouts.candidates() {
        let of = |wanted: &(Arc<RevisionRecord>, PoolDemand)| wanted.0.service == service;
        let demand = wanted.iter().find(|it| of(it)).map(|it| it.1);
        if let (Some(demand), Some(revision)) = (demand, inner.state.revision(&service, number)?) {
            // Few robots get it: one container is enough.
            wanted.push((revision, PoolDemand { rate: 0.0, ..demand }));
        }
    }
    Ok(wanted)
}

/// Returns true if the revision's nodes may run without a robot: not if they would occupy devices or volumes of another
/// servant, nor while they fail.
fn can_run_ahead(inner: &ChoreographerInner, revision: &RevisionRecord) -> bool {
    let grants = &revision.plan.grants;
    let holds = !grants.devices.is_empty() || !grants.volumes.is_empty();
    let failing = inner.back_offs.find_refusal(&revision.service, NOBODY, revision);
    // If no container can be made, other services' nodes run.
    let unmade = inner.back_offs.is_failing(&revision.service, UNMADE, revision);
    let shared = revision.plan.shared.is_some();
    !revision.plan.nodes.is_empty() && !holds && !shared && failing.is_none() && !unmade
}

/// Ends the containers that are not wanted any more and makes, if requested, the missing ones.
pub(crate) async fn tidy(inner: &Arc<ChoreographerInner>, make_missing: bool) -> Result<(), Error> {
    let pool = &inner.warm_pool;
    let _turn = pool.turn.lock().await;
    let revisions = wanted_revisions(inner)?;
    let demands: Vec<PoolDemand> = revisions.iter().map(|(_, demand)| *demand).collect();
    let budget = PoolBudget { memory: inner.options.warm_memory, nodes: inner.options.warm_nodes };
    let sizes = pool_sizes(&demands, budget);
    let wanted: Vec<WantedPool<'_>> = revisions
        .iter()
        .zip(sizes)
        .map(|((revision, _), size)| WantedPool {
            service: &revision.service,
            revision: revision.number,
            image: &revision.image,
            size,
        })
        .collect();
    let removed: Vec<WarmServant> = {
        let mut kept = pool.kept.lock();
        let facts: Vec<Facts<'_>> = kept.pool.iter().map(WarmServant::facts).collect();
        let ends = stale_containers(&facts, &wanted);
        let ends: Vec<String> = ends.iter().map(|end| end.id.to_owned()).collect();
        // A service that is to have none any more.
        kept.leads.retain(|service, _| wanted.iter().any(|it| it.service == service));
        let removed: Vec<WarmServant> = ends.iter().filter_map(|id| kept.take(id)).collect();
        for warm in &removed {
            let promised = warm.promised_amount(inner).unwrap_or_default();
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
                let facts: Vec<Facts<'_>> = kept.pool.iter().map(WarmServant::facts).collect();
                let lacks = match pool_shortage(&facts, wanted) {
                    PoolShortage::Nothing => None,
                    PoolShortage::Containers(_) => Some(None),
                    PoolShortage::Nodes(id) => Some(Some(id.to_owned())),
                };
                if let (None | Some(Some(_)), Some(lead)) = (&lacks, kept.leads.get_mut(wanted.service)) {
                    lead.clear();
                }
                lacks
            };
            let Some(nodes_of) = lacks.filter(|_| !inner.is_ending()) else {
                break;
            };
            let warm = match nodes_of {
                // Others are made nevertheless.
                None => match make_or_report(inner, revision).await {
                    Some(warm) => warm,
                    None => break,
                },
                // There is no capacity, or a robot took it meanwhile.
                Some(id) => match start_nodes(inner, &id).await {
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
                // A request that began to wait while the nodes were started did not count their promise.
                inner.make_room();
            }
            if fresh && let Some(lead) = pool.kept.lock().leads.get_mut(&revision.service) {
                lead.record_replaced(Instant::now());
            }
        }
    }
    Ok(())
}

/// Reports a container whose nodes have failed before a robot had them; that counts as a servant's failure.
async fn report_dead(inner: &ChoreographerInner, warm: &WarmServant) {
    if !warm.nodes || warm.runs() {
        return;
    }
    let service = &warm.revision.service;
    let mut how = "it ended".to_owned();
    for node in &warm.revision.plan.nodes {
        if let Some(Ok(exit)) = warm.container.wait_node(&node.name).now_or_never() {
            let limits = warm.limits;
            how = format!("{} {}", node.name, reach::describe_exit(&exit, &limits));
        }
    }
    let about = NewEvent { service: Some(service), ..NewEvent::default() };
    let message = format!("a warm servant of {service} failed: {how}");
    inner.journal.warning("warm-failed", &message, &about);
    let back_offs = &inner.back_offs;
    back_offs.record_failure(service, NOBODY, &warm.revision, None, &format!("lost {how}"));
}

/// Makes a container; if that fails, reports it and retries after a pause.
async fn make_or_report(inner: &Arc<ChoreographerInner>, revision: &Arc<RevisionRecord>) -> Option<WarmServant> {
    let (service, back_offs) = (&revision.service, &inner.back_offs);
    if back_offs.find_refusal(service, UNMADE, revision).is_some() {
        return None;
    }
    match make(inner, Arc::clone(revision)).await {
        Ok(warm) => {
            back_offs.clear(service, UNMADE);
            Some(warm)
        }
        Err(error) => {
            let about = NewEvent { service: Some(service), ..NewEvent::default() };
            let message = format!("cannot prepare a servant of {service} in advance: {error}");
            inner.journal.warning("warm-failed", &message, &about);
            let reason = format!("could not be prepared in advance: {error}");
            back_offs.record_failure(service, UNMADE, revision, None, &reason);
            None
        }
    }
}

async fn make(inner: &Arc<ChoreographerInner>, revision: Arc<RevisionRecord>) -> Result<WarmServant, Error> {
    let id = names::servant_id(&revision.service);
    let limits = inner.push_limits(&revision).limits();
    let robot = tracing::field::Empty;
    let span = tracing::error_span!(parent: None, "servant", id, service = revision.service, robot);
    let spec = starting::container_spec(inner, &id, &revision, &limits, Vec::new())?;
    let container = inner.engine.start(spec).instrument(span.clone()).await?;
    let limit = inner.options.start;
    let opening = reaching::open(inner, &revision, &container).instrument(span.clone());
    let reached = tokio::time::timeout(limit, opening).await;
    match reached {
        Ok(Ok(reach)) => Ok(WarmServant { container, reach, limits, nodes: false, permit: None, span, revision }),
        failed => {
            container.stop().await?;
            tracing::debug!("warm container {id}: {:?}", failed.map(|reached| reached.err()));
            Err(Error::Internal("reaching a warm container's ROS Master"))
        }
    }
}

/// Starts the nodes in one of the pool's containers, which is withdrawn meanwhile. Their capacity is promised from here
/// on, if it is free and no request waits for it.
async fn start_nodes(inner: &Arc<ChoreographerInner>, id: &str) -> Option<WarmServant> {
    let mut warm = inner.warm_pool.kept.lock().take(id)?;
    let revision = Arc::clone(&warm.revision);
    let wanted = inner.promised_amount(&revision.plan.limits);
    let Some(permit) = inner.admission.try_admit(wanted) else {
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
    // A daemon that is killed now learns from this record that no robot misses it.
    let recorded = inner.state.add_servant(&record);
    warm.nodes = true;
    let nodes = revision.plan.nodes.iter().cloned();
    let started = join_all(nodes.map(|node| warm.container.start_node(node))).await;
    if recorded.is_err() || started.iter().any(Result::is_err) {
        let (service, reason) = (&revision.service, "could not be started");
        inner.back_offs.record_failure(service, NOBODY, &revision, None, reason);
        warm.end(inner).await;
        return None;
    }
    Some(warm)
}

/// Takes a warm container back that its robot left unused, or ends it.
pub(crate) async fn give_back(inner: &ChoreographerInner, warm: WarmServant) {
    if let Some(unwanted) = inner.warm_pool.put(warm) {
        unwanted.end(inner).await;
    }
}

/// Ends all containers and makes no more.
pub(crate) async fn end_all(inner: &ChoreographerInner) {
    let all = {
        let mut kept = inner.warm_pool.kept.lock();
        kept.closed = true;
        std::mem::take(&mut kept.pool)
    };
    join_all(all.into_iter().map(|warm| warm.end(inner))).await;
    // One that is being made is ended by its maker.
    let _turn = inner.warm_pool.turn.lock().await;
}
