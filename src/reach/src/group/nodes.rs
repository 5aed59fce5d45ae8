//! Nodes that a robot's stubs stand for where robots share them. None is started: the group's servants run them, and answer under
//! the names that the robot has for them. A stub's end takes those names back, and cancels what its robot had asked of them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Weak};

use async_trait::async_trait;
use link::control::{Decision, Exit, Hello, Node, Request};
use parking_lot::Mutex;
use ros::bus::{ParamValue, RosVersion};
use ros::ros1::names;
use ros::ros2::arguments::{self, Kind};
use servant::spec::NodeSpec;
use tokio::sync::{mpsc, watch};

use super::bus::GroupBus;
use super::names::Names;
use super::view::{Alias, View};
use crate::links::{Nodes, RequestNews};
use crate::nodes::{Told, program, running};
use crate::{Observer, Recorded, Tenant};

/// Signals that end a node: SIGHUP, SIGINT, SIGQUIT, SIGKILL and SIGTERM.
const ENDS: [i32; 5] = [1, 2, 3, 9, 15];
/// Settings of stubs stand below this private name, and are no node's.
const OF_STUBS: &str = "cloudroid";

/// The nodes of one robot.
pub(super) struct SharedNodes {
    bus: Arc<GroupBus>,
    recorded: Recorded,
    told: Told,
    linked: Mutex<BTreeMap<String, Linked>>,
}

/// A stub's node.
struct Linked {
    view: View,
    exit: watch::Sender<Option<Exit>>,
}

impl SharedNodes {
    /// None yet; `bus` shows those that stubs begin, `place` is the id of the robot's place.
    pub(super) fn new(
        bus: Arc<GroupBus>,
        recorded: Recorded,
        place: &str,
        observer: Arc<dyn Observer>,
    ) -> SharedNodes {
        SharedNodes {
            bus,
            recorded,
            told: Told::new(place, observer),
            linked: Mutex::default(),
        }
    }

    /// Shows what the stubs' nodes serve now.
    fn show(&self, linked: &BTreeMap<String, Linked>) {
        let mut all = View::default();
        linked.values().for_each(|node| all.add(node.view.clone()));
        self.bus.show(all);
    }

    fn view(&self, node: &Node) -> Result<View, String> {
        let planned = planned(&self.recorded, node)?;
        let ros = self.bus.ros();
        let alias = Alias {
            node: &planned.name,
            only: self.recorded.nodes.len() == 1,
            deployed: Names::new(ros, &planned.name, &planned.argv),
            name: &node.name,
            robot: Names::new(ros, &node.name, &node.argv),
        };
        Ok(View::of_node(ros, self.bus.interface(), &alias))
    }
}

/// The group's node that a stub's node stands for.
fn planned<'a>(recorded: &'a Recorded, node: &Node) -> Result<&'a NodeSpec, String> {
    program(recorded, node)?;
    let all: Vec<&NodeSpec> = running(recorded, &node.executable).collect();
    let last = |name: &str| name.rsplit('/').next().unwrap_or_default().to_owned();
    let same = all
        .iter()
        .find(|planned| planned.name == node.name)
        .or_else(|| {
            let mut named = all.iter();
            named.find(|planned| last(&planned.name) == last(&node.name))
        });
    match (same, &all[..]) {
        (Some(planned), _) | (None, [planned]) => Ok(planned),
        (None, []) => Err(format!(
            "robots share service {}, whose servants do not run {}: a stub uses what runs there; push the service with that node",
            recorded.service, node.executable
        )),
        (None, several) => {
            let names: Vec<&str> = several.iter().map(|planned| &*planned.name).collect();
            Err(format!(
                "robots share service {}, whose servants run {} as {}: which of them {} stands for is told by its name; give it one of these",
                recorded.service,
                node.executable,
                names.join(" and "),
                node.name
            ))
        }
    }
}

/// What a robot gives a node that it does not heed: private parameters, and arguments that are neither these nor remaps. `value` is
/// what a parameter of the group's node is known to be.
fn unheeded<'a>(
    recorded: &'a Recorded,
    hello: &Hello,
    value: impl Fn(&str) -> Option<&'a serde_json::Value>,
) -> BTreeSet<String> {
    let Ok(planned) = planned(recorded, &hello.node) else {
        return BTreeSet::new();
    };
    match recorded.flavour.ros.bus() {
        RosVersion::One => unheeded_one(recorded, planned, hello),
        RosVersion::Two => unheeded_two(planned, &hello.node.argv, |name| {
            value(&format!("{}/{name}", planned.name))
        }),
    }
}

fn unheeded_one(recorded: &Recorded, planned: &NodeSpec, hello: &Hello) -> BTreeSet<String> {
    let deployed = |name: &str| recorded.parameters.get(&format!("{}/{name}", planned.name));
    let mut given = BTreeSet::new();
    if let Some(own) = below(&hello.parameters, &hello.node.name) {
        let own = own
            .iter()
            .filter(|(name, value)| *name != OF_STUBS && deployed(name) != Some(*value));
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

/// Parameters are arguments there, those of files, too.
fn unheeded_two<'a>(
    planned: &NodeSpec,
    argv: &[String],
    value: impl Fn(&str) -> Option<&'a serde_json::Value>,
) -> BTreeSet<String> {
    // The stub has read it, and so has the node.
    let parts = |argv: &[String]| arguments::parse(argv).unwrap_or_default();
    let deployed = parts(&planned.argv);
    let known = |name: &str, given: &str| {
        let same = deployed.iter().rev().find_map(|part| match &part.kind {
            Kind::Parameter(of) if of.name == name => Some(of.value == given),
            _ => None,
        });
        // What is written so is JSON, too.
        let is_it = || {
            let given: Option<serde_json::Value> = serde_json::from_str(given).ok();
            given.is_some() && given.as_ref() == value(name)
        };
        same.unwrap_or_else(is_it)
    };
    let given = parts(argv).into_iter().filter_map(|part| match part.kind {
        Kind::Parameter(of) => {
            (!known(&of.name, &of.value)).then(|| format!("the parameter {}", of.name))
        }
        Kind::Own | Kind::Setting => {
            let words = part.words.join(" ");
            let same = deployed.iter().any(|other| other.words == part.words);
            (!same).then(|| format!("the argument {words:?}"))
        }
        Kind::Mark | Kind::Rule(_) | Kind::File(_) => None,
    });
    given.collect()
}

/// The parameters below a node's name.
fn below<'a>(
    all: &'a BTreeMap<String, ParamValue>,
    node: &str,
) -> Option<&'a BTreeMap<String, ParamValue>> {
    names::parts(node).try_fold(all, |at, part| match at.get(part) {
        Some(ParamValue::Map(below)) => Some(below),
        _ => None,
    })
}

#[async_trait]
impl Nodes for SharedNodes {
    fn service(&self) -> &str {
        &self.recorded.service
    }

    async fn start(&self, node: &Node, _run: &str) -> Result<(), String> {
        let tenant = self.told.tenant()?;
        self.told.observer().fits(node.revision, &node.image)?;
        let view = self.view(node)?;
        tenant.take_over();
        let linked = Linked {
            view,
            exit: watch::Sender::new(None),
        };
        let mut all = self.linked.lock();
        all.insert(node.name.clone(), linked);
        self.show(&all);
        Ok(())
    }

    async fn signal(&self, node: &str, signal: i32) -> Result<(), String> {
        if !ENDS.contains(&signal) {
            return Ok(());
        }
        let mut all = self.linked.lock();
        if let Some(linked) = all.remove(node) {
            self.show(&all);
            linked.exit.send_replace(Some(Exit {
                code: Some(0),
                signal: None,
                text: format!("{node} was told to end"),
            }));
        }
        Ok(())
    }

    async fn ended(&self, node: &str) -> Exit {
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

    /// None is the robot's.
    fn parameters(&self, _node: &Node) -> Vec<(String, ParamValue)> {
        Vec::new()
    }

    fn translate(&self, _node: &Node, text: &str) -> String {
        text.to_owned()
    }

    /// None: what a servant prints is of all robots.
    fn lines(&self, _node: &str) -> mpsc::Receiver<(bool, String)> {
        mpsc::channel(1).1
    }

    fn decided(&self, node: &str, decision: &Decision) {
        self.told.decided(node, decision);
    }

    fn measured(&self, request: &Request, news: RequestNews) {
        self.told.observer().measured(request, news);
    }

    fn warn(&self, kind: &str, text: &str) {
        self.told.warn(kind, text);
    }

    fn unheeded(&self, hello: &Hello) -> Option<String> {
        let value = |name: &str| self.bus.value(name);
        let given = unheeded(&self.recorded, hello, value);
        let given: Vec<String> = given.into_iter().collect();
        (!given.is_empty()).then(|| {
            format!(
                "robots share service {}, whose nodes have their parameters and arguments from its push: what this robot gives {} is not heeded ({}); have it given when the service is pushed (--param), or push it without --shared",
                self.recorded.service,
                hello.node.name,
                given.join(", ")
            )
        })
    }

    fn bind(&self, tenant: Weak<dyn Tenant>) {
        self.told.bind(tenant);
    }
}

#[cfg(test)]
mod tests {
    use package::inventory::Inventory;
    use ros::flavour::Version;

    use super::*;

    fn recorded(nodes: &[(&str, &str)]) -> Recorded {
        let nodes = nodes.iter().map(|(name, program)| {
            serde_json::from_value(serde_json::json!({
                "name": name, "argv": [program, "3", "__name:=x"], "environment": {}, "directory": "/",
                "respawn": false, "respawn_delay": 0.0, "required": false,
            }))
        });
        let nodes: Result<Vec<NodeSpec>, _> = nodes.collect();
        Recorded {
            service: "kitchen".into(),
            package: "kitchen".into(),
            flavour: Default::default(),
            environment: Default::default(),
            nodes: nodes.expect("nodes"),
            parameters: BTreeMap::from([("/cook/salt".to_owned(), ParamValue::Int(3))]),
            components: Default::default(),
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

    fn node(name: &str, executable: &str) -> Node {
        Node {
            name: name.into(),
            package: "kitchen".into(),
            executable: executable.into(),
            ..Node::default()
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
            let recorded = recorded(nodes);
            let found = planned(&recorded, &node(name, executable)).map(|it| it.name.as_str());
            match expected {
                Ok(expected) => assert_eq!(found, Ok(expected), "{name}"),
                Err(words) => assert!(found.is_err_and(|it| it.contains(words)), "{name}"),
            }
        }
    }

    #[test]
    fn what_a_robot_gives_in_vain_is_named() {
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
                node: Node {
                    argv: argv.iter().map(|&argument| argument.to_owned()).collect(),
                    ..node("/r1/chef", "cook")
                },
                parameters: parameters
                    .map(|all| ("r1".to_owned(), all))
                    .into_iter()
                    .collect(),
                ..Hello::default()
            };
            let recorded = recorded(&[COOK]);
            let given = unheeded(&recorded, &hello, |_| None);
            let given: Vec<String> = given.into_iter().collect();
            assert_eq!(given, expected, "{hello:?}");
        }
    }

    #[test]
    fn what_a_robot_of_ros_2_gives_in_vain_is_named() {
        let words =
            |line: &str| -> Vec<String> { line.split_whitespace().map(str::to_owned).collect() };
        let mut recorded = recorded(&[COOK]);
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
            (
                "--ros-args -p use_sim_time:=true",
                &["the parameter use_sim_time"],
            ),
            ("--fast", &["the argument \"--fast\""]),
            (
                "--ros-args --log-level debug",
                &["the argument \"--log-level debug\""],
            ),
        ] {
            let hello = Hello {
                node: Node {
                    argv: words(line),
                    ..node("/r1/chef", "cook")
                },
                ..Hello::default()
            };
            let given: Vec<String> = unheeded(&recorded, &hello, value).into_iter().collect();
            assert_eq!(given, expected, "{line}");
        }
    }
}
