//! The task of one servant: from asked for to gone. It alone changes the servant's state.

use std::convert::Infallible;
use std::pin::pin;
use std::sync::{Arc, Weak};

use api::Phase;
use futures_util::FutureExt;
use reach::Reach;
use servant::engine::{ContainerState, Servant};
use tokio::time::Instant;

use super::lifetime::{interface_there, unneeded};
use super::nodes::Nodes;
use super::waiting::Permit;
use super::warm_pool::{self, Warm};
use super::{Inner, group, limits, starting};
use crate::decide::admission::Ask;
use crate::lives::handle::{Failure, Handle};
use crate::with_last_words;

/// Lines of the log that explain a failure.
const LOG_LINES: usize = 20;

/// Why a servant that gives way to robots was ended for one.
pub(crate) const GAVE_WAY: &str = "a robot needs its room";

/// How a servant begins.
pub(crate) enum Beginning {
    /// A robot asked for it; it may have been made but for its nodes.
    Asked(Option<Warm>),
    /// An earlier daemon started it.
    Adopted(Arc<dyn Servant>, Option<Permit>),
}

/// Runs the servant's life to its end and cleans up after it.
pub(crate) async fn drive(inner: Arc<Inner>, handle: Arc<Handle>, mut beginning: Beginning) {
    let mut permit = None;
    let outcome = live(&inner, &handle, &mut beginning, &mut permit).await;
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
    if let Beginning::Asked(Some(warm)) = beginning {
        warm_pool::give_back(&inner, warm).await;
    }
    inner.warm_pool.look();
    handle.set_phase(if outcome.is_ok() {
        Phase::Stopped
    } else {
        Phase::Failed
    });
}

/// Writes why the servant ended into the journal; gives the words for its robots.
fn report_end(inner: &Inner, handle: &Handle, outcome: &Result<String, Failure>) -> String {
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
    if let Some(rules) = handle.revision.plan.shared.filter(|_| handle.is_place()) {
        return group::sit(inner, handle, rules).await;
    }
    let (container, reach, fresh) = match beginning {
        Beginning::Asked(warm) => {
            let ahead = warm.as_mut().and_then(|warm| warm.permit.take());
            let permit = tokio::select! {
                permit = admit(inner, handle, ahead) => permit?,
                reason = handle.end_asked() => return Ok(reason),
                reason = unneeded(inner, handle, true) => return Ok(reason),
            };
            handle.set_promise(permit.promise());
            *kept = Some(permit);
            handle.set_phase(Phase::Admitted);
            if let Some(reason) = unneeded(inner, handle, true).now_or_never() {
                return Ok(reason);
            }
            starting::record(inner, handle)?;
            starting::report_terms(inner, handle);
            match starting::use_warm(inner, handle, warm.take()).await {
                Some(warm) => (warm.container, Some(warm.reach), true),
                None => (starting::start(inner, handle).await?, None, true),
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
    if !fresh {
        limits::take_back(inner, handle, &*container).await;
    }
    starting::report_unmet(inner, handle, &container);
    let permit = kept.as_ref();
    let mut nodes = Nodes::new(inner, handle, &container);
    let mut supervised = pin!(run(inner, handle, &container, reach, &mut nodes, fresh));
    tokio::select! {
        // A node's end says more than that of its container, and comes first where both come at once.
        biased;
        outcome = &mut supervised => outcome.map(|never| match never {}),
        reason = handle.end_asked() => Ok(reason),
        failure = container_over(&container) => Err(failure),
        reason = unneeded(inner, handle, fresh) => Ok(reason),
        () = is_needed(permit) => Ok(GAVE_WAY.to_owned()),
    }
}

/// Comes back when a robot needs what was promised to a servant that gives way.
async fn is_needed(permit: Option<&Permit>) {
    match permit {
        Some(permit) => permit.is_needed().await,
        None => std::future::pending().await,
    }
}

/// Reaches the servant's ROS, waits for its interface, and then until it fails.
async fn run(
    inner: &Arc<Inner>,
    handle: &Arc<Handle>,
    container: &Arc<dyn Servant>,
    reached: Option<Arc<dyn Reach>>,
    nodes: &mut Nodes<'_>,
    fresh: bool,
) -> Result<Infallible, Failure> {
    let deadline = Instant::now() + inner.options.start;
    let reach = match reached {
        Some(reach) => reach,
        None => starting::reach(inner, handle, container, deadline).await?,
    };
    let tenant: Weak<Handle> = Arc::downgrade(handle);
    reach.bind(tenant);
    handle.set_reach(Arc::clone(&reach));
    handle.set_phase(Phase::Starting);
    tokio::select! {
        ready = interface_there(inner, handle, &*reach, deadline, fresh), if !handle.is_linked() => ready?,
        () = std::future::ready(()), if handle.is_linked() => {}
        failure = nodes.supervise() => return Err(failure),
    }
    handle.set_phase(Phase::Ready);
    if fresh && !handle.is_candidate() {
        inner.rollouts.note_servant(handle, false);
    }
    inner.warm_pool.look();
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
    Err(nodes.supervise().await)
}

/// `ahead` was promised to the servant before it had a robot: then that is what the robot is promised.
async fn admit(
    inner: &Arc<Inner>,
    handle: &Handle,
    ahead: Option<Permit>,
) -> Result<Permit, Failure> {
    let deadline = inner.options.deadline;
    let wanted = inner.promised(&handle.asked());
    // One that gives way has to be known as such.
    if let Some(permit) = ahead.filter(|_| !handle.gives_way())
        && permit.promise().change(wanted).is_ok()
    {
        return Ok(permit);
    }
    let ask = match handle.gives_way() {
        true => Ask::push(wanted),
        false => Ask::robot(wanted, handle.priority()),
    };
    let make_room = || inner.make_room();
    let admission = &inner.admission;
    // A robot that named no name is nobody's when it comes back.
    let who = format!("{} {}", handle.service(), handle.robot);
    let who = (!handle.anonymous).then_some(&*who);
    let admitted = admission.admit_as(who, ask, deadline, handle.stands(), make_room);
    admitted.await.map_err(Failure::Full)
}

/// Comes back when the container has ended, which nobody asked for.
async fn container_over(container: &Arc<dyn Servant>) -> Failure {
    let mut states = container.state();
    match states.wait_for(ContainerState::is_over).await.as_deref() {
        Ok(ContainerState::Stopped { reason }) => Failure::broken(format!("ended: {reason}")),
        Ok(ContainerState::Failed { reason }) => Failure::broken(format!("failed: {reason}")),
        _ => Failure::broken("was lost by the engine"),
    }
}

async fn with_log(failure: Failure, handle: &Handle) -> Failure {
    match (failure, handle.container()) {
        (Failure::Broken { reason, log }, Some(container)) if log.is_empty() => {
            let lines = container.logs(LOG_LINES, None).await;
            let log = lines
                .into_iter()
                .map(|line| format!("{}: {}", line.node, line.line))
                .collect();
            Failure::Broken { reason, log }
        }
        (failure, _) => failure,
    }
}
