//! What nodes are called that were told no name (`--node`): what their programs say, as under rosrun.
//!
//! The name is known only when a program runs, and parameters must be there before it does. So it is started once, each
//! node in a namespace of its own to tell it by, and ended as soon as it has registered. From then on it is told that
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
use ros::flavour::Flavour;
use ros::plumbing;
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

/// Where the node of an index is while its name is looked for.
fn namespace(index: usize) -> String {
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
            let put = built.flavour.namespace(&namespace(*index));
            built.flavour.put(put.arguments, &mut node.argv);
            node.environment.extend(put.environment);
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

/// Names of a program's nodes, the first by name first.
type Names = BTreeMap<usize, Vec<String>>;

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
    let all_there = |graph: &Arc<Graph>| names(graph, unnamed, host).len() == unnamed.len();
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
    let found = names(&seen.borrow(), unnamed, host);
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

/// Which nodes of the graph are whose: their names without namespace, or an absolute one where its program has chosen the namespace itself. `host`: the
/// name of the machine that they think they run on.
fn names(graph: &Graph, unnamed: &[usize], host: &str) -> Names {
    let mut names = Names::new();
    for index in unnamed {
        let below = format!("{}/", namespace(*index));
        let own = graph.nodes.keys();
        let mut said: Vec<&str> = own
            .filter_map(|node| node.strip_prefix(below.as_str()))
            .collect();
        // A program may choose its namespace itself; alone it is known all the same.
        if said.is_empty() && unnamed.len() == 1 {
            let only = graph.nodes.keys().find(|node| *node != NODE);
            said.extend(only.map(String::as_str));
        }
        // What a program registers is untrusted.
        let said = said
            .into_iter()
            .map(|name| without_host(without_random_end(name), host))
            .filter(|name| is_graph_name(&format!("/{}", name.trim_start_matches('/'))));
        let said: Vec<String> = said.collect();
        if !said.is_empty() {
            names.insert(*index, said);
        }
    }
    names
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
    match name.split_once(host.as_str()) {
        Some((before, after)) if !host.is_empty() => {
            let parts = [before.trim_end_matches('_'), after.trim_start_matches('_')];
            let parts: Vec<&str> = parts.into_iter().filter(|part| !part.is_empty()).collect();
            parts.join("_")
        }
        _ => name.to_owned(),
    }
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
        let mut called = Vec::new();
        for known in found.get(index).into_iter().flatten() {
            let wanted = match known.starts_with('/') {
                true => known.clone(),
                false => format!("{above}/{known}"),
            };
            let own = known.rsplit('/').next().unwrap_or(known);
            called.push((own.to_owned(), free(wanted, &mut taken)));
        }
        let (name, identity) = match called.first() {
            Some((_, first)) => (first.clone(), flavour.renamed(&called)),
            None => {
                let name = free(guess.clone(), &mut taken);
                let identity = flavour.identity(&name);
                (name, identity)
            }
        };
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

/// Takes a name, with a number where it is taken.
fn free(wanted: String, taken: &mut BTreeSet<String>) -> String {
    let mut name = wanted.clone();
    let mut number = 1;
    while !taken.insert(name.clone()) {
        number += 1;
        name = format!("{wanted}_{number}");
    }
    name
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
mod tests {
    use super::*;
    use package::interface::Parameter;

    fn plan(names: &[&str]) -> Plan {
        let node = |name: &&str| NodeSpec {
            name: (*name).to_owned(),
            argv: vec!["/x".to_owned()],
            environment: Default::default(),
            directory: "/root".to_owned(),
            respawn: false,
            respawn_delay: 0.0,
            required: false,
        };
        Plan {
            nodes: names.iter().map(node).collect(),
            ..Plan::default()
        }
    }

    fn given(params: &[&str]) -> PushOptions {
        PushOptions {
            params: params
                .iter()
                .map(|key| ((*key).to_owned(), serde_json::json!(1)))
                .collect(),
            ..PushOptions::default()
        }
    }

    fn found(said: &[(usize, &[&str])]) -> Names {
        let said = said.iter().map(|(index, names)| {
            let names = names.iter().map(|&name| name.to_owned());
            (*index, names.collect())
        });
        said.collect()
    }

    #[test]
    fn a_node_has_the_name_and_the_parameters_that_its_program_gives_it() {
        let mut plan = plan(&["/costmap_2d_node", "/other", "/third"]);
        let options = given(&["~rate", "/costmap_2d_node/stays"]);
        for key in ["/costmap_2d_node/rate", "/costmap_2d_node/stays"] {
            plan.parameters.insert(key.to_owned(), ParamValue::Int(1));
        }
        let found = found(&[(0, &["costmap_2d"]), (2, &["other"])]);
        apply(&mut plan, &Flavour::default(), &[0, 2], &found, &options);
        let names: Vec<&str> = plan.nodes.iter().map(|node| node.name.as_str()).collect();
        assert_eq!(names, ["/costmap_2d", "/other", "/other_2"]);
        assert_eq!(plan.nodes[0].argv, ["/x", "__name:=costmap_2d"]);
        let keys: Vec<&String> = plan.parameters.keys().collect();
        assert_eq!(keys, ["/costmap_2d/rate", "/costmap_2d_node/stays"]);
        let words = unused(&plan, &Interface::default(), &options).join("\n");
        assert!(
            words.starts_with("parameter /costmap_2d_node/stays") && words.contains("/costmap_2d,"),
            "{words}"
        );
        // Somebody may read it all the same.
        let interface = Interface {
            parameters: vec![Parameter {
                name: "/costmap_2d_node/stays".to_owned(),
                read_by: vec!["/other".to_owned()],
                ..Parameter::default()
            }],
            ..Interface::default()
        };
        assert!(unused(&plan, &interface, &options).is_empty());
    }

    #[test]
    fn nodes_of_ros_2_keep_their_namespaces_and_are_renamed_alone() {
        let flavour = Flavour {
            ros: ros::flavour::Version::Ros2,
            ..Flavour::default()
        };
        let mut plan = plan(&["/front/talk", "/back/talk", "/two", "/own"]);
        for (node, namespace) in plan.nodes.iter_mut().zip(["/front", "/back"]) {
            let words = ["--ros-args", "-r", &*format!("__ns:={namespace}")];
            node.argv.extend(words.map(str::to_owned));
        }
        let said = found(&[
            (0, &["talker"]),
            (1, &["talker"]),
            (2, &["own"]),
            (3, &["/chosen/own"]),
        ]);
        let given = PushOptions::default();
        apply(&mut plan, &flavour, &[0, 1, 2, 3], &said, &given);
        let told = |index: usize| {
            let node: &NodeSpec = &plan.nodes[index];
            (node.name.as_str(), node.argv.join(" "))
        };
        let kept = |namespace: &str| format!("/x --ros-args -r __ns:={namespace}");
        assert_eq!(told(0), ("/front/talker", kept("/front")));
        assert_eq!(told(1), ("/back/talker", kept("/back")));
        assert_eq!(told(2), ("/own", "/x".to_owned()));
        assert_eq!(told(3), ("/chosen/own", "/x".to_owned()));
    }

    #[test]
    fn each_node_of_a_second_program_of_several_nodes_has_a_name_of_its_own() {
        let flavour = Flavour {
            ros: ros::flavour::Version::Ros2,
            ..Flavour::default()
        };
        let mut twice = plan(&["/duet", "/duet_2", "/soloist"]);
        let key = |name: &str| format!("{name}/rate");
        for name in ["/duet", "/duet_2", "/soloist"] {
            twice.parameters.insert(key(name), ParamValue::Int(1));
        }
        let said = found(&[
            (0, &["alto", "tenor"]),
            (1, &["alto", "tenor"]),
            (2, &["solo", "tenor"]),
        ]);
        apply(&mut twice, &flavour, &[0, 1, 2], &said, &given(&["rate"]));
        let rate = ["--ros-args", "-p", "rate:=1", "--"];
        let told = |index: usize| {
            let argv = &twice.nodes[index].argv;
            let rules = argv.len() - rate.len();
            assert_eq!(argv[rules..], rate);
            (&*twice.nodes[index].name, argv[..rules].join(" "))
        };
        assert_eq!(told(0), ("/alto", "/x".to_owned()));
        let rules = "/x --ros-args -r alto:__node:=alto_2 -r tenor:__node:=tenor_2";
        assert_eq!(told(1), ("/alto_2", rules.to_owned()));
        let rules = "/x --ros-args -r tenor:__node:=tenor_3";
        assert_eq!(told(2), ("/solo", rules.to_owned()));
        let keys: Vec<&String> = twice.parameters.keys().collect();
        assert_eq!(keys, ["/alto/rate", "/alto_2/rate", "/solo/rate"]);
    }

    #[test]
    fn parameters_that_no_node_of_ros_2_has_declared_are_told() {
        let own = |name: &str| Parameter {
            name: format!("/see/{name}"),
            node: "/see".to_owned(),
            ..Parameter::default()
        };
        let interface = Interface {
            parameters: vec![own("rate"), own("camera.width")],
            ..Interface::default()
        };
        for known in [
            "rate",
            "~rate",
            "/rate",
            "/see/rate",
            "/see/camera/width",
            "camera/width",
            "camera",
            "use_sim_time",
        ] {
            assert_eq!(undeclared(&interface, known), None, "{known}");
        }
        for unknown in ["rat", "/see/rat", "/other/rate/x", "width"] {
            let words = undeclared(&interface, unknown).expect(unknown);
            assert_eq!(words, "there are /see/rate, /see/camera.width");
        }
        // Nodes of ROS 1 declare nothing.
        assert_eq!(undeclared(&Interface::default(), "rat"), None);
    }

    #[test]
    fn nodes_are_told_apart_by_their_namespaces() {
        let graph = Graph {
            nodes: [
                "/cloudroid_name_0/costmap_2d",
                "/cloudroid_name_0/below/planner",
                "/cloudroid_name_3/talker_71_1700000000123",
                "/cloudroid_name_4/x'$(cmd)'",
                "/cloudroid_name_5/cpu_monitor_push_1_names",
                NODE,
            ]
            .map(|name| (name.to_owned(), String::new()))
            .into(),
            ..Graph::default()
        };
        assert_eq!(
            names(&graph, &[0, 3, 4, 5], "push-1-names"),
            found(&[
                (0, &["below/planner", "costmap_2d"]),
                (3, &["talker"]),
                (5, &["cpu_monitor"]),
            ])
        );
    }

    #[test]
    fn the_machine_is_no_part_of_a_name() {
        for (name, plain) in [
            ("cpu_monitor_push_1_names", "cpu_monitor"),
            ("push_1_names_ntp", "ntp"),
            ("a_push_1_names_b", "a_b"),
            ("push_1_names", ""),
            ("push_1", "push_1"),
        ] {
            assert_eq!(without_host(name, "push-1-names"), plain);
        }
    }

    #[test]
    fn random_ends_are_cut_off() {
        for (name, plain) in [
            ("talker_4711_1700000000123", "talker"),
            ("people_detect_1700000000123456789", "people_detect"),
            ("node_1_1700000000123456789", "node_1"),
            ("costmap_2d", "costmap_2d"),
            ("camera_2", "camera_2"),
        ] {
            assert_eq!(without_random_end(name), plain);
        }
    }
}
