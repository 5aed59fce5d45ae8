//! The task of one servant: from asked for to gone. It alone changes the servant's state.

use std::pin::pin;
use std::sync::{Arc, Weak};
use std::time::Duration;

use api::Phase;
use futures_util::future::join_all;
use package::interface::Interface;
use reach::master::resident_config;
use reach::{Reach, readiness};
use servant::engine::{ContainerState, Servant};
use servant::spec::{NodeSpec, Profile, Spec};
use tokio::time::{Instant, timeout_at};

use super::nodes::Nodes;
use super::spares::{self, Spare};
use super::{Inner, reaching};
use crate::admission::Permit;
use crate::grants;
use crate::handle::{Failure, Handle};
use crate::{Error, engine_limits, tail, with_last_words};
use store::{NewEvent, RevisionRecord, ServantRecord};

/// Lines of the log that explain a failure.
const LOG_LINES: usize = 20;
/// When nothing changes for so long although something of the interface is missing, it is not coming: of a servant that
/// was adopted, whose nodes may have been told to take it away, and of a revision that has kept robots waiting in vain.
const SETTLED: Duration = Duration::from_secs(5);

/// How a servant begins.
pub(crate) enum Beginning {
    /// A robot asked for it; it may have been made but for its nodes.
    Asked(Option<Spare>),
    /// An earlier daemon started it.
    Adopted(Arc<dyn Servant>, Option<Permit>),
}

/// Runs the servant's life to its end and cleans up after it.
pub(crate) async fn drive(inner: Arc<Inner>, handle: Arc<Handle>, mut beginning: Beginning) {
    let mut permit = None;
    let outcome = live(&inner, &handle, &mut beginning, &mut permit).await;
    inner.retire(&handle);
    let outcome = match outcome {
        Ok(reason) => Ok(reason),
        Err(failure) => Err(with_log(failure, &handle).await),
    };
    handle.set_over(&outcome);
    let farewell = tell_end(&inner, &handle, &outcome);
    if let Some(reach) = handle.take_reach() {
        reach.hub.close(&farewell);
        reach.bridge.close(&farewell);
    }
    if let Some(container) = handle.container()
        && let Err(error) = container.stop().await
    {
        let message = format!("servant {} could not be cleaned up: {error}", handle.id);
        inner
            .journal
            .error("servant-leftover", &message, &handle.about());
    }
    inner.state.remove_servant(&handle.id);
    drop(permit);
    inner.forget(&handle);
    // Whoever is first in the queue now may need more than that.
    inner.make_room();
    if let Beginning::Asked(Some(spare)) = beginning {
        spares::give_back(&inner, spare).await;
    }
    inner.spares.look();
    handle.set_phase(if outcome.is_ok() {
        Phase::Stopped
    } else {
        Phase::Failed
    });
}

/// Writes why the servant ended into the journal; gives the words for its robots.
fn tell_end(inner: &Inner, handle: &Handle, outcome: &Result<String, Failure>) -> String {
    let who = format!(
        "servant {} of {} for {}",
        handle.id,
        handle.service(),
        handle.robot
    );
    let (journal, about) = (&inner.journal, handle.about());
    match outcome {
        Ok(reason) => {
            journal.info(
                "servant-stopped",
                &format!("{who} was ended: {reason}"),
                &about,
            );
            format!("the servant was ended: {reason}")
        }
        Err(Failure::Full(refused)) => {
            journal.warning(
                "servant-refused",
                &format!("{who} was refused: {refused}"),
                &about,
            );
            refused.to_string()
        }
        Err(Failure::Broken { reason, log }) => {
            let reason = with_last_words(reason, log);
            journal.error("servant-failed", &format!("{who} {reason}"), &about);
            format!("the servant {reason}")
        }
    }
}

/// From asked for to why it ended as it should, or why it failed.
async fn live(
    inner: &Arc<Inner>,
    handle: &Arc<Handle>,
    beginning: &mut Beginning,
    kept: &mut Option<Permit>,
) -> Result<String, Failure> {
    let (container, reach, fresh) = match beginning {
        Beginning::Asked(spare) => {
            let permit = tokio::select! {
                permit = admit(inner, handle) => permit?,
                reason = handle.end_asked() => return Ok(reason),
                () = abandoned(handle) => return Ok("its robot left before there was room".to_owned()),
            };
            handle.set_promise(permit.promise());
            *kept = Some(permit);
            if handle.anonymous && handle.connections() == 0 {
                return Ok("its robot left before it was started".to_owned());
            }
            handle.set_phase(Phase::Admitted);
            record(inner, handle)?;
            match use_spare(handle, spare.take()).await {
                Some(spare) => (spare.container, Some(spare.reach), true),
                None => (start(inner, handle).await?, None, true),
            }
        }
        Beginning::Adopted(container, permit) => {
            if let Some(permit) = permit.as_ref() {
                handle.set_promise(permit.promise());
            }
            *kept = permit.take();
            (Arc::clone(container), None, false)
        }
    };
    handle.set_container(Arc::clone(&container));
    handle.set_phase(Phase::Created);
    tell_unmet(inner, handle, &container);
    let mut nodes = Nodes::new(inner, handle, &container);
    let mut supervised = pin!(run(inner, handle, &container, reach, &mut nodes, fresh));
    tokio::select! {
        // A node's end says more than that of its container, and comes first where both come at once.
        biased;
        outcome = &mut supervised => outcome,
        reason = handle.end_asked() => Ok(reason),
        failure = container_over(&container) => Err(failure),
        () = deserted(handle), if fresh => Ok("its robot left before it was ready".to_owned()),
    }
}

/// Of limits that somebody asked for and that are not in force; that of the others the daemon has warned at its start.
fn tell_unmet(inner: &Inner, handle: &Handle, container: &Arc<dyn Servant>) {
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

/// Reaches the servant's ROS, waits for its interface, and then until nobody needs it.
async fn run(
    inner: &Arc<Inner>,
    handle: &Arc<Handle>,
    container: &Arc<dyn Servant>,
    reached: Option<Arc<Reach>>,
    nodes: &mut Nodes<'_>,
    fresh: bool,
) -> Result<String, Failure> {
    let deadline = Instant::now() + inner.options.start;
    let reach = match reached {
        Some(reach) => reach,
        None => reach(inner, handle, container, deadline).await?,
    };
    let tenant: Weak<Handle> = Arc::downgrade(handle);
    reach.nodes.bind(tenant);
    handle.set_reach(Arc::clone(&reach));
    handle.set_phase(Phase::Starting);
    tokio::select! {
        ready = interface_there(inner, handle, &reach, deadline, fresh), if !handle.is_linked() => ready?,
        () = std::future::ready(()), if handle.is_linked() => {}
        failure = nodes.supervise() => return Err(failure),
    }
    handle.set_phase(Phase::Ready);
    inner.spares.look();
    let took = store::now().saturating_sub(handle.created);
    let message = if fresh {
        format!(
            "servant {} of {} is ready for {} after {took} ms",
            handle.id,
            handle.service(),
            handle.robot
        )
    } else {
        format!(
            "servant {} of {} was adopted, for {}",
            handle.id,
            handle.service(),
            handle.robot
        )
    };
    let about = handle.about();
    inner.journal.info(
        if fresh {
            "servant-ready"
        } else {
            "servant-adopted"
        },
        &message,
        &about,
    );
    tokio::select! {
        reason = unneeded(inner, handle) => Ok(reason),
        failure = nodes.supervise() => Err(failure),
    }
}

async fn admit(inner: &Inner, handle: &Handle) -> Result<Permit, Failure> {
    let deadline = inner.options.deadline;
    let wanted = inner.promised(handle);
    let admitted = inner
        .admission
        .admit(wanted, deadline, || inner.make_room())
        .await;
    admitted.map_err(Failure::Full)
}

/// Comes back when nobody is connected.
async fn abandoned(handle: &Handle) {
    let _ = handle
        .watch_connections()
        .wait_for(|count| *count == 0)
        .await;
}

/// Comes back when a robot that cannot come back to this servant has left before it was ready. (Others may, and find it
/// within their grace time.)
async fn deserted(handle: &Handle) {
    let mut life = handle.watch();
    let ready = life.wait_for(|life| life.phase >= Phase::Ready);
    tokio::select! {
        biased;
        _ = ready => {}
        () = abandoned(handle), if handle.anonymous => return,
    }
    std::future::pending().await
}

/// Writes down that the servant is, before it runs: a daemon killed now finds it again.
fn record(inner: &Inner, handle: &Handle) -> Result<(), Failure> {
    let record = ServantRecord {
        id: handle.id.clone(),
        service: handle.service().to_owned(),
        revision: handle.revision.number,
        robot: handle.robot.clone(),
        anonymous: handle.anonymous,
        created: handle.created,
        limits: api::Limits::default(),
    };
    let added = inner.state.add_servant(&record);
    added.map_err(|error| could_not_start(error.into()))
}

async fn start(inner: &Arc<Inner>, handle: &Arc<Handle>) -> Result<Arc<dyn Servant>, Failure> {
    let nodes = planned(handle);
    let spec = spec(inner, &handle.id, &handle.revision, &handle.limits(), nodes).await;
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

/// Starts the nodes in a container that was made without; none if it has ended meanwhile, and then nothing is left of it.
async fn use_spare(handle: &Handle, spare: Option<Spare>) -> Option<Spare> {
    let spare = spare?;
    // In their order and without waiting for one another. A program that cannot be executed is refused here, and
    // looked at where the ends of nodes are.
    let nodes = planned(handle).into_iter();
    let started = join_all(nodes.map(|node| spare.container.start_node(node))).await;
    let lost = |outcome: &Result<(), servant::Error>| matches!(outcome, Err(error) if !matches!(error, servant::Error::Refused { .. }));
    if started.iter().any(lost) {
        spare.end().await;
        return None;
    }
    Some(spare)
}

fn could_not_start(error: Error) -> Failure {
    Failure::broken(format!("could not be started: {error}"))
}

/// Reaches the ROS Master in the container and sets a bridge before it.
async fn reach(
    inner: &Arc<Inner>,
    handle: &Arc<Handle>,
    container: &Arc<dyn Servant>,
    deadline: Instant,
) -> Result<Arc<Reach>, Failure> {
    let late = |_| {
        let limit = inner.options.start.as_secs();
        Failure::broken(format!("did not start its ROS Master within {limit} s"))
    };
    timeout_at(deadline, reaching::open(inner, &handle.revision, container))
        .await
        .map_err(late)?
        .map_err(|error| Failure::broken(format!("cannot be reached: {error}")))
}

/// What the engine is to make: a servant of this revision, with these nodes.
pub(crate) async fn spec(
    inner: &Arc<Inner>,
    id: &str,
    revision: &RevisionRecord,
    limits: &api::Limits,
    nodes: Vec<NodeSpec>,
) -> Result<Spec, Error> {
    let layers = inner.catalogue.layers(revision).await?;
    let plan = &revision.plan;
    let granted = grants::resolve(&plan.grants, &inner.options.allow)?;
    for what in &granted.unfulfilled {
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
        layers,
        writable: None,
        profile: Profile::Servant,
        limits: engine_limits(limits),
        environment: granted.environment_over(&plan.environment),
        nodes,
        owned_directories: Vec::new(),
        mounts: granted.mounts,
        hosts: granted.hosts,
        resident: resident_config(&plan.parameters),
    })
}

/// Comes back when the container has ended, which nobody asked for.
async fn container_over(container: &Arc<dyn Servant>) -> Failure {
    let mut states = container.state();
    let over = |state: &ContainerState| {
        matches!(
            state,
            ContainerState::Stopped { .. } | ContainerState::Failed { .. }
        )
    };
    match states.wait_for(over).await.as_deref() {
        Ok(ContainerState::Stopped { reason }) => Failure::broken(format!("ended: {reason}")),
        Ok(ContainerState::Failed { reason }) => Failure::broken(format!("failed: {reason}")),
        _ => Failure::broken("was lost by the engine"),
    }
}

/// Waits until everything that the interface promises is registered. Nodes may take their time between their
/// registration and their first topic: all that the servant's start may take.
async fn interface_there(
    inner: &Inner,
    handle: &Handle,
    reach: &Reach,
    deadline: Instant,
    fresh: bool,
) -> Result<(), Failure> {
    let interface: &Interface = &handle.revision.interface;
    let patient = fresh && !inner.incomplete.lock().contains(&handle.revision.image);
    let mut graphs = reach.bus.graph();
    loop {
        let graph = graphs.borrow_and_update().clone();
        let missing = readiness::missing(interface, &graph);
        if missing.is_empty() {
            return Ok(());
        }
        let nodes_missing = readiness::missing_nodes(interface, &graph);
        // Topics can come and go with what a node is told; nodes cannot.
        let until = if patient || !nodes_missing.is_empty() {
            deadline
        } else {
            deadline.min(Instant::now() + SETTLED)
        };
        match timeout_at(until, graphs.changed()).await {
            Ok(Ok(())) => {}
            Ok(Err(_)) => return Err(Failure::broken("lost its ROS Master")),
            Err(_) if nodes_missing.is_empty() => {
                let image = handle.revision.image.clone();
                inner.incomplete.lock().insert(image);
                let message = format!(
                    "servant {} is ready without {}",
                    handle.id,
                    missing.join(", ")
                );
                let about = handle.about();
                inner
                    .journal
                    .warning("interface-incomplete", &message, &about);
                return Ok(());
            }
            Err(_) => {
                let limit = inner.options.start.as_secs();
                return Err(Failure::broken(format!(
                    "did not become ready within {limit} s: {} did not register ({} missing)",
                    nodes_missing.join(", "),
                    missing.join(", ")
                )));
            }
        }
    }
}

/// Comes back when nobody has been connected for the grace time.
async fn unneeded(inner: &Inner, handle: &Arc<Handle>) -> String {
    let times = &inner.options;
    let grace = if handle.anonymous {
        times.anonymous_grace
    } else {
        times.grace
    };
    let mut connections = handle.watch_connections();
    loop {
        let _ = connections.wait_for(|count| *count == 0).await;
        handle.set_idle_until(Some(store::now() + grace.as_millis() as u64));
        // Somebody may have been waiting for longer.
        inner.make_room();
        let returned = tokio::time::timeout(grace, connections.wait_for(|count| *count > 0))
            .await
            .is_ok();
        handle.set_idle_until(None);
        if !returned && inner.retire_if_idle(handle) {
            return match grace.as_secs() {
                0 => "its robot left".to_owned(),
                seconds => format!("no robot was connected for {seconds} s"),
            };
        }
    }
}

async fn with_log(failure: Failure, handle: &Handle) -> Failure {
    match (failure, handle.container()) {
        (Failure::Broken { reason, log }, Some(container)) if log.is_empty() => {
            let lines = tail::last(container.log_path(), LOG_LINES, None).await;
            let log = lines
                .into_iter()
                .map(|line| format!("{}: {}", line.node, line.line))
                .collect();
            Failure::Broken { reason, log }
        }
        (failure, _) => failure,
    }
}
