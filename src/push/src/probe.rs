//! Probes the interface of a new image: starts it once, as a servant, and observes it.

mod started;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use api::PushOptions;
use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use reach::{describe_exit, master};
use rootfs_builder::BuildOutcome;
use rootfs_builder::probe::{CpuTime, CpuTimeSource, ProbeOptions, ProbeResult};
use ros::schema::Registry;
use servant::engine::{ContainerState, LogLine, NodeExit, ServantHandle};
use servant::spec::Spec;
use tracing::Instrument;

use super::reporter::Reporter;
use super::{Pusher, naming, supplement};
use crate::Error;
use choreographer::Permit;
use foreign::terminal;
use store::Plan;

pub(super) use started::{ProbeServant, RoomGuard};

/// Name of the observing node.
pub(super) const NODE: &str = "/cloudroid_probe";
/// CPU weight of the probe, as of a build: servants take precedence when cores are scarce.
const WEIGHT: u64 = 20;
/// Number of log lines that explain a node's failure.
const LOG_LINES: usize = 20;

/// Starts the image once and records its interface. If a robot needs the reserved resources meanwhile, the probe is
/// stopped and starts again when there is room.
pub(super) async fn probe_interface(
    pusher: &Pusher,
    id: &str,
    built: &BuildOutcome,
    plan: &mut Plan,
    options: &PushOptions,
    report: &Reporter,
) -> Result<ProbeResult, Error> {
    loop {
        let room = admit_probe(pusher, options, report).await?;
        let (alive, mut gone) = RoomGuard::with_room(room);
        let tried = {
            // The plan is updated only if the probe runs to completion.
            let mut plan = plan.clone();
            let found = tokio::select! {
                biased;
                found = probe_once(pusher, id, built, &mut plan, options, &alive) => Some(found?),
                () = alive.room().wait_needed() => None,
            };
            found.map(|found| (found, plan))
        };
        if let Some((found, settled)) = tried {
            *plan = settled;
            return Ok(found);
        }
        let words = "a robot needs this capacity: stopping the started image, to start it again later";
        report.step(words).await;
        // A task stops what was started; it keeps the reservation until nothing is left of it.
        drop(alive);
        let _ = gone.recv().await;
    }
}

/// Starts the image and observes it.
async fn probe_once(
    pusher: &Pusher,
    id: &str,
    built: &BuildOutcome,
    plan: &mut Plan,
    options: &PushOptions,
    alive: &RoomGuard,
) -> Result<ProbeResult, Error> {
    if let Err(error) = naming::resolve_names(pusher, id, built, plan, options, alive).await {
        return Err(with_advice(pusher, built, error).await);
    }
    let mut marked = plan.clone();
    let marks = naming::mark_nodes_without_namespace(&mut marked, &built.flavour);
    let spec = self::probe_spec(pusher, id, built, &marked, options);
    let (servant, trial) = start(pusher, spec, alive).await?;
    let unmet = servant.enforced_limits().unmet_limits(&options.limits);
    let found = observe_interface(pusher, &servant, built, plan, marks, options).await;
    trial.end().await?;
    let mut found = match found {
        Ok(found) => found,
        Err(error) => return Err(with_advice(pusher, built, error).await),
    };
    naming::move_nodes(plan, &found.moved);
    let version = built.flavour.ros.ros_version();
    let unused = naming::unused_parameters(plan, &found.interface, options, version);
    found.warnings.extend(unused);
    let warn = |what| format!("servants will run without a requested limit: {what}");
    found.warnings.extend(unmet.into_iter().map(warn));
    Ok(found)
}

/// Starts a servant that is stopped when the guard is dropped, since a push can be cancelled at any await. The start
/// itself is not interrupted, because a half-started servant has no handle to stop it by.
pub(super) async fn start(
    pusher: &Pusher,
    spec: Spec,
    alive: &RoomGuard,
) -> Result<(Arc<dyn ServantHandle>, ProbeServant), Error> {
    let (engine, tasks) = (Arc::clone(&pusher.engine), pusher.tasks.clone());
    let alive = alive.clone();
    let starting = async move {
        let servant = engine.start(spec).await?;
        let trial = ProbeServant::new(Arc::clone(&servant), tasks, alive);
        Ok::<_, servant::Error>((servant, trial))
    };
    let started = pusher.tasks.spawn(starting.in_current_span()).await;
    Ok(started.map_err(|_| Error::Internal("starting the image once"))??)
}

/// Reserves resources as for any servant with these limits; waits until they are available.
async fn admit_probe(pusher: &Pusher, options: &PushOptions, report: &Reporter) -> Result<Permit, Error> {
    let (full, is_full) = tokio::sync::oneshot::channel();
    let patience = pusher.options.time;
    let admitted = pusher.choreographer.admit_like_a_servant(&options.limits, patience, || {
        let _ = full.send(());
    });
    let told = async {
        if is_full.await.is_ok() {
            report.step("waiting for free capacity to start it: this machine is full").await;
        }
        std::future::pending::<()>().await;
    };
    tokio::select! {
        admitted = admitted => Ok(admitted?),
        () = told => Err(Error::Ending),
    }
}

async fn observe_interface(
    pusher: &Pusher,
    servant: &Arc<dyn ServantHandle>,
    built: &BuildOutcome,
    plan: &Plan,
    marks: BTreeMap<String, String>,
    push: &PushOptions,
) -> Result<ProbeResult, Error> {
    let failed = |message: String| Error::Failed { message, next: None, log: Vec::new() };
    let options = ProbeOptions {
        patience: pusher.options.probe,
        types: push.interface.as_deref().map(supplement::topic_types).unwrap_or_default(),
        components: plan.components.clone(),
        marks,
        work: Some(cpu_time_source(servant)),
        ..ProbeOptions::new(plan.nodes.iter().map(|node| node.name.clone()).collect(), NODE)
    };
    let looking = async {
        let opener = &pusher.opener;
        let looked = tokio::select! {
            // Polled first: if a node has exited, no other error matters.
            biased;
            words = wait_for_failure(servant, plan) => return Err(failed(words)),
            looked = opener.observe(servant, built.flavour.ros.ros_version(), NODE, &plan.grants.egress) => {
                looked.map_err(|error| failed(format!("cannot reach the started image: {error}")))?
            }
        };
        // Not before the way to granted hosts is open: nodes may look for one as the first thing they do.
        let registry = Registry::with_definitions(built.flavour.ros.ros_version(), &built.inventory.definitions)
            .map_err(|error| failed(format!("invalid message definition in the image: {error}")))?;
        rootfs_builder::probe::probe(
            &looked.bus,
            &registry,
            &built.inventory.definitions,
            &options,
            wait_for_failure(servant, plan),
        )
        .await
        .map_err(|error| failed(error.to_string()))
    };
    match looking.await {
        Ok(found) => Ok(found),
        Err(error) => Err(with_node_logs(error, servant).await),
    }
}

/// Adds the options that provide what the nodes report as missing.
async fn with_advice(pusher: &Pusher, built: &BuildOutcome, error: Error) -> Error {
    match error {
        Error::Failed { message, next: None, log } => {
            let advice = pusher.builder.advice(&built.flavour.base, &log.join("\n")).await;
            Error::Failed { message, next: (!advice.is_empty()).then(|| advice.join("; ")), log }
        }
        other => other,
    }
}

/// Returns a source of the CPU time used by a servant's nodes.
pub(super) fn cpu_time_source(servant: &Arc<dyn ServantHandle>) -> CpuTimeSource {
    let servant = Arc::clone(servant);
    CpuTimeSource::new(move || measure_cpu_time(Arc::clone(&servant)))
}

async fn measure_cpu_time(servant: Arc<dyn ServantHandle>) -> Option<CpuTime> {
    let usage = servant.usage().await.ok()?;
    Some(CpuTime { ran: Duration::from_micros(usage.cpu_usec), waited: servant.cpu_wait_time().await })
}

/// Waits until a node exits unexpectedly, or the container does; returns a description.
pub(super) async fn wait_for_failure(servant: &Arc<dyn ServantHandle>, plan: &Plan) -> String {
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
                // Launch files may contain nodes that do one thing and exit.
                Ok(NodeExit { code: Some(0), .. }) if left > 0 => {}
                Ok(exit) => {
                    let how = describe_exit(&exit, &plan.limits);
                    return format!("{name} {how} before its interface was found");
                }
                // The state of the container has more details.
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
                format!("the started image ended before its interface was found: {reason}")
            }
            _ => "the container engine lost the started image".to_owned(),
        },
    }
}

/// Adds the last lines printed by the nodes to an error, and to its message what the node that it is about said last on
/// its standard error.
pub(super) async fn with_node_logs(error: Error, servant: &Arc<dyn ServantHandle>) -> Error {
    match error {
        Error::Failed { message, next, log } if log.is_empty() => {
            let lines = servant.logs(LOG_LINES, None).await;
            let message = with_last_words(message, &lines);
            let log = lines.into_iter().map(|line| format!("{}: {}", line.node, line.line)).collect();
            Error::Failed { message, next, log }
        }
        other => other,
    }
}

/// Adds the cause of an exit to a message that begins with the name of a node.
fn with_last_words(message: String, lines: &[LogLine]) -> String {
    let is_of_node = |line: &&LogLine| {
        let rest = message.strip_prefix(line.node.as_str());
        line.stream == "stderr" && !line.node.is_empty() && rest.is_some_and(|rest| rest.starts_with(' '))
    };
    let own: Vec<&str> = lines.iter().filter(is_of_node).map(|line| line.line.as_str()).collect();
    match rootfs_builder::find_exit_cause(own.iter().copied()) {
        Some(cause) => format!("{message}: {}", terminal::escape(&cause, false)),
        None => message,
    }
}

pub(super) fn probe_spec(pusher: &Pusher, id: &str, built: &BuildOutcome, plan: &Plan, options: &PushOptions) -> Spec {
    Spec {
        id: format!("{id}-probe"),
        image: built.image.to_string(),
        limits: options.limits.or(api::Limits { cpu_weight: Some(WEIGHT), ..pusher.choreographer.default_limits() }),
        environment: plan.environment.clone(),
        nodes: plan.nodes.clone(),
        grants: plan.grants.clone(),
        resident: master::resident_config(&built.flavour, &plan.parameters),
    }
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::*;

    #[test]
    fn a_failure_is_told_with_the_last_words_of_its_node() {
        let line = |node: &str, stream: &str, line: &str| LogLine {
            number: None,
            time: SystemTime::UNIX_EPOCH,
            node: node.to_owned(),
            stream: stream.to_owned(),
            line: line.to_owned(),
        };
        let lines = [
            line("/see", "stderr", "    import scipy"),
            line("/see", "stderr", "ModuleNotFoundError: No module named 'scipy'"),
            line("/see_more", "stderr", "ValueError: another node's"),
            line("/see", "stdout", "RuntimeError: only printed"),
        ];
        let said = |message: &str| with_last_words(message.to_owned(), &lines);
        let exited = "/see exited with code 1 before its interface was found";
        assert_eq!(said(exited), format!("{exited}: ModuleNotFoundError: No module named 'scipy'"));
        for other in ["/quiet exited with code 1", "the started image ended"] {
            assert_eq!(said(other), other);
        }
    }
}
