//! Carries out decisions about a servant's lifetime: waits until it can be used, and until it is not needed any more.

use std::sync::Arc;

use api::Phase;
use package::interface::Interface;
use reach::Reach;
use reach::components::{ContainerLoad, Loads};
use reach::lifecycle::Stages;
use reach::readiness::{missing_endpoints, missing_nodes};
use tokio::sync::watch;
use tokio::time::{Instant, timeout_at};

use super::ChoreographerInner;
use crate::decide::lifetime::{InterfaceStatus, Readiness, Retention, ServantStage, Tenancy, readiness, retention};
use crate::lives::handle::{Failure, Handle};

/// Waits until the whole interface is registered. Nodes may take the full start time of the servant between their
/// registration and their first topic.
pub(super) async fn wait_for_interface(
    inner: &ChoreographerInner,
    handle: &Handle,
    reach: &dyn Reach,
    deadline: Instant,
    fresh: bool,
) -> Result<(), Failure> {
    let interface: &Interface = &handle.revision.interface;
    let image = &handle.revision.image;
    let mut graphs = reach.graph();
    let (mut lifecycles, mut loads) = (reach.lifecycles(), reach.loads());
    let mut changed = Instant::now();
    loop {
        let graph = graphs.borrow_and_update().clone();
        if let Some(refused) = find_refused(&mut lifecycles) {
            return Err(Failure::from_reason(format!("is unusable: {refused}")));
        }
        let loading = loading_containers(&mut loads)?;
        let mut missing = missing_endpoints(interface, &graph);
        let mut nodes_missing = missing_nodes(interface, &graph);
        missing.extend(inactive_nodes(&lifecycles.borrow()));
        for container in loading {
            missing.push(format!("the components of {container}"));
            nodes_missing.push(format!("the nodes of {container}"));
        }
        let shown = InterfaceStatus {
            missing: &missing,
            nodes_missing: &nodes_missing,
            patient: fresh && !inner.incomplete.lock().contains(image),
            changed: changed.into_std(),
            deadline: deadline.into_std(),
            limit: inner.options.start,
        };
        let until = match readiness(&shown, Instant::now().into_std()) {
            Readiness::Ready => return Ok(()),
            Readiness::Waits(until) => Instant::from_std(until),
            Readiness::Incomplete => {
                inner.incomplete.lock().insert(image.clone());
                let missing = missing.join(", ");
                let message = format!("servant {} is ready without {missing}", handle.id);
                let about = handle.event_context();
                inner.journal.warning("interface-incomplete", &message, &about);
                return Ok(());
            }
            Readiness::Late(reason) => return Err(Failure::from_reason(reason)),
        };
        tokio::select! {
            shown = timeout_at(until, graphs.changed()) => match shown {
                Ok(Ok(())) => changed = Instant::now(),
                Ok(Err(_)) => return Err(Failure::from_reason("lost its ROS Master or domain")),
                Err(_) => {}
            },
            // A node that becomes active is about to register more.
            () = wait_changed(&mut lifecycles) => changed = Instant::now(),
            () = wait_changed(&mut loads) => changed = Instant::now(),
        }
    }
}

/// Returns why a lifecycle node refuses to become active, if one does.
fn find_refused(stages: &mut watch::Receiver<Stages>) -> Option<String> {
    let stages = stages.borrow_and_update();
    stages.values().find_map(|stage| stage.refused.clone())
}

/// Returns nodes on their way to being active, as missing parts.
fn inactive_nodes(stages: &Stages) -> impl Iterator<Item = String> {
    let begin = stages.iter().filter(|(_, stage)| stage.begins);
    begin.map(|(node, _)| format!("the node {node}, which is not active yet"))
}

/// Returns the component containers that have not loaded all of their nodes; an error if one refuses to.
fn loading_containers(loads: &mut watch::Receiver<Loads>) -> Result<Vec<String>, Failure> {
    let loads = loads.borrow_and_update();
    let loading = loads.iter().filter_map(|(container, load)| match load {
        ContainerLoad::Loading => Some(Ok(container.clone())),
        ContainerLoad::Refused(why) => Some(Err(Failure::from_reason(format!("is unusable: {why}")))),
        ContainerLoad::Loaded(_) => None,
    });
    loading.collect()
}

/// Waits for a change; forever if there will be none.
async fn wait_changed<T>(of: &mut watch::Receiver<T>) {
    if of.changed().await.is_err() {
        std::future::pending().await
    }
}

/// Waits until the servant is not needed any more; returns the reason. It is withdrawn from its robot then.
pub(super) async fn wait_unneeded(inner: &Arc<ChoreographerInner>, handle: &Arc<Handle>, fresh: bool) -> String {
    let times = &inner.options;
    let grace = if handle.anonymous { times.anonymous_grace } else { times.grace };
    let (mut connections, mut life) = (handle.watch_connections(), handle.watch());
    let mut idle_since = None;
    loop {
        let now = Instant::now();
        let stage = match life.borrow_and_update().phase {
            Phase::Requested => ServantStage::Queued,
            Phase::Admitted => ServantStage::Admitted,
            Phase::Created | Phase::Starting => ServantStage::Starting,
            _ => ServantStage::Ready,
        };
        let count = *connections.borrow_and_update();
        let idle = stage == ServantStage::Ready && count == 0;
        let was_idle = idle_since.is_some();
        idle_since = idle.then(|| idle_since.unwrap_or(now.into_std()));
        let tenancy =
            Tenancy { stage, adopted: !fresh, anonymous: handle.anonymous, connections: count, idle_since, grace };
        let until = match retention(&tenancy, now.into_std()) {
            Retention::Stays => None,
            Retention::Until(until) => Some(Instant::from_std(until)),
            Retention::Over(reason) => {
                if inner.retire_if_idle(handle) {
                    handle.set_idle_until(None);
                    return reason;
                }
                // A client has just connected.
                continue;
            }
        };
        if idle != was_idle {
            let millis = idle.then(|| store::now() + grace.as_millis() as u64);
            handle.set_idle_until(millis);
        }
        if idle && !was_idle {
            // A request may have been waiting longer.
            inner.make_room();
        }
        tokio::select! {
            _ = connections.changed() => {}
            _ = life.changed() => {}
            () = tokio::time::sleep_until(until.unwrap_or(now)), if until.is_some() => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_that_is_not_active_yet_is_missing() {
        let stage = |begins| reach::lifecycle::LifecycleStage { state: "inactive".to_owned(), refused: None, begins };
        let stages = [("/arm", stage(true)), ("/eye", stage(false))];
        let stages = Stages::from(stages.map(|(node, stage)| (node.to_owned(), stage)));
        let missing: Vec<String> = inactive_nodes(&stages).collect();
        assert_eq!(missing, ["the node /arm, which is not active yet"]);
    }
}
