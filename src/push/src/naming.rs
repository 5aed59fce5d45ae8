//! Names of nodes that were started without an explicit name (`--node`): those given by their programs, as under
//! rosrun.
//!
//! The name is known only when a program runs, but parameters must be set before. So each program is started once with
//! a unique mark that identifies its nodes, and stopped as soon as it has registered. From then on it is started with
//! that name explicitly; a random suffix (of an anonymous node) would differ each time.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use api::PushOptions;
use package::interface::Interface;
use package::names::is_graph_name;
use rootfs_builder::BuildOutcome;
use rootfs_builder::probe::{ProbeError, ProbeOptions, wait_until_still};
use ros::bus::parameter_names::spell_in_ros2;
use ros::bus::{Graph, ParamValue, RosVersion};
use ros::flavour::{Flavour, NodeRename};
use ros::plumbing;
use ros::ros2;
use ros::ros2::composition::Component;
use servant::engine::ServantHandle;
use servant::spec::NodeSpec;
use tokio::sync::watch;
use tokio::time::timeout;

use super::Pusher;
use super::probe::{self, NODE, RoomGuard};
use crate::Error;
use store::Plan;

/// In ROS 2 a program may have several nodes, which register one after the other; the first by name identifies the
/// program. A name that is taken gets a numeric suffix, as all nodes of a second such program do. The probe waits for
/// further nodes until none has registered for `QUIET` after the last one, and at most for `MORE_NODES`, both in the
/// nodes' own time, which stands still while they wait for a core.
const QUIET: Duration = Duration::from_millis(200);
const MORE_NODES: Duration = Duration::from_secs(2);

/// Maximum number of parameters named in a warning.
const MAX_NAMED_PARAMETERS: usize = 12;

/// Returns the mark of the node at an index of the plan, while names are probed.
fn mark_for_index(index: usize) -> String {
    format!("/cloudroid_name_{index}")
}

/// Gives the unnamed nodes of `plan` the names that their programs use.
pub(super) async fn resolve_names(
    pusher: &Pusher,
    id: &str,
    built: &BuildOutcome,
    plan: &mut Plan,
    options: &PushOptions,
    alive: &RoomGuard,
) -> Result<(), Error> {
    let planned = built.plan.nodes.iter().enumerate();
    let unnamed: Vec<usize> = planned.filter(|(_, node)| !node.named).map(|(index, _)| index).collect();
    if unnamed.is_empty() {
        return Ok(());
    }
    let mut alone = plan.clone();
    alone.nodes = unnamed
        .iter()
        .map(|index| {
            let mut node = plan.nodes[*index].clone();
            let marked = built.flavour.marker_identity(&mark_for_index(*index));
            node.argv.extend(marked.arguments);
            node.environment.extend(marked.environment);
            node
        })
        .collect();
    let mut spec = probe::probe_spec(pusher, id, built, &alone, options);
    spec.id = format!("{id}-names");
    let (servant, trial) = probe::start(pusher, spec, alive).await?;
    let ros = built.flavour.ros.ros_version();
    let found = find_names(pusher, &servant, ros, &alone, &unnamed).await;
    trial.end().await?;
    apply_names(plan, &built.flavour, &unnamed, &found?, options);
    Ok(())
}

/// Names of the programs' nodes by index in the plan, sorted by name.
type FoundNames = BTreeMap<usize, Vec<NodeRename>>;

/// Probes the names by index, as far as possible; those of nodes that exit immediately stay unknown.
async fn find_names(
    pusher: &Pusher,
    servant: &Arc<dyn ServantHandle>,
    ros: RosVersion,
    alone: &Plan,
    unnamed: &[usize],
) -> Result<FoundNames, Error> {
    let failed = |message: String| Error::Failed { message, next: None, log: Vec::new() };
    // The host name of a container is its id.
    let host = servant.id();
    let opener = &pusher.opener;
    let looked = opener
        .observe(servant, ros, NODE, &[])
        .await
        .map_err(|error| failed(format!("cannot reach the started image: {error}")))?;
    let mut graph = looked.bus.graph();
    let seen = graph.clone();
    let options = ProbeOptions {
        ros,
        patience: pusher.options.probe,
        settle: QUIET,
        restless: MORE_NODES,
        work: Some(probe::cpu_time_source(servant)),
        ..ProbeOptions::new(alone.nodes.iter().map(|node| node.name.clone()).collect(), NODE)
    };
    let all_there = |graph: &Arc<Graph>| names_in_graph(ros, graph, unnamed, host).len() == unnamed.len();
    let registered = tokio::select! {
        biased;
        // If a node exits here, the error is reported when it is started again with its parameters.
        _ = probe::wait_for_failure(servant, alone) => Ok(()),
        registered = wait_until_registered(&mut graph, all_there, &options) => match registered {
            // Granted hosts cannot be reached here; they can when the interface is probed.
            Err(ProbeError::NeverRegistered { .. }) if !alone.grants.egress.is_empty() => Ok(()),
            registered => registered,
        },
    };
    let found = names_in_graph(ros, &seen.borrow(), unnamed, host);
    looked.bus.close().await;
    match registered {
        Ok(()) => Ok(found),
        Err(error) => Err(probe::with_node_logs(failed(error.to_string()), servant).await),
    }
}

/// Waits until all nodes are registered, and no others follow.
async fn wait_until_registered(
    graph: &mut watch::Receiver<Arc<Graph>>,
    all_there: impl FnMut(&Arc<Graph>) -> bool,
    options: &ProbeOptions,
) -> Result<(), ProbeError> {
    let there = timeout(options.patience, graph.wait_for(all_there)).await;
    match there.map(|there| there.map(drop)) {
        Ok(Ok(())) => {}
        Ok(Err(_)) => return Err(ProbeError::MasterGone),
        Err(_) => {
            return Err(ProbeError::NeverRegistered {
                nodes: options.nodes.clone(),
                after: options.patience,
                sought: Vec::new(),
            });
        }
    }
    // In ROS 1 a program has one node.
    if options.ros == RosVersion::Two {
        wait_until_still(graph, options).await?;
    }
    Ok(())
}

/// Assigns the nodes of the graph to programs: in ROS 2 by absolute name, in ROS 1 by the name below the marked
/// namespace, which nobody else uses. `host` is the host name that the programs see.
fn names_in_graph(ros: RosVersion, graph: &Graph, unnamed: &[usize], host: &str) -> FoundNames {
    let mut names = FoundNames::new();
    for index in unnamed {
        let mark = mark_for_index(*index);
        let mut said: Vec<&str> = match ros {
            RosVersion::One => {
                let all = graph.nodes.keys();
                all.filter_map(|node| node.strip_prefix(&*mark)?.strip_prefix('/')).collect()
            }
            RosVersion::Two => {
                let own = graph.enclaves.get(&mark).into_iter().flatten();
                // Hidden nodes do not name a program.
                let shown = own.filter(|node| !ros2::names::is_hidden(node));
                shown.map(String::as_str).collect()
            }
        };
        // A program may ignore its mark; if it is the only one, its nodes are known anyway.
        if said.is_empty() && unnamed.len() == 1 {
            let others = graph.nodes.keys().filter(|node| *node != NODE);
            said.extend(others.map(String::as_str));
        }
        // Names registered by a program are untrusted.
        let called = said.into_iter().map(|own| classify_name(own, host));
        let known = |called: &NodeRename| is_graph_name(&format!("/{}", called.node.trim_start_matches('/')));
        let mut called: Vec<NodeRename> = called.filter(known).collect();
        // No remapping rule can match one of several nodes whose name varies.
        if called.iter().any(|called| called.own.is_some()) {
            called.retain(|called| called.own.is_some());
        }
        if !called.is_empty() {
            names.insert(*index, called);
        }
    }
    names
}

/// Returns the stable part of the name that a program gave its node; `own` is set only if the whole name is stable.
fn classify_name(own: &str, host: &str) -> NodeRename {
    let without = without_host(without_random_end(own), host);
    NodeRename { own: (without == own).then(|| own.to_owned()), node: without }
}

/// Removes the unique suffix of an anonymous node's name: `_PID_MILLISECONDS` (rospy), `_NANOSECONDS` (roscpp).
fn without_random_end(name: &str) -> &str {
    let cut = |name: &str, digits: usize| -> Option<usize> {
        let (_, end) = name.rsplit_once('_')?;
        let number = !end.is_empty() && end.bytes().all(|byte| byte.is_ascii_digit());
        (number && end.len() >= digits).then(|| name.len() - end.len() - 1)
    };
    let Some(at) = cut(name, 12).filter(|at| *at > 0) else {
        return name;
    };
    let shorter = &name[..at];
    let nanoseconds = name.len() - at > 16;
    match cut(shorter, 1).filter(|at| *at > 0 && !nanoseconds) {
        Some(at) => &shorter[..at],
        None => shorter,
    }
}

/// Removes the host name from a node's name (`cpu_monitor_HOST`), since it is that of a container and different each
/// time. Returns an empty string if nothing else is left.
fn without_host(name: &str, host: &str) -> String {
    // Hyphens are not allowed in node names.
    let host = host.replace('-', "_");
    if host.is_empty() || !name.contains(&host) {
        return name.to_owned();
    }
    let part = |part: &str| match part.split_once(host.as_str()) {
        Some((before, after)) => {
            let parts = [before.trim_end_matches('_'), after.trim_start_matches('_')];
            let parts: Vec<&str> = parts.into_iter().filter(|part| !part.is_empty()).collect();
            parts.join("_")
        }
        None => part.to_owned(),
    };
    let parts: Vec<String> = name.split('/').map(part).collect();
    // Empty namespaces are dropped; the leading slash of an absolute name is kept.
    let left = parts.iter().enumerate().filter(|(at, part)| *at == 0 || !part.is_empty());
    let left: Vec<&str> = left.map(|(_, part)| part.as_str()).collect();
    left.join("/")
}

/// Writes the names into the plan and moves private parameters accordingly. A node whose name is unknown keeps the
/// guessed one.
fn apply_names(plan: &mut Plan, flavour: &Flavour, unnamed: &[usize], found: &FoundNames, options: &PushOptions) {
    let mut taken: BTreeSet<String> = plan
        .nodes
        .iter()
        .enumerate()
        .filter(|(index, _)| !unnamed.contains(index))
        .map(|(_, node)| node.name.clone())
        .collect();
    for index in unnamed {
        let guess = plan.nodes[*index].name.clone();
        let above = guess.rsplit_once('/').map_or("", |(above, _)| above);
        let mut called = found.get(index).cloned().unwrap_or_default();
        for called in &mut called {
            if !called.node.starts_with('/') {
                called.node = format!("{above}/{}", called.node);
            }
        }
        assign_free_names(&mut called, &mut taken);
        if called.is_empty() {
            called.push(NodeRename { own: None, node: guess.clone() });
            assign_free_names(&mut called, &mut taken);
        }
        let (name, identity) = (called[0].node.clone(), flavour.rename_identity(&called));
        for key in options.params.keys().filter(|key| !key.starts_with('/')) {
            let bare = key.trim_start_matches(['~', '_']);
            if let Some(value) = plan.parameters.remove(&format!("{guess}/{bare}")) {
                plan.parameters.insert(format!("{name}/{bare}"), value);
            }
        }
        let node = &mut plan.nodes[*index];
        node.name = name;
        tell_parameters(flavour, node, &plan.parameters);
        flavour.insert_arguments(identity.arguments, &mut node.argv);
        node.environment.extend(identity.environment);
    }
}

/// Reserves the names of a program's nodes, with a numeric suffix if one is taken. All nodes of the program with the
/// same base name get the same suffix regardless of their namespaces, since there is one remapping rule for them.
fn assign_free_names(called: &mut [NodeRename], taken: &mut BTreeSet<String>) {
    let wanted: Vec<String> = called.iter().map(|called| called.node.clone()).collect();
    let last = |name: &str| name.rsplit_once('/').map_or(0, |(above, _)| above.len() + 1);
    let numbered = |name: &str, number: usize| match number {
        1 => name.to_owned(),
        _ => format!("{name}_{number}"),
    };
    for (called, name) in called.iter_mut().zip(&wanted) {
        let same = |other: &&String| other[last(other)..] == name[last(name)..];
        let fits = |number: &usize| {
            let mut same = wanted.iter().filter(same);
            same.all(|other| !taken.contains(&numbered(other, *number)))
        };
        let number = (1..).find(fits).unwrap_or(1);
        called.node = numbered(name, number);
    }
    taken.extend(called.iter().map(|called| called.node.clone()));
}

/// Passes a node its parameters on the command line, if nodes hold their own parameters, unless they are already there
/// (a node of an exported service).
pub(super) fn tell_parameters(flavour: &Flavour, node: &mut NodeSpec, all: &BTreeMap<String, ParamValue>) {
    let arguments = flavour.parameter_arguments(&node.name, all);
    let told = |argv: &[String]| argv.windows(arguments.len().max(1)).any(|part| part == arguments);
    if !arguments.is_empty() && !told(&node.argv) {
        node.argv.extend(arguments);
    }
}

/// Marks nodes that were given a name but no namespace (by a launch file, for example), since their programs may choose
/// one. Returns the marks by node name.
pub(super) fn mark_nodes_without_namespace(plan: &mut Plan, flavour: &Flavour) -> BTreeMap<String, String> {
    let nodes = plan.nodes.iter_mut().enumerate();
    let free = nodes.filter(|(_, node)| flavour.can_choose_namespace(&node.argv));
    free.map(|(index, node)| {
        let mark = mark_for_index(index);
        node.argv.extend(flavour.marker_identity(&mark).arguments);
        (node.name.clone(), mark)
    })
    .collect()
}

/// Moves nodes and their parameters to the namespaces that their programs chose.
pub(super) fn move_nodes(plan: &mut Plan, moved: &BTreeMap<String, String>) {
    for (name, there) in moved {
        for node in plan.nodes.iter_mut().filter(|node| node.name == *name) {
            node.name.clone_from(there);
        }
        let parameters = std::mem::take(&mut plan.parameters).into_iter();
        plan.parameters = parameters
            .map(|(key, value)| match key.strip_prefix(&**name) {
                Some(rest) if rest.starts_with('/') => (format!("{there}{rest}"), value),
                _ => (key, value),
            })
            .collect();
    }
}

/// Returns whether a name is another one, or below it.
fn is_below(key: &str, name: &str) -> bool {
    key.strip_prefix(name).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
}

/// Returns warnings about parameters that were given for an unknown node, or that no node declared (ROS 2) or read.
pub(super) fn unused_parameters(
    plan: &Plan,
    interface: &Interface,
    options: &PushOptions,
    version: RosVersion,
) -> Vec<String> {
    let loaded = plan.components.values().flatten();
    let loaded: Vec<String> = loaded.filter_map(Component::full_name).collect();
    let names = plan.nodes.iter().map(|node| node.name.as_str());
    let names: Vec<&str> = names.chain(loaded.iter().map(String::as_str)).collect();
    let mut warnings = Vec::new();
    for key in options.params.keys() {
        // A global parameter such as `/rate` is for all nodes.
        let of_a_name = key.starts_with('/') && key[1..].contains('/');
        let known = names.iter().any(|name| is_below(key, name));
        let read = interface.parameters.iter().any(|parameter| {
            !parameter.read_by.is_empty() && (is_below(key, &parameter.name) || is_below(&parameter.name, key))
        });
        if of_a_name && !known && !read {
            warnings.push(format!(
                "parameter {key} matches no node, and no node read it; the nodes are {}",
                names.join(", ")
            ));
        }
        if let Some(has) = describe_undeclared(interface, key) {
            warnings.push(format!("no node declares a parameter {key}, so it has no effect; {has}"));
        } else if version == RosVersion::One && (known || !of_a_name) && !is_read(interface, key, &names) {
            warnings.push(format!(
                "no node has read a parameter {key} since it was started, so it has no effect unless one reads it \
                 later; {}",
                describe_read(interface)
            ));
        }
    }
    warnings
}

/// Returns whether a node of ROS 1, which declares nothing, was seen to read a parameter: the whole of it, a part, or
/// what it is a part of.
fn is_read(interface: &Interface, key: &str, nodes: &[&str]) -> bool {
    let bare = key.trim_start_matches(['~', '_']);
    if plumbing::is_builtin_parameter(bare.rsplit('/').next().unwrap_or_default()) {
        return true;
    }
    let full: Vec<String> = if bare.starts_with('/') {
        vec![bare.to_owned()]
    } else {
        nodes.iter().map(|node| format!("{node}/{bare}")).collect()
    };
    let end = format!("/{}", bare.trim_start_matches('/'));
    interface.parameters.iter().filter(|parameter| !parameter.read_by.is_empty()).any(|parameter| {
        let name = &parameter.name;
        // A program may read it under the name of another node, as nodelets do.
        name.ends_with(&end) || full.iter().any(|full| is_below(full, name) || is_below(name, full))
    })
}

/// Names the parameters that were read.
fn describe_read(interface: &Interface) -> String {
    let read = interface.parameters.iter().filter(|parameter| !parameter.read_by.is_empty());
    let names: Vec<&str> = read.map(|parameter| parameter.name.as_str()).take(MAX_NAMED_PARAMETERS).collect();
    if names.is_empty() { "none was read".to_owned() } else { format!("read were {}", names.join(", ")) }
}

/// If nodes have their own parameters (ROS 2) and none has one of this name, returns a description of those that exist.
fn describe_undeclared(interface: &Interface, key: &str) -> Option<String> {
    let own: Vec<_> = interface.parameters.iter().filter(|parameter| parameter.own_name().is_some()).collect();
    // Levels of a name are separated by dots there; a global parameter such as `/rate` is for all nodes.
    let wanted = key.trim_start_matches(['~', '_']);
    let is_it = |parameter: &&&package::interface::Parameter| {
        let name = parameter.own_name().unwrap_or_default();
        let below = |whole: &str| {
            let whole = spell_in_ros2(whole);
            name == whole || name.strip_prefix(&whole).is_some_and(|rest| rest.starts_with('.'))
        };
        match wanted.strip_prefix(&parameter.node) {
            Some(rest) if rest.starts_with('/') => below(&rest[1..]),
            _ => below(wanted.trim_start_matches('/')),
        }
    };
    let last = wanted.rsplit('/').next().unwrap_or_default();
    if own.is_empty() || plumbing::is_builtin_parameter(last) || own.iter().any(|it| is_it(&it)) {
        return None;
    }
    let mut names: Vec<&str> = own.iter().map(|it| it.name.as_str()).collect();
    names.truncate(MAX_NAMED_PARAMETERS);
    Some(format!("declared: {}", names.join(", ")))
}

#[cfg(test)]
mod tests;
