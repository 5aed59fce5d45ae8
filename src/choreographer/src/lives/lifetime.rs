//! Carries out what is decided of a servant's lifetime: waits until it can be used, and until nobody needs it.

use std::sync::Arc;

use api::Phase;
use package::interface::Interface;
use reach::Reach;
use reach::components::{Load, Loads};
use reach::lifecycle::Stages;
use reach::readiness::{missing, missing_nodes};
use tokio::sync::watch;
use tokio::time::{Instant, timeout_at};

use super::Inner;
use crate::decide::lifetime::{Need, Readiness, Shown, Stage, Tenancy, needed, readiness};
use crate::lives::handle::{Failure, Handle};

/// Waits until everything that the interface promises is registered. Nodes may take their time between their
/// registration and their first topic: all that the servant's start may take.
pub(super) async fn interface_there(
    inner: &Inner,
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
        if let Some(refused) = lifecycles.as_mut().and_then(refused) {
            return Err(Failure::broken(format!("is of no use: {refused}")));
        }
        let loading = match loads.as_mut().map(still_loading) {
            Some(Err(refused)) => return Err(Failure::broken(format!("is of no use: {refused}"))),
            loading => loading.and_then(Result::ok).unwrap_or_default(),
        };
        let mut missing = missing(interface, &graph);
        let mut nodes_missing = missing_nodes(interface, &graph);
        if let Some(stages) = &lifecycles {
            missing.extend(beginning(&stages.borrow()));
        }
        for container in loading {
            missing.push(format!("what is loaded into {container}"));
            nodes_missing.push(format!("the nodes of {container}"));
        }
        let shown = Shown {
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
                let about = handle.about();
                inner
                    .journal
                    .warning("interface-incomplete", &message, &about);
                return Ok(());
            }
            Readiness::Late(reason) => return Err(Failure::broken(reason)),
        };
        tokio::select! {
            shown = timeout_at(until, graphs.changed()) => match shown {
                Ok(Ok(())) => changed = Instant::now(),
                Ok(Err(_)) => return Err(Failure::broken("lost its ROS")),
                Err(_) => {}
            },
            // A node that becomes active is about to show more.
            () = changes(&mut lifecycles) => changed = Instant::now(),
            () = changes(&mut loads) => changed = Instant::now(),
        }
    }
}

/// Why a node with a lifecycle does not do its work, if one does not.
fn refused(stages: &mut watch::Receiver<Stages>) -> Option<String> {
    let stages = stages.borrow_and_update();
    stages.values().find_map(|stage| stage.refused.clone())
}

/// Nodes that are on their way to be active, as something that is missing.
fn beginning(stages: &Stages) -> impl Iterator<Item = String> {
    let begin = stages.iter().filter(|(_, stage)| stage.begins);
    begin.map(|(node, _)| format!("the node {node}, which is not active yet"))
}

/// Containers that have not loaded all of their nodes; else why one does not load one.
fn still_loading(loads: &mut watch::Receiver<Loads>) -> Result<Vec<String>, String> {
    let loads = loads.borrow_and_update();
    let loading = loads.iter().filter_map(|(container, load)| match load {
        Load::Loading => Some(Ok(container.clone())),
        Load::Refused(why) => Some(Err(why.clone())),
        Load::Loaded(_) => None,
    });
    loading.collect()
}

async fn changes<T>(of: &mut Option<watch::Receiver<T>>) {
    let changed = match of {
        Some(of) => of.changed().await,
        None => return std::future::pending().await,
    };
    if changed.is_err() {
        *of = None;
    }
}

/// Comes back when nobody needs the servant any more, with the reason. It is given to nobody from then on.
pub(super) async fn unneeded(inner: &Arc<Inner>, handle: &Arc<Handle>, fresh: bool) -> String {
    let times = &inner.options;
    let grace = match handle.anonymous {
        true => times.anonymous_grace,
        false => times.grace,
    };
    let (mut connections, mut life) = (handle.watch_connections(), handle.watch());
    let mut idle_since = None;
    loop {
        let now = Instant::now();
        let stage = match life.borrow_and_update().phase {
            Phase::Requested => Stage::Queued,
            Phase::Admitted => Stage::Admitted,
            Phase::Created | Phase::Starting => Stage::Starting,
            _ => Stage::Ready,
        };
        let count = *connections.borrow_and_update();
        let idle = stage == Stage::Ready && count == 0;
        let was_idle = idle_since.is_some();
        idle_since = idle.then(|| idle_since.unwrap_or(now.into_std()));
        let tenancy = Tenancy {
            stage,
            adopted: !fresh,
            anonymous: handle.anonymous,
            connections: count,
            idle_since,
            grace,
        };
        let until = match needed(&tenancy, now.into_std()) {
            Need::Stays => None,
            Need::Until(until) => Some(Instant::from_std(until)),
            Need::Over(reason) => {
                if inner.retire_if_idle(handle) {
                    handle.set_idle_until(None);
                    return reason;
                }
                // Somebody came just now.
                continue;
            }
        };
        if idle != was_idle {
            let millis = idle.then(|| store::now() + grace.as_millis() as u64);
            handle.set_idle_until(millis);
        }
        if idle && !was_idle {
            // Somebody may have been waiting for longer.
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
        let stage = |begins| reach::lifecycle::Stage {
            state: "inactive".to_owned(),
            refused: None,
            begins,
        };
        let stages = [("/arm", stage(true)), ("/eye", stage(false))];
        let stages = Stages::from(stages.map(|(node, stage)| (node.to_owned(), stage)));
        let missing: Vec<String> = beginning(&stages).collect();
        assert_eq!(missing, ["the node /arm, which is not active yet"]);
    }
}
