//! Shared nodes for which a robot's stubs stand. None is started: the group's servants run them and answer under the
//! names that the robot has for them. When a stub ends, its names are removed and its pending requests cancelled.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Weak};

use async_trait::async_trait;
use link::control::{Decision, Exit, Hello, NodeLaunch};
use package::interface::Interface;
use parking_lot::Mutex;
use ros::bus::{ParamValue, RosVersion};
use ros::ros1::names;
use ros::ros2::arguments::{self, Kind};
use servant::spec::NodeSpec;
use tokio::sync::{mpsc, watch};

use super::bus::GroupBus;
use super::names::NameResolver;
use super::view::{GroupView, NodeAlias};
use crate::links::{MeasuredRequest, NodeController, NodeError};
use crate::nodes::{RobotEvents, find_program, nodes_running};
use crate::{Observer, RecordedRevision, Tenant};

/// Signals that end a node: SIGHUP, SIGINT, SIGQUIT, SIGKILL and SIGTERM.
const ENDS: [i32; 5] = [1, 2, 3, 9, 15];
/// Private namespace of the stub's own settings, which are not parameters of a node.
const OF_STUBS: &str = "cloudroid";

/// The nodes of one robot.
pub(super) struct SharedNodes {
    bus: Arc<GroupBus>,
    recorded: RecordedRevision,
    told: RobotEvents,
    linked: Mutex<BTreeMap<String, SharedStubNode>>,
}

/// The node of a stub.
struct SharedStubNode {
    view: GroupView,
    exit: watch::Sender<Option<Exit>>,
}

impl SharedNodes {
    /// Creates an empty set; `bus` shows the nodes that stubs start, `place` is the id of the robot's place.
    pub(super) fn new(
        bus: Arc<GroupBus>,
        recorded: RecordedRevision,
        place: &str,
        observer: Arc<dyn Observer>,
    ) -> SharedNodes {
        SharedNodes { bus, recorded, told: RobotEvents::new(place, observer), linked: Mutex::default() }
    }

    /// Updates the bus to show what the stubs' nodes currently provide.
    fn update_view(&self, linked: &BTreeMap<String, SharedStubNode>) {
        let mut all = GroupView::default();
        linked.values().for_each(|node| all.merge(node.view.clone()));
        self.bus.set_view(all);
    }

    fn node_view(&self, node: &NodeLaunch) -> Result<GroupView, NodeError> {
        let planned = find_group_node(&self.recorded, node)?;
        let ros = self.bus.ros();
        let alias = NodeAlias {
            node: &planned.name,
            only: self.recorded.nodes.len() == 1,
            deployed: NameResolver::new(ros, &planned.name, &planned.argv),
            name: &node.name,
            robot: NameResolver::new(ros, &node.name, &node.argv),
        };
        Ok(GroupView::for_node(ros, self.bus.interface(), &alias))
    }
}

/// Finds the group's node that corresponds to a stub's node.
fn find_group_node<'a>(recorded: &'a RecordedRevision, node: &NodeLaunch) -> Result<&'a NodeSpec, NodeError> {
    find_program(recorded, node)?;
    let all: Vec<&NodeSpec> = nodes_running(recorded, &node.executable).collect();
    let last = |name: &str| name.rsplit('/').next().unwrap_or_default().to_owned();
    let same = all.iter().find(|planned| planned.name == node.name).or_else(|| {
        let mut named = all.iter();
        named.find(|planned| last(&planned.name) == last(&node.name))
    });
    match (same, &all[..]) {
        (Some(planned), _) | (None, [planned]) => Ok(planned),
        (None, []) => Err(NodeError::NotRun { service: recorded.service.clone(), executable: node.executable.clone() }),
        (None, several) => Err(NodeError::Ambiguous {
            service: recorded.service.clone(),
            executable: node.executable.clone(),
            candidates: several.iter().map(|planned| planned.name.clone()).collect(),
            node: node.name.clone(),
        }),
    }
}

/// Returns the settings of a robot for its node that are ignored: private parameters, and arguments that are neither
/// parameters nor remappings. `value` returns the known parameter values of the group's node.
fn unused_settings<'a>(
    recorded: &'a RecordedRevision,
    hello: &Hello,
    value: impl Fn(&str) -> Option<&'a serde_json::Value>,
) -> BTreeSet<String> {
    let Ok(planned) = find_group_node(recorded, &hello.node) else {
        return BTreeSet::new();
    };
    match recorded.flavour.ros.ros_version() {
        RosVersion::One => unused_settings_ros1(recorded, planned, hello),
        RosVersion::Two => {
            unused_settings_ros2(planned, &hello.node.argv, |name| value(&format!("{}/{name}", planned.name)))
        }
    }
}

fn unused_settings_ros1(recorded: &RecordedRevision, planned: &NodeSpec, hello: &Hello) -> BTreeSet<String> {
    let deployed = |name: &str| recorded.parameters.get(&format!("{}/{name}", planned.name));
    let mut given = BTreeSet::new();
    if let Some(own) = parameters_below(&hello.parameters, &hello.node.name) {
        let own = own.iter().filter(|(name, value)| *name != OF_STUBS && deployed(name) != Some(*value));
        given.extend(own.map(|(name, _)| format!("~{name}")));
    }
    let other = hello.node.argv.iter();
    for argument in other.filter(|argument| !planned.argv.contains(argument)) {
        match argument.split_once(":=") {
            Some((name, _)) if name.starts_with('_') => {
                given.insert(format!("~{}", &name[1..]));
            }
            Some(_) => {}
            None => {
                given.insert(format!("the argument {argument:?}"));
            }
        }
    }
    given
}

/// In ROS 2, parameters are arguments, including those from files.
fn unused_settings_ros2<'a>(
    planned: &NodeSpec,
    argv: &[String],
    value: impl Fn(&str) -> Option<&'a serde_json::Value>,
) -> BTreeSet<String> {
    // The stub has accepted the arguments, and so has the node.
    let parts = |argv: &[String]| arguments::parse(argv).unwrap_or_default();
    let deployed = parts(&planned.argv);
    let known = |name: &str, given: &str| {
        let same = deployed.iter().rev().find_map(|part| match &part.kind {
            Kind::Parameter(of) if of.name == name => Some(of.value == given),
            _ => None,
        });
        // Such values are also valid JSON.
        let is_it = || {
            let given: Option<serde_json::Value> = serde_json::from_str(given).ok();
            given.is_some() && given.as_ref() == value(name)
        };
        same.unwrap_or_else(is_it)
    };
    let given = parts(argv).into_iter().filter_map(|part| match part.kind {
        Kind::Parameter(of) => (!known(&of.name, &of.value)).then(|| format!("the parameter {}", of.name)),
        Kind::Own | Kind::Setting => {
            let words = part.words.join(" ");
            let same = deployed.iter().any(|other| other.words == part.words);
            (!same).then(|| format!("the argument {words:?}"))
        }
        Kind::Mark | Kind::Rule(_) | Kind::File(_) => None,
    });
    given.collect()
}

/// Returns the parameters below a node's name.
fn parameters_below<'a>(all: &'a BTreeMap<String, ParamValue>, node: &str) -> Option<&'a BTreeMap<String, ParamValue>> {
    names::parts(node).try_fold(all, |at, part| match at.get(part) {
        Some(ParamValue::Map(below)) => Some(below),
        _ => None,
    })
}

#[async_trait]
impl NodeController for SharedNodes {
    fn service(&self) -> &str {
        &self.recorded.service
    }

    fn interface(&self) -> Option<&Interface> {
        Some(&self.recorded.interface)
    }

    async fn start(&self, node: &NodeLaunch, _run: &str) -> Result<(), NodeError> {
        let tenant = self.told.tenant().ok_or(NodeError::ServantEnded)?;
        self.told.observer().check_stub(node.revision, &node.image).await?;
        let view = self.node_view(node)?;
        tenant.take_over().await;
        let linked = SharedStubNode { view, exit: watch::Sender::new(None) };
        let mut all = self.linked.lock();
        all.insert(node.name.clone(), linked);
        self.update_view(&all);
        Ok(())
    }

    async fn signal(&self, node: &str, signal: i32) -> Result<(), NodeError> {
        if !ENDS.contains(&signal) {
            return Ok(());
        }
        let mut all = self.linked.lock();
        if let Some(linked) = all.remove(node) {
            self.update_view(&all);
            linked.exit.send_replace(Some(Exit {
                code: Some(0),
                signal: None,
                text: format!("{node} was asked to shut down"),
            }));
        }
        Ok(())
    }

    async fn wait_exit(&self, node: &str) -> Exit {
        let exit = self.linked.lock().get(node).map(|it| it.exit.subscribe());
        let Some(mut exit) = exit else {
            return Exit::default();
        };
        let exit = exit.wait_for(Option::is_some).await;
        exit.ok().and_then(|exit| exit.clone()).unwrap_or_default()
    }

    async fn is_running(&self, node: &str) -> bool {
        self.linked.lock().contains_key(node)
    }

    /// No node belongs to the robot.
    fn parameters(&self, _node: &NodeLaunch) -> Vec<(String, ParamValue)> {
        Vec::new()
    }

    fn translate(&self, _node: &NodeLaunch, text: &str) -> String {
        text.to_owned()
    }

    /// Empty, because the output of a servant belongs to all robots.
    fn output_lines(&self, _node: &str) -> mpsc::Receiver<(bool, String)> {
        mpsc::channel(1).1
    }

    fn on_decision(&self, node: &str, decision: &Decision) {
        self.told.record_decision(node, decision);
    }

    fn on_request_measured(&self, request: &MeasuredRequest<'_>) {
        self.told.record_request(request);
    }

    fn warn(&self, kind: &str, text: &str) {
        self.told.warn(kind, text);
    }

    fn describe_unused_settings(&self, hello: &Hello) -> Option<String> {
        let value = |name: &str| self.bus.recorded_value(name);
        let given = unused_settings(&self.recorded, hello, value);
        let given: Vec<String> = given.into_iter().collect();
        (!given.is_empty()).then(|| {
            format!(
                "robots share service {}, whose nodes have their parameters and arguments from its push: what this \
                    robot gives {} is ignored ({}); set it when the service is pushed (--param), or push it without \
                    --shared",
                self.recorded.service,
                hello.node.name,
                given.join(", ")
            )
        })
    }

    fn bind_tenant(&self, tenant: Weak<dyn Tenant>) {
        self.told.bind_tenant(tenant);
    }
}

#[cfg(test)]
mod tests {
    use package::inventory::Inventory;
    use ros::flavour::Version;

    use super::*;

    fn test_revision(nodes: &[(&str, &str)]) -> RecordedRevision {
        let nodes = nodes.iter().map(|(name, program)| {
            serde_json::from_value(serde_json::json!({
                "name": name, "argv": [program, "3", "__name:=x"], "environment": {}, "directory": "/",
                "respawn": false, "respawn_delay": 0.0, "required": false,
            }))
        });
        let nodes: Result<Vec<NodeSpec>, _> = nodes.collect();
        RecordedRevision {
            service: "kitchen".into(),
            package: "kitchen".into(),
            flavour: Default::default(),
            environment: Default::default(),
            nodes: nodes.expect("nodes"),
            parameters: BTreeMap::from([("/cook/salt".to_owned(), ParamValue::Int(3))]),
            components: Default::default(),
            interface: Default::default(),
            inventory: Arc::new(Inventory {
                programs: ["cook", "wash"]
                    .map(|name| (name.to_owned(), format!("/opt/mine/lib/kitchen/{name}")))
                    .into(),
                ..Inventory::default()
            }),
            registry: Default::default(),
            egress: Vec::new(),
        }
    }

    fn node(name: &str, executable: &str) -> NodeLaunch {
        NodeLaunch {
            name: name.into(),
            package: "kitchen".into(),
            executable: executable.into(),
            ..NodeLaunch::default()
        }
    }

    const COOK: (&str, &str) = ("/cook", "/opt/mine/lib/kitchen/cook");
    const BAKE: (&str, &str) = ("/bake", "/opt/mine/lib/kitchen/cook");

    #[test]
    fn a_stub_stands_for_the_node_that_runs_its_executable() {
        for (nodes, name, executable, expected) in [
            (&[COOK][..], "/r1/chef", "cook", Ok("/cook")),
            (&[COOK, BAKE], "/bake", "cook", Ok("/bake")),
            (&[COOK, BAKE], "/r1/cook", "cook", Ok("/cook")),
            (&[COOK, BAKE], "/r1/chef", "cook", Err("/cook and /bake")),
            (&[COOK], "/r1/chef", "wash", Err("do not run wash")),
            (&[COOK], "/r1/chef", "/bin/sh", Err("was not pushed with")),
        ] {
            let recorded = test_revision(nodes);
            let node = node(name, executable);
            let found = find_group_node(&recorded, &node).map(|it| it.name.as_str());
            match (found, expected) {
                (Ok(found), Ok(expected)) => assert_eq!(found, expected, "{name}"),
                (Err(error), Err(words)) => {
                    let error = error.to_string();
                    assert!(error.contains(words), "{name}: {error}");
                }
                (found, _) => panic!("{name}: {found:?}"),
            }
        }
    }

    #[test]
    fn unused_settings_of_a_robot_are_named() {
        let salt = |amount| ParamValue::Map([("salt".to_owned(), ParamValue::Int(amount))].into());
        let settings = ParamValue::Map([("cloudroid".to_owned(), ParamValue::Int(1))].into());
        let of = |value| ParamValue::Map([("chef".to_owned(), value)].into());
        for (parameters, argv, expected) in [
            (None, &[][..], &[][..]),
            (Some(of(salt(3))), &["3", "x:=y"], &[]),
            (Some(of(settings)), &[], &[]),
            (Some(of(salt(4))), &[], &["~salt"]),
            (None, &["_salt:=4"], &["~salt"]),
            (None, &["5"], &["the argument \"5\""]),
        ] {
            let hello = Hello {
                node: NodeLaunch {
                    argv: argv.iter().map(|&argument| argument.to_owned()).collect(),
                    ..node("/r1/chef", "cook")
                },
                parameters: parameters.map(|all| ("r1".to_owned(), all)).into_iter().collect(),
                ..Hello::default()
            };
            let recorded = test_revision(&[COOK]);
            let given = unused_settings(&recorded, &hello, |_| None);
            let given: Vec<String> = given.into_iter().collect();
            assert_eq!(given, expected, "{hello:?}");
        }
    }

    #[test]
    fn unused_settings_of_a_ros_2_robot_are_named() {
        let words = |line: &str| -> Vec<String> { line.split_whitespace().map(str::to_owned).collect() };
        let mut recorded = test_revision(&[COOK]);
        recorded.flavour.ros = Version::Ros2;
        let deployed = "--ros-args -r __node:=cook -p salt:=3 -p oil:=1 -p oil:=2 --";
        recorded.nodes[0].argv = words(&format!("{} --slow {deployed}", COOK.1));
        let value = serde_json::json!("hot");
        let value = |name: &str| (name == "/cook/pan").then_some(&value);
        for (line, expected) in [
            ("--ros-args -r work:=plan -r __node:=chef", &[][..]),
            ("--slow --ros-args -p salt:=3 -p oil:=2 --", &[]),
            ("--ros-args -p pan:=\"hot\"", &[]),
            ("--ros-args -p pan:=\"cold\"", &["the parameter pan"]),
            ("--ros-args -p oil:=1", &["the parameter oil"]),
            ("--ros-args -p use_sim_time:=true", &["the parameter use_sim_time"]),
            ("--fast", &["the argument \"--fast\""]),
            ("--ros-args --log-level debug", &["the argument \"--log-level debug\""]),
        ] {
            let hello =
                Hello { node: NodeLaunch { argv: words(line), ..node("/r1/chef", "cook") }, ..Hello::default() };
            let given: Vec<String> = unused_settings(&recorded, &hello, value).into_iter().collect();
            assert_eq!(given, expected, "{line}");
        }
    }
}
