//! From a servant that has capacity to one that can be reached: its container is made, or taken from the warm pool.

use std::sync::Arc;

use futures_util::future::join_all;
use reach::Reach;
use reach::master::resident_config;
use servant::engine::Servant;
use servant::spec::{NodeSpec, Spec};
use store::{NewEvent, RevisionRecord, ServantRecord};
use tokio::time::{Instant, timeout_at};

use super::warm_pool::Warm;
use super::{Inner, limits, reaching};
use crate::decide::terms::in_words;
use crate::lives::handle::{Failure, Handle};
use crate::{Error, engine_limits};

/// Writes down that the servant is, before it runs: a daemon killed now finds it again.
pub(super) fn record(inner: &Inner, handle: &Handle) -> Result<(), Failure> {
    let record = ServantRecord {
        id: handle.id.clone(),
        service: handle.service().to_owned(),
        revision: handle.revision.number,
        robot: handle.robot.clone(),
        anonymous: handle.anonymous,
        created: handle.created,
        limits: handle.all_asked().set,
        terms: Some(handle.terms()),
    };
    let added = inner.state.add_servant(&record);
    added.map_err(|error| could_not_start(error.into()))
}

pub(super) async fn start(
    inner: &Arc<Inner>,
    handle: &Arc<Handle>,
) -> Result<Arc<dyn Servant>, Failure> {
    let nodes = planned(handle);
    let spec = spec(inner, &handle.id, &handle.revision, &handle.limits(), nodes);
    let started = inner.engine.start(spec.map_err(could_not_start)?).await;
    started.map_err(|error| could_not_start(error.into()))
}

/// The nodes to begin with: those of a robot's stubs come one by one.
fn planned(handle: &Handle) -> Vec<NodeSpec> {
    if handle.is_linked() {
        return Vec::new();
    }
    handle.revision.plan.nodes.clone()
}

/// Makes a warm container the robot's: gives it the robot's limits, and starts the nodes where it was made without. None if
/// it has ended meanwhile, and then nothing is left of it.
pub(super) async fn use_warm(inner: &Inner, handle: &Handle, warm: Option<Warm>) -> Option<Warm> {
    let warm = warm?;
    let limits = handle.limits();
    if let Err(error) =
        limits::fit(&*warm.container, &warm.limits, &limits, inner.options.cores).await
    {
        tracing::debug!("a warm container cannot be given {limits:?}: {error}");
        warm.end(inner).await;
        return None;
    }
    if warm.nodes {
        return Some(warm);
    }
    // In their order and without waiting for one another. A program that cannot be executed is refused here, and
    // looked at where the ends of nodes are.
    let nodes = planned(handle).into_iter();
    let started = join_all(nodes.map(|node| warm.container.start_node(node))).await;
    let lost = |outcome: &Result<(), servant::Error>| matches!(outcome, Err(error) if !matches!(error, servant::Error::Refused { .. }));
    if started.iter().any(lost) {
        warm.end(inner).await;
        return None;
    }
    Some(warm)
}

fn could_not_start(error: Error) -> Failure {
    Failure::broken(format!("could not be started: {error}"))
}

/// Reaches the ROS in the container and sets a bridge before it.
pub(super) async fn reach(
    inner: &Arc<Inner>,
    handle: &Arc<Handle>,
    container: &Arc<dyn Servant>,
    deadline: Instant,
) -> Result<Arc<dyn Reach>, Failure> {
    let late = |_| {
        let limit = inner.options.start.as_secs();
        Failure::broken(format!(
            "could not be reached within {limit} s: its ROS did not come up"
        ))
    };
    timeout_at(deadline, reaching::open(inner, &handle.revision, container))
        .await
        .map_err(late)?
        .map_err(|error| Failure::broken(format!("cannot be reached: {error}")))
}

/// What the engine is to make: a servant of this revision, with these nodes.
pub(super) fn spec(
    inner: &Inner,
    id: &str,
    revision: &RevisionRecord,
    limits: &api::Limits,
    nodes: Vec<NodeSpec>,
) -> Result<Spec, Error> {
    let plan = &revision.plan;
    for what in inner.engine.check(&plan.grants)? {
        let about = NewEvent {
            service: Some(&revision.service),
            servant: Some(id),
            robot: None,
        };
        let message = format!("servant {id} of {}: {what}", revision.service);
        inner.journal.warning("device-incomplete", &message, &about);
    }
    Ok(Spec {
        id: id.to_owned(),
        image: revision.image.clone(),
        limits: engine_limits(limits),
        environment: plan.environment.clone(),
        nodes,
        grants: plan.grants.clone(),
        resident: resident_config(&revision.flavour, &plan.parameters),
    })
}

/// What its robot stated, if anything, and what follows.
pub(super) fn report_terms(inner: &Inner, handle: &Handle) {
    let terms = handle.terms();
    if terms.stated.is_empty() {
        return;
    }
    let promised = match in_words(&handle.asked()) {
        none if none.is_empty() => "no more than others".to_owned(),
        limits => limits,
    };
    let message = format!(
        "servant {} of {}: its robot states {}; it is promised {promised} ({})",
        handle.id,
        handle.service(),
        terms.stated_in_words(),
        terms.why.join("; "),
    );
    inner.journal.info("terms", &message, &handle.about());
}

/// Of limits that somebody asked for and that are not in force; that of the others the daemon has warned at its start.
pub(super) fn report_unmet(inner: &Inner, handle: &Handle, container: &Arc<dyn Servant>) {
    let unmet = container.enforced().unmet(&engine_limits(&handle.asked()));
    if !unmet.is_empty() {
        let message = format!(
            "servant {} runs without a limit that was asked for: {}",
            handle.id,
            unmet.join(", ")
        );
        let about = handle.about();
        inner.journal.warning("limits-unmet", &message, &about);
    }
}
