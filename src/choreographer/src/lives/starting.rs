//! Starts admitted servants: their container is made, taken from the warm pool, or that of an earlier daemon.

use std::sync::Arc;
use std::time::Duration;

use futures_util::future::join_all;
use reach::Reach;
use reach::master::resident_config;
use servant::engine::{ContainerState, ServantHandle};
use servant::spec::{NodeSpec, Spec};
use store::{NewEvent, RevisionRecord, ServantRecord};
use tokio::time::{Instant, timeout, timeout_at};

use super::warm_pool::WarmServant;
use super::{ChoreographerInner, limits, reaching};
use crate::Error;
use crate::decide::adoption::{StartedNode, is_linked};
use crate::decide::terms::limits_in_words;
use crate::lives::handle::{Failure, Handle};

/// Time for the shim of an adopted servant to answer.
const ANSWER: Duration = Duration::from_secs(10);

/// Records the servant before it runs: a daemon that is killed now finds it again.
pub(super) fn record(inner: &ChoreographerInner, handle: &Handle) -> Result<(), Failure> {
    let record = ServantRecord {
        id: handle.id.clone(),
        service: handle.service().to_owned(),
        revision: handle.revision.number,
        robot: handle.robot.clone(),
        anonymous: handle.anonymous,
        created: handle.created,
        limits: handle.limit_sources().set,
        terms: Some(handle.terms()),
    };
    let added = inner.state.add_servant(&record);
    added.map_err(|error| start_failure(error.into()))
}

pub(super) async fn start(
    inner: &Arc<ChoreographerInner>,
    handle: &Arc<Handle>,
) -> Result<Arc<dyn ServantHandle>, Failure> {
    let nodes = initial_nodes(handle);
    let spec = container_spec(inner, &handle.id, &handle.revision, &handle.limits(), nodes);
    let started = inner.engine.start(spec.map_err(start_failure)?).await;
    started.map_err(|error| start_failure(error.into()))
}

/// Waits until the shim of an adopted servant has told the servant's state, and notes who starts its nodes.
pub(super) async fn wait_until_told(handle: &Handle, servant: &dyn ServantHandle) -> Result<(), Failure> {
    let mut states = servant.state();
    let told = states.wait_for(|state| *state != ContainerState::Creating);
    if timeout(ANSWER, told).await.is_err() {
        let waited = ANSWER.as_secs();
        return Err(Failure::from_reason(format!(
            "was given up: its shim did not answer the next daemon in {waited} s"
        )));
    }
    let planned = &handle.revision.plan.nodes;
    let started = servant.nodes().into_iter().map(|name| StartedNode {
        planned: planned.iter().any(|node| node.name == name),
        run: servant.run_id(&name).is_some(),
    });
    if is_linked(&started.collect::<Vec<_>>()) {
        handle.set_linked();
    }
    Ok(())
}

/// Returns the nodes to start with: those of a robot's stubs are started one by one later.
fn initial_nodes(handle: &Handle) -> Vec<NodeSpec> {
    if handle.is_linked() {
        return Vec::new();
    }
    handle.revision.plan.nodes.clone()
}

/// Assigns a warm container to the robot: applies the robot's limits, and starts the nodes if it was made without.
/// Returns `None`, with nothing left of it, if it has ended meanwhile.
pub(super) async fn use_warm(
    inner: &ChoreographerInner,
    handle: &Handle,
    warm: Option<WarmServant>,
) -> Option<WarmServant> {
    let warm = warm?;
    warm.span.record("robot", &*handle.robot);
    let limits = handle.limits();
    if let Err(error) = limits::fit_container(&*warm.container, &warm.limits, &limits, inner.options.cores).await {
        tracing::debug!("a warm container cannot be given {limits:?}: {error}");
        warm.end(inner).await;
        return None;
    }
    if warm.nodes {
        return Some(warm);
    }
    // In order and without waiting for one another. A program that cannot be executed is refused here, and handled with
    // the exits of nodes.
    let nodes = initial_nodes(handle).into_iter();
    let started = join_all(nodes.map(|node| warm.container.start_node(node))).await;
    let lost = |outcome: &Result<(), servant::Error>| {
        matches!(outcome, Err(error)
        if !matches!(error, servant::Error::Refused { .. }))
    };
    if started.iter().any(lost) {
        warm.end(inner).await;
        return None;
    }
    Some(warm)
}

fn start_failure(error: Error) -> Failure {
    Failure::from_reason(format!("could not be started: {error}"))
}

/// Connects to the ROS in the container and puts a bridge in front of it.
pub(super) async fn reach(
    inner: &Arc<ChoreographerInner>,
    handle: &Arc<Handle>,
    container: &Arc<dyn ServantHandle>,
    deadline: Instant,
) -> Result<Arc<dyn Reach>, Failure> {
    let late = |_| {
        let limit = inner.options.start.as_secs();
        Failure::from_reason(format!("could not be reached within {limit} s: its ROS did not start"))
    };
    timeout_at(deadline, reaching::open(inner, &handle.revision, container))
        .await
        .map_err(late)?
        .map_err(|error| Failure::from_reason(format!("cannot be reached: {error}")))
}

/// Returns the engine's specification of a servant of this revision, with these nodes.
pub(super) fn container_spec(
    inner: &ChoreographerInner,
    id: &str,
    revision: &RevisionRecord,
    limits: &api::Limits,
    nodes: Vec<NodeSpec>,
) -> Result<Spec, Error> {
    let plan = &revision.plan;
    for what in inner.engine.check_grants(&plan.grants)? {
        let about = NewEvent { service: Some(&revision.service), servant: Some(id), robot: None };
        let message = format!("servant {id} of {}: {what}", revision.service);
        inner.journal.warning("device-incomplete", &message, &about);
    }
    Ok(Spec {
        id: id.to_owned(),
        image: revision.image.clone(),
        limits: *limits,
        environment: plan.environment.clone(),
        nodes,
        grants: plan.grants.clone(),
        resident: resident_config(&revision.flavour, &plan.parameters),
    })
}

/// Reports what its robot stated, if anything, and the consequences.
pub(super) fn report_terms(inner: &ChoreographerInner, handle: &Handle) {
    let terms = handle.terms();
    if terms.stated.is_empty() {
        return;
    }
    let promised = match limits_in_words(&handle.requested_limits()) {
        none if none.is_empty() => "the default limits".to_owned(),
        limits => limits,
    };
    let message = format!(
        "servant {} of {}: its robot requests {}; reserved: {promised} ({})",
        handle.id,
        handle.service(),
        terms.describe_stated(),
        terms.why.join("; "),
    );
    inner.journal.info("terms", &message, &handle.event_context());
}

/// Reports requested limits that are not in force; the daemon has warned about the others at its start.
pub(super) fn report_unmet(inner: &ChoreographerInner, handle: &Handle, container: &Arc<dyn ServantHandle>) {
    let unmet = container.enforced_limits().unmet_limits(&handle.requested_limits());
    if !unmet.is_empty() {
        let message = format!("servant {} runs without a requested limit: {}", handle.id, unmet.join(", "));
        let about = handle.event_context();
        inner.journal.warning("limits-unmet", &message, &about);
    }
}
