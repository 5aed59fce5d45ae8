//! Finds the interface of a new image: it is started once, as a servant, and looked at.

mod started;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use api::PushOptions;
use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use reach::{how_it_ended, master};
use rootfs_builder::BuildOutcome;
use rootfs_builder::probe::{Found, ProbeOptions, Work, Worked};
use ros::schema::Registry;
use servant::engine::{ContainerState, NodeExit, Servant};
use servant::spec::Spec;

use super::request::Reporter;
use super::{Pusher, naming, supplement};
use crate::Error;
use choreographer::Permit;
use store::Plan;

pub(super) use started::{Alive, ProbeServant};

/// The name of the looking node.
pub(super) const NODE: &str = "/cloudroid_probe";
/// As of a build: servants go before it where cores do not suffice.
const WEIGHT: u64 = 20;
/// Lines of a node's log that explain its failure.
const LOG_LINES: usize = 20;

/// Starts the image once and records what it shows. Where a robot needs its room meanwhile, it is ended, and begins again
/// when there is room.
pub(super) async fn interface(
    pusher: &Pusher,
    id: &str,
    built: &BuildOutcome,
    plan: &mut Plan,
    options: &PushOptions,
    report: &Reporter,
) -> Result<Found, Error> {
    loop {
        let room = room(pusher, options, report).await?;
        let (alive, mut gone) = Alive::begin(room);
        let tried = {
            // What it learns counts when it was there to the end.
            let mut plan = plan.clone();
            let found = tokio::select! {
                biased;
                found = shown(pusher, id, built, &mut plan, options, &alive) => Some(found?),
                () = alive.room().is_needed() => None,
            };
            found.map(|found| (found, plan))
        };
        if let Some((found, settled)) = tried {
            *plan = settled;
            return Ok(found);
        }
        let words = "a robot needs its room: it is ended, and started again when there is room";
        report.step(words).await;
        // What was started is being ended by a task, which has the room as long as something is left of it.
        drop(alive);
        let _ = gone.recv().await;
    }
}

/// What the image shows when it is started.
async fn shown(
    pusher: &Pusher,
    id: &str,
    built: &BuildOutcome,
    plan: &mut Plan,
    options: &PushOptions,
    alive: &Alive,
) -> Result<Found, Error> {
    naming::settle(pusher, id, built, plan, options, alive).await?;
    let mut marked = plan.clone();
    let marks = naming::mark(&mut marked, &built.flavour);
    let spec = self::spec(pusher, id, built, &marked, options);
    let (servant, trial) = start(pusher, spec, alive).await?;
    let unmet = servant
        .enforced()
        .unmet(&choreographer::engine_limits(&options.limits));
    let found = look(pusher, &servant, built, plan, marks, options).await;
    trial.end().await?;
    let mut found = match found {
        Ok(found) => found,
        Err(error) => return Err(advised(pusher, built, error).await),
    };
    naming::place(plan, &found.moved);
    let unused = naming::unused(plan, &found.interface, options);
    found.warnings.extend(unused);
    let warn = |what| format!("servants will run without a limit that was asked for: {what}");
    found.warnings.extend(unmet.into_iter().map(warn));
    Ok(found)
}

/// Starts it; it is ended however the trial is dropped: a push can be cancelled at any await. Starting itself is not
/// interrupted, because what is half-started has no handle to end it by.
pub(super) async fn start(
    pusher: &Pusher,
    spec: Spec,
    alive: &Alive,
) -> Result<(Arc<dyn Servant>, ProbeServant), Error> {
    let (engine, tasks) = (Arc::clone(&pusher.engine), pusher.tasks.clone());
    let alive = alive.clone();
    let starting = pusher.tasks.spawn(async move {
        let servant = engine.start(spec).await?;
        let trial = ProbeServant::new(Arc::clone(&servant), tasks, alive);
        Ok::<_, servant::Error>((servant, trial))
    });
    let started = starting.await;
    Ok(started.map_err(|_| Error::Internal("starting the image once"))??)
}

/// Room for it, as for any servant of these limits: waited for where there is none.
async fn room(pusher: &Pusher, options: &PushOptions, report: &Reporter) -> Result<Permit, Error> {
    let (full, is_full) = tokio::sync::oneshot::channel();
    let patience = pusher.options.time;
    let admitted = pusher
        .choreographer
        .admit_like_a_servant(&options.limits, patience, || {
            let _ = full.send(());
        });
    let told = async {
        if is_full.await.is_ok() {
            report
                .step("waiting for room to start it: this machine is full")
                .await;
        }
        std::future::pending::<()>().await;
    };
    tokio::select! {
        admitted = admitted => Ok(admitted?),
        () = told => Err(Error::Ending),
    }
}

async fn look(
    pusher: &Pusher,
    servant: &Arc<dyn Servant>,
    built: &BuildOutcome,
    plan: &Plan,
    marks: BTreeMap<String, String>,
    push: &PushOptions,
) -> Result<Found, Error> {
    let failed = |message: String| Error::Failed {
        message,
        next: None,
        log: Vec::new(),
    };
    let registry = Registry::of_definitions(built.flavour.ros.bus(), &built.inventory.definitions)
        .map_err(|error| failed(format!("a definition in the image is unusable: {error}")))?;
    let options = ProbeOptions {
        patience: pusher.options.probe,
        types: push
            .interface
            .as_deref()
            .map(supplement::topic_types)
            .unwrap_or_default(),
        components: plan.components.clone(),
        marks,
        work: Some(work(servant)),
        ..ProbeOptions::new(
            plan.nodes.iter().map(|node| node.name.clone()).collect(),
            NODE,
        )
    };
    let looking = async {
        let opener = &pusher.opener;
        let looked = tokio::select! {
            // First: of a node that ended, nothing else is worth saying.
            biased;
            words = ended(servant, plan) => return Err(failed(words)),
            looked = opener.look(servant, built.flavour.ros.bus(), NODE, &plan.grants.egress) => {
                looked.map_err(|error| failed(format!("the started image cannot be reached: {error}")))?
            }
        };
        rootfs_builder::probe::probe(
            &looked.bus,
            &registry,
            &built.inventory.definitions,
            &options,
            ended(servant, plan),
        )
        .await
        .map_err(|error| failed(error.to_string()))
    };
    match looking.await {
        Ok(found) => Ok(found),
        Err(error) => Err(explained(error, servant).await),
    }
}

/// With the option that adds what the nodes say is missing.
async fn advised(pusher: &Pusher, built: &BuildOutcome, error: Error) -> Error {
    match error {
        Error::Failed {
            message,
            next: None,
            log,
        } => {
            let advice = pusher
                .builder
                .advice(&built.flavour.base, &log.join("\n"))
                .await;
            Error::Failed {
                message,
                next: (!advice.is_empty()).then(|| advice.join("; ")),
                log,
            }
        }
        other => other,
    }
}

/// What a servant's nodes have had of the processors.
pub(super) fn work(servant: &Arc<dyn Servant>) -> Work {
    let servant = Arc::clone(servant);
    Work::new(move || worked(Arc::clone(&servant)))
}

async fn worked(servant: Arc<dyn Servant>) -> Option<Worked> {
    let usage = servant.usage().await.ok()?;
    Some(Worked {
        ran: Duration::from_micros(usage.cpu_usec),
        waited: servant.waited().await,
    })
}

/// Comes back when a node ends that should not, or the container does, with what is to be said about it.
pub(super) async fn ended(servant: &Arc<dyn Servant>, plan: &Plan) -> String {
    let mut nodes: FuturesUnordered<_> = plan
        .nodes
        .iter()
        .filter(|node| !node.respawn)
        .map(|node| async move { (node.name.clone(), servant.wait_node(&node.name).await) })
        .collect();
    let mut left = plan.nodes.len();
    let node_ended = async {
        while let Some((name, exit)) = nodes.next().await {
            left -= 1;
            match exit {
                // Launch files have nodes that do one thing and end.
                Ok(NodeExit { code: Some(0), .. }) if left > 0 => {}
                Ok(exit) => {
                    let how = how_it_ended(&exit, &plan.limits);
                    return format!("{name} {how} before its interface was seen");
                }
                // The container's own state says more.
                Err(_) => {}
            }
        }
        std::future::pending().await
    };
    let mut states = servant.state();
    let over = states.wait_for(ContainerState::is_over);
    tokio::select! {
        biased;
        words = node_ended => words,
        over = over => match over.as_deref() {
            Ok(ContainerState::Stopped { reason } | ContainerState::Failed { reason }) => {
                format!("the started image ended before its interface was seen: {reason}")
            }
            _ => "the started image was lost by the engine".to_owned(),
        },
    }
}

/// With the last lines that the nodes printed.
pub(super) async fn explained(error: Error, servant: &Arc<dyn Servant>) -> Error {
    match error {
        Error::Failed { message, next, log } if log.is_empty() => {
            let lines = servant.logs(LOG_LINES, None).await;
            let log = lines
                .into_iter()
                .map(|line| format!("{}: {}", line.node, line.line))
                .collect();
            Error::Failed { message, next, log }
        }
        other => other,
    }
}

pub(super) fn spec(
    pusher: &Pusher,
    id: &str,
    built: &BuildOutcome,
    plan: &Plan,
    options: &PushOptions,
) -> Spec {
    Spec {
        id: format!("{id}-probe"),
        image: built.image.to_string(),
        limits: choreographer::engine_limits(&options.limits.or(api::Limits {
            cpu_weight: Some(WEIGHT),
            ..pusher.choreographer.default_limits()
        })),
        environment: plan.environment.clone(),
        nodes: plan.nodes.clone(),
        grants: plan.grants.clone(),
        resident: master::resident_config(&built.flavour, &plan.parameters),
    }
}
