//! The task of one servant, from its request to its end. It alone changes the servant's state.

use std::convert::Infallible;
use std::pin::pin;
use std::sync::{Arc, Weak};

use api::Phase;
use futures_util::FutureExt;
use reach::Reach;
use servant::engine::{ContainerState, ServantHandle};
use tokio::time::Instant;
use tracing::Instrument;

use super::group::run_place;
use super::lifetime::{wait_for_interface, wait_unneeded};
use super::nodes::NodeSupervisor;
use super::waiting::Permit;
use super::warm_pool::{self, WarmServant};
use super::{ChoreographerInner, limits, starting};
use crate::decide::admission::AdmissionRequest;
use crate::lives::handle::{Failure, Handle};
use crate::with_last_log_line;

/// Number of log lines attached to a failure.
const LOG_LINES: usize = 20;

/// Reason for ending a servant whose capacity a robot needs.
pub(crate) const GAVE_WAY: &str = "a robot needs this capacity";

/// Origin of a servant.
pub(crate) enum ServantSource {
    /// Requested by a robot; possibly from a warm container.
    Asked(Option<Box<WarmServant>>),
    /// Started by an earlier daemon.
    Adopted(Arc<dyn ServantHandle>, Option<Permit>),
}

/// Starts the task that runs the servant's life.
pub(crate) fn start(inner: &Arc<ChoreographerInner>, handle: Arc<Handle>, beginning: ServantSource) {
    let span = handle.span(None);
    tokio::spawn(drive(Arc::clone(inner), handle, beginning).instrument(span));
}

/// Runs the servant's life to its end and cleans up.
async fn drive(inner: Arc<ChoreographerInner>, handle: Arc<Handle>, mut beginning: ServantSource) {
    let mut permit = None;
    let outcome = run_life(&inner, &handle, &mut beginning, &mut permit).await;
    inner.retire(&handle);
    inner.note_end(&handle, &outcome);
    inner.rollouts.note_gone(&handle);
    let starved = handle.was_out_of_memory() && handle.gives_way();
    if matches!(outcome, Err(Failure::Broken { .. })) && !handle.is_candidate() && !starved {
        inner.rollouts.note_servant(&handle, true);
    }
    let outcome = match outcome {
        Ok(reason) => Ok(reason),
        Err(failure) => Err(with_log(failure, &handle).await),
    };
    handle.set_over(&outcome);
    let farewell = report_end(&inner, &handle, &outcome);
    if let Some(reach) = handle.take_reach() {
        reach.close(&farewell);
    }
    if let Some(container) = handle.container() {
        inner.keep_log(&handle, &*container).await;
        if let Err(error) = container.stop().await {
            let message = format!("cannot clean up servant {}: {error}", handle.id);
            inner.journal.error("servant-leftover", &message, &handle.event_context());
        }
    }
    inner.state.remove_servant(&handle.id);
    drop(permit);
    inner.forget(&handle);
    // The request that is first in the queue now may need more than that.
    inner.make_room();
    if let ServantSource::Asked(Some(warm)) = beginning {
        warm_pool::give_back(&inner, *warm).await;
    }
    inner.warm_pool.wake();
    handle.set_phase(if outcome.is_ok() { Phase::Stopped } else { Phase::Failed });
}

/// Writes the reason of the servant's end to the journal; returns the message for its robots.
fn report_end(inner: &ChoreographerInner, handle: &Handle, outcome: &Result<String, Failure>) -> String {
    let who = format!("servant {} of {} for {}", handle.id, handle.service(), handle.robot);
    let (journal, about) = (&inner.journal, handle.event_context());
    match outcome {
        Ok(reason) => {
            journal.info("servant-stopped", &format!("{who} was ended: {reason}"), &about);
            format!("the servant was ended: {reason}")
        }
        Err(Failure::Full(refused)) => {
            journal.warning("servant-refused", &format!("{who} was refused: {refused}"), &about);
            refused.to_string()
        }
        Err(Failure::Broken { reason, log }) => {
            let reason = with_last_log_line(reason, log);
            journal.error("servant-failed", &format!("{who} {reason}"), &about);
            format!("the servant {reason}")
        }
    }
}

/// Runs the life of a servant; returns the reason of its regular end, or its failure.
async fn run_life(
    inner: &Arc<ChoreographerInner>,
    handle: &Arc<Handle>,
    beginning: &mut ServantSource,
    kept: &mut Option<Permit>,
) -> Result<String, Failure> {
    if let Some(rules) = handle.revision.plan.shared.filter(|_| handle.is_place()) {
        return run_place(inner, handle, rules).await;
    }
    let (container, reach, fresh) = match beginning {
        ServantSource::Asked(warm) => {
            let ahead = warm.as_mut().and_then(|warm| warm.permit.take());
            let permit = tokio::select! {
                permit = admit(inner, handle, ahead) => permit?,
                reason = handle.wait_end_requested() => return Ok(reason),
                reason = wait_unneeded(inner, handle, true) => return Ok(reason),
            };
            handle.set_promise(permit.promise());
            *kept = Some(permit);
            handle.set_phase(Phase::Admitted);
            if let Some(reason) = wait_unneeded(inner, handle, true).now_or_never() {
                return Ok(reason);
            }
            starting::record(inner, handle)?;
            starting::report_terms(inner, handle);
            match starting::use_warm(inner, handle, warm.take().map(|warm| *warm)).await {
                Some(warm) => (warm.container, Some(warm.reach), true),
                None => (starting::start(inner, handle).await?, None, true),
            }
        }
        ServantSource::Adopted(container, permit) => {
            if let Some(permit) = permit.as_ref() {
                handle.set_promise(permit.promise());
            }
            *kept = permit.take();
            // Beforehand, so that it is ended if it does not answer.
            handle.set_container(Arc::clone(container));
            tokio::select! {
                told = starting::wait_until_told(handle, &**container) => told?,
                reason = handle.wait_end_requested() => return Ok(reason),
            }
            (Arc::clone(container), None, false)
        }
    };
    handle.set_container(Arc::clone(&container));
    handle.set_phase(Phase::Created);
    if !fresh {
        limits::restore_cores(inner, handle, &*container).await;
    }
    starting::report_unmet(inner, handle, &container);
    let permit = kept.as_ref();
    let mut nodes = NodeSupervisor::new(inner, handle, &container);
    let mut supervised = pin!(run(inner, handle, &container, reach, &mut nodes, fresh));
    tokio::select! {
        // A node's exit says more than that of its container, and takes precedence.
        biased;
        outcome = &mut supervised => outcome.map(|never| match never {}),
        reason = handle.wait_end_requested() => Ok(reason),
        failure = wait_container_over(&container) => Err(failure),
        reason = wait_unneeded(inner, handle, fresh) => Ok(reason),
        () = wait_needed(permit) => Ok(GAVE_WAY.to_owned()),
    }
}

/// Waits until a robot needs the capacity of a servant that gives way.
async fn wait_needed(permit: Option<&Permit>) {
    match permit {
        Some(permit) => permit.wait_needed().await,
        None => std::future::pending().await,
    }
}

/// Connects to the servant's ROS, waits for its interface, and then until it fails.
async fn run(
    inner: &Arc<ChoreographerInner>,
    handle: &Arc<Handle>,
    container: &Arc<dyn ServantHandle>,
    reached: Option<Arc<dyn Reach>>,
    nodes: &mut NodeSupervisor<'_>,
    fresh: bool,
) -> Result<Infallible, Failure> {
    let deadline = Instant::now() + inner.options.start;
    let reach = match reached {
        Some(reach) => reach,
        None => starting::reach(inner, handle, container, deadline).await?,
    };
    let tenant: Weak<Handle> = Arc::downgrade(handle);
    reach.bind_tenant(tenant);
    handle.set_reach(Arc::clone(&reach));
    handle.set_phase(Phase::Starting);
    tokio::select! {
        ready = wait_for_interface(inner, handle, &*reach, deadline, fresh), if !handle.is_linked() => ready?,
        () = std::future::ready(()), if handle.is_linked() => {}
        failure = nodes.supervise() => return Err(failure),
    }
    handle.set_phase(Phase::Ready);
    if fresh && !handle.is_candidate() {
        inner.rollouts.note_servant(handle, false);
    }
    inner.warm_pool.wake();
    let took = store::now().saturating_sub(handle.created);
    let message = if fresh {
        format!("servant {} of {} is ready for {} after {took} ms", handle.id, handle.service(), handle.robot)
    } else {
        format!("servant {} of {} was adopted, for {}", handle.id, handle.service(), handle.robot)
    };
    let about = handle.event_context();
    inner.journal.info(if fresh { "servant-ready" } else { "servant-adopted" }, &message, &about);
    Err(nodes.supervise().await)
}

/// Waits for admission. `ahead` is a promise from before the servant had a robot, which then applies to the robot.
async fn admit(inner: &Arc<ChoreographerInner>, handle: &Handle, ahead: Option<Permit>) -> Result<Permit, Failure> {
    let deadline = inner.options.deadline;
    let wanted = inner.promised_amount(&handle.requested_limits());
    // A servant that gives way must be registered as such.
    if let Some(permit) = ahead.filter(|_| !handle.gives_way())
        && permit.promise().change(wanted).is_ok()
    {
        return Ok(permit);
    }
    let ask = if handle.gives_way() {
        AdmissionRequest::push(wanted)
    } else {
        AdmissionRequest::robot(wanted, handle.priority())
    };
    let make_room = || inner.make_room();
    let admission = &inner.admission;
    // A robot without a name cannot be recognised when it comes back.
    let who = format!("{} {}", handle.service(), handle.robot);
    let who = (!handle.anonymous).then_some(&*who);
    let admitted = admission.admit_as(who, ask, deadline, handle.standing_sender(), make_room);
    admitted.await.map_err(Failure::Full)
}

/// Waits until the container has ended unexpectedly.
async fn wait_container_over(container: &Arc<dyn ServantHandle>) -> Failure {
    let mut states = container.state();
    match states.wait_for(ContainerState::is_over).await.as_deref() {
        Ok(ContainerState::Stopped { reason }) => Failure::from_reason(format!("ended: {reason}")),
        Ok(ContainerState::Failed { reason }) => Failure::from_reason(format!("failed: {reason}")),
        _ => Failure::from_reason("was lost by the container engine"),
    }
}

async fn with_log(failure: Failure, handle: &Handle) -> Failure {
    match (failure, handle.container()) {
        (Failure::Broken { reason, log }, Some(container)) if log.is_empty() => {
            let lines = container.logs(LOG_LINES, None).await;
            let log = lines.into_iter().map(|line| format!("{}: {}", line.node, line.line)).collect();
            Failure::Broken { reason, log }
        }
        (failure, _) => failure,
    }
}
