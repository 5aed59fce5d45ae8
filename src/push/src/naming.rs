//! What nodes are called that were told no name (`--node`): what their programs say, as under rosrun.
//!
//! The name is known only when a program runs, and parameters must be there before it does. So it is started once, each
//! program with a mark of its own to tell its nodes by, and ended as soon as it has registered. From then on it is told that
//! name: one with a random end (an anonymous node's) would be another each time.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use api::PushOptions;
use package::interface::Interface;
use package::names::is_graph_name;
use rootfs_builder::BuildOutcome;
use rootfs_builder::probe::{ProbeError, ProbeOptions, still};
use ros::bus::{Graph, ParamValue, RosVersion};
use ros::flavour::{Called, Flavour};
use ros::plumbing;
use ros::ros2;
use ros::ros2::composition::Component;
use servant::engine::Servant;
use servant::spec::NodeSpec;
use tokio::sync::watch;
use tokio::time::timeout;

use super::Pusher;
use super::probe::{self, Alive, NODE};
use crate::Error;
use store::Plan;

/// A program may be several nodes (ROS 2), which come one after the other: its first by name is the one that it is called by. What is taken already
/// gets a number, as every node of a second such program does. Others are waited for until none has come for so long after one, and at most for so long:
/// of the nodes' own time, which stands still while they wait for a core.
const QUIET: Duration = Duration::from_millis(200);
const MORE_NODES: Duration = Duration::from_secs(2);

/// Parameters that a warning names.
const NAMED: usize = 12;

/// What the nodes of an index are marked by while their names are looked for.
fn mark_of(index: usize) -> String {
    format!("/cloudroid_name_{index}")
}

/// Gives the nodes of `plan` that were told no name the one that their program has.
pub(super) async fn settle(
    pusher: &Pusher,
    id: &str,
    built: &BuildOutcome,
    plan: &mut Plan,
    options: &PushOptions,
    alive: &Alive,
) -> Result<(), Error> {
    let planned = built.plan.nodes.iter().enumerate();
    let unnamed: Vec<usize> = planned
        .filter(|(_, node)| !node.named)
        .map(|(index, _)| index)
        .collect();
    if unnamed.is_empty() {
        return Ok(());
    }
    let mut alone = plan.clone();
    alone.nodes = unnamed
        .iter()
        .map(|index| {
            let mut node = plan.nodes[*index].clone();
            let marked = built.flavour.marked(&mark_of(*index));
            node.argv.extend(marked.arguments);
            node.environment.extend(marked.environment);
            node
        })
        .collect();
    let mut spec = probe::spec(pusher, id, built, &alone, options);
    spec.id = format!("{id}-names");
    let (servant, trial) = probe::start(pusher, spec, alive).await?;
    let ros = built.flavour.ros.bus();
    let found = look(pusher, &servant, ros, &alone, &unnamed).await;
    trial.end().await?;
    apply(plan, &built.flavour, &unnamed, &found?, options);
    Ok(())
}

/// What programs call their nodes, by index; the first by name first.
type Names = BTreeMap<usize, Vec<Called>>;

/// Names by index, as far as they could be found; those of nodes that end at once stay unknown.
async fn look(
    pusher: &Pusher,
    servant: &Arc<dyn Servant>,
    ros: RosVersion,
    alone: &Plan,
    unnamed: &[usize],
) -> Result<Names, Error> {
    let failed = |message: String| Error::Failed {
        message,
        next: None,
        log: Vec::new(),
    };
    // A container is a host of that name.
    let host = servant.id();
    let opener = &pusher.opener;
    let looked = opener
        .look(servant, ros, NODE, &[])
        .await
        .map_err(|error| failed(format!("the started image cannot be reached: {error}")))?;
    let mut graph = looked.bus.graph();
    let seen = graph.clone();
    let options = ProbeOptions {
        ros,
        patience: pusher.options.probe,
        settle: QUIET,
        restless: MORE_NODES,
        work: Some(probe::work(servant)),
        ..ProbeOptions::new(
            alone.nodes.iter().map(|node| node.name.clone()).collect(),
            NODE,
        )
    };
    let all_there = |graph: &Arc<Graph>| names(ros, graph, unnamed, host).len() == unnamed.len();
    let registered = tokio::select! {
        biased;
        // What it says of itself is told when it is started again, with its parameters.
        _ = probe::ended(servant, alone) => Ok(()),
        registered = registered(&mut graph, all_there, &options) => match registered {
            // Here it cannot reach what it was granted; it can when it is looked at.
            Err(ProbeError::NeverRegistered { .. }) if !alone.grants.egress.is_empty() => Ok(()),
            registered => registered,
        },
    };
    let found = names(ros, &seen.borrow(), unnamed, host);
    looked.bus.close().await;
    match registered {
        Ok(()) => Ok(found),
        Err(error) => Err(probe::explained(failed(error.to_string()), servant).await),
    }
}

/// Returns when all are there, and no others come.
async fn registered(
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
    // In ROS 1 a program is one node.
    if options.ros == RosVersion::Two {
        still(graph, options).await?;
    }
    Ok(())
}

/// Which nodes of the graph are whose: their absolute names in ROS 2; those below their namespace in ROS 1, where nobody else gives one. `host`: the name
/// of the machine that they think they run on.
fn names(ros: RosVersion, graph: &Graph, unnamed: &[usize], host: &str) -> Names {
    let mut names = Names::new();
    for index in unnamed {
        let mark = mark_of(*index);
        let mut said: Vec<&str> = match ros {
            RosVersion::One => {
                let all = graph.nodes.keys();
                all.filter_map(|node| node.strip_prefix(&*mark)?.strip_prefix('/'))
                    .collect()
            }
            RosVersion::Two => {
                let own = graph.enclaves.get(&mark).into_iter().flatten();
                // What tools do not show is no name to call a program by.
                let shown = own.filter(|node| !ros2::names::is_hidden(node));
                shown.map(String::as_str).collect()
            }
        };
        // A program may take no notice of its mark; alone it is known all the same.
        if said.is_empty() && unnamed.len() == 1 {
            let others = graph.nodes.keys().filter(|node| *node != NODE);
            said.extend(others.map(String::as_str));
        }
        // What a program registers is untrusted.
        let called = said.into_iter().map(|own| called(own, host));
        let known =
            |called: &Called| is_graph_name(&format!("/{}", called.node.trim_start_matches('/')));
        let mut called: Vec<Called> = called.filter(known).collect();
        // No rule fits one among several whose name is another each time.
        if called.iter().any(|called| called.own.is_some()) {
            called.retain(|called| called.own.is_some());
        }
        if !called.is_empty() {
            names.insert(*index, called);
        }
    }
    names
}

/// A node by the name that its program has given it, which may have parts that are others each time.
fn called(own: &str, host: &str) -> Called {
    let without = without_host(without_random_end(own), host);
    Called {
        own: (without == own).then(|| own.to_owned()),
        node: without,
    }
}

/// The name of an anonymous node without what makes it unique: `_PID_MILLISECONDS` (rospy), `_NANOSECONDS` (roscpp).
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

/// The name of a node that has the machine's in it (`cpu_monitor_HOST`) without that: here it is a container's, another one
/// each time. Nothing is left of one that has no other name.
fn without_host(name: &str, host: &str) -> String {
    // A hyphen is not allowed in a node's name.
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
    // A namespace of which nothing is left is none; what an absolute name begins with stays.
    let left = parts
        .iter()
        .enumerate()
        .filter(|(at, part)| *at == 0 || !part.is_empty());
    let left: Vec<&str> = left.map(|(_, part)| part.as_str()).collect();
    left.join("/")
}

/// Writes names into the plan, and moves private parameters there. A node whose name is not known is told the guess.
fn apply(
    plan: &mut Plan,
    flavour: &Flavour,
    unnamed: &[usize],
    found: &Names,
    options: &PushOptions,
) {
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
        free(&mut called, &mut taken);
        if called.is_empty() {
            called.push(Called {
                own: None,
                node: guess.clone(),
            });
            free(&mut called, &mut taken);
        }
        let (name, identity) = (called[0].node.clone(), flavour.renamed(&called));
        for key in options.params.keys().filter(|key| !key.starts_with('/')) {
            let bare = key.trim_start_matches(['~', '_']);
            if let Some(value) = plan.parameters.remove(&format!("{guess}/{bare}")) {
                plan.parameters.insert(format!("{name}/{bare}"), value);
            }
        }
        let node = &mut plan.nodes[*index];
        node.name = name;
        tell_parameters(flavour, node, &plan.parameters);
        flavour.put(identity.arguments, &mut node.argv);
        node.environment.extend(identity.environment);
    }
}

/// Takes the names of a program's nodes, with a number where one is taken: the same one for all of its nodes of one name, for which there is one rule,
/// whatever their namespaces.
fn free(called: &mut [Called], taken: &mut BTreeSet<String>) {
    let wanted: Vec<String> = called.iter().map(|called| called.node.clone()).collect();
    let last = |name: &str| {
        name.rsplit_once('/')
            .map_or(0, |(above, _)| above.len() + 1)
    };
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

/// Tells a node its parameters, where nodes hold their own; not again what it was told before (a node of an exported service).
pub(super) fn tell_parameters(
    flavour: &Flavour,
    node: &mut NodeSpec,
    all: &BTreeMap<String, ParamValue>,
) {
    let arguments = flavour.arguments(&node.name, all);
    let told = |argv: &[String]| {
        argv.windows(arguments.len().max(1))
            .any(|part| part == arguments)
    };
    if !arguments.is_empty() && !told(&node.argv) {
        node.argv.extend(arguments);
    }
}

/// Marks the nodes that were told a name and no namespace (by a launch file, say): their programs may give them one. Marks by name.
pub(super) fn mark(plan: &mut Plan, flavour: &Flavour) -> BTreeMap<String, String> {
    let nodes = plan.nodes.iter_mut().enumerate();
    let free = nodes.filter(|(_, node)| flavour.may_choose_namespace(&node.argv));
    free.map(|(index, node)| {
        let mark = mark_of(index);
        node.argv.extend(flavour.marked(&mark).arguments);
        (node.name.clone(), mark)
    })
    .collect()
}

/// Nodes are where their programs have put them, and their parameters with them.
pub(super) fn place(plan: &mut Plan, moved: &BTreeMap<String, String>) {
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

/// Parameters that were given for a name that no node has, and that none read.
pub(super) fn unused(plan: &Plan, interface: &Interface, options: &PushOptions) -> Vec<String> {
    let below = |key: &str, name: &str| {
        key.strip_prefix(name)
            .is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
    };
    let loaded = plan.components.values().flatten();
    let loaded: Vec<String> = loaded.filter_map(Component::full_name).collect();
    let names = plan.nodes.iter().map(|node| node.name.as_str());
    let names: Vec<&str> = names.chain(loaded.iter().map(String::as_str)).collect();
    let mut warnings = Vec::new();
    for key in options.params.keys() {
        // `/rate` is everybody's.
        let of_a_name = key.starts_with('/') && key[1..].contains('/');
        let known = names.iter().any(|name| below(key, name));
        let read = interface.parameters.iter().any(|parameter| {
            !parameter.read_by.is_empty()
                && (below(key, &parameter.name) || below(&parameter.name, key))
        });
        if of_a_name && !known && !read {
            warnings.push(format!(
                "parameter {key} is given for a name that no node has, and none read it; there are the nodes {}",
                names.join(", ")
            ));
        }
        if let Some(has) = undeclared(interface, key) {
            warnings.push(format!(
                "no node has declared a parameter {key}, so that it is without effect; {has}"
            ));
        }
    }
    warnings
}

/// Where nodes have parameters of their own (ROS 2) and none has one of this name: those that there are, in words.
fn undeclared(interface: &Interface, key: &str) -> Option<String> {
    let own: Vec<_> = interface
        .parameters
        .iter()
        .filter(|parameter| parameter.own_name().is_some())
        .collect();
    // A level of names is a dot there; `/rate` is everybody's.
    let wanted = key.trim_start_matches(['~', '_']);
    let is_it = |parameter: &&&package::interface::Parameter| {
        let name = parameter.own_name().unwrap_or_default();
        let below = |whole: &str| {
            let whole = whole.replace('/', ".");
            name == whole
                || name
                    .strip_prefix(&whole)
                    .is_some_and(|rest| rest.starts_with('.'))
        };
        match wanted.strip_prefix(&parameter.node) {
            Some(rest) if rest.starts_with('/') => below(&rest[1..]),
            _ => below(wanted.trim_start_matches('/')),
        }
    };
    let last = wanted.rsplit('/').next().unwrap_or_default();
    if own.is_empty() || plumbing::parameter(last) || own.iter().any(|it| is_it(&it)) {
        return None;
    }
    let mut names: Vec<&str> = own.iter().map(|it| it.name.as_str()).collect();
    names.truncate(NAMED);
    Some(format!("there are {}", names.join(", ")))
}

#[cfg(test)]
mod tests;
