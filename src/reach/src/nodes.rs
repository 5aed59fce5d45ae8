//! What a servant does for its robot's stubs: nodes are started and ended one by one, as roslaunch does on the robot.

mod planned;
mod told;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Weak};

use async_trait::async_trait;
use futures_util::FutureExt;
use link::control::{Decision, Exit, Node, Request};
use parking_lot::Mutex;
use ros::bus::ParamValue;
use ros::flavour::{Identity, Naming};
use ros::ros2::arguments;
use servant::engine::{LogStart, NodeExit, Servant};
use servant::spec::{NodeSpec, RUN};
use tokio::sync::mpsc;

use crate::links::{Nodes, RequestNews};
use crate::{Linked, Observer, Recorded, Tenant, how_it_ended};

use planned::Planned;

pub(crate) use told::Told;

/// Lines that wait for a slow link; more are lost, and stand in the servant's log.
const LINES: usize = 256;

/// The nodes of one servant.
pub struct LinkedNodes {
    recorded: Recorded,
    told: Told,
    container: Arc<dyn Servant>,
    planned: Planned,
    /// As they were started last, by name.
    started: Mutex<BTreeMap<String, Node>>,
}

impl LinkedNodes {
    /// Those of a running container.
    pub(crate) fn new(
        recorded: Recorded,
        container: &Arc<dyn Servant>,
        observer: Arc<dyn Observer>,
    ) -> LinkedNodes {
        LinkedNodes {
            recorded,
            told: Told::new(container.id(), observer),
            container: Arc::clone(container),
            planned: Planned::default(),
            started: Mutex::default(),
        }
    }

    /// Where the program runs: as on the robot, or where ROS's own default leads.
    fn directory(&self, node: &Node, program: &str) -> String {
        let overlay = Path::new(&node.share).parent().and_then(Path::parent);
        let beside = overlay
            .is_some_and(|overlay| Path::new(&node.directory).starts_with(overlay.join("lib")));
        if beside {
            let parent = Path::new(program).parent().unwrap_or(Path::new("/"));
            return parent.to_string_lossy().into_owned();
        }
        let translated = self.translate(node, &node.directory);
        if translated != node.directory {
            return translated;
        }
        let Recorded {
            flavour,
            environment,
            ..
        } = &self.recorded;
        flavour.home(environment).to_owned()
    }

    /// The revision's own nodes end: a stub's take their place.
    async fn end_planned(&self, tenant: &dyn Tenant) {
        let ending = || planned::end_all(&*self.container, &self.recorded.nodes);
        self.planned.end(|| tenant.take_over(), ending).await;
    }
}

/// The program that a stub's node stands for. A robot says which, so nothing but what the push recorded is run: other
/// programs of the image, by whatever path, are not.
pub(crate) fn program<'a>(recorded: &'a Recorded, node: &Node) -> Result<&'a String, String> {
    let same = node.package == recorded.package;
    let programs = &recorded.inventory.programs;
    let known = programs.get(&node.executable).filter(|_| same);
    known.ok_or_else(|| {
        format!(
            "service {} was not pushed with the executable {} of package {}: a stub starts what its push recorded; push it with that node",
            recorded.service, node.executable, node.package
        )
    })
}

/// The robot's own arguments, then what the deployer gave, then what makes it this node. In ROS 2 (rcl's arguments.c) the later one of
/// two values of a parameter counts, `--ros-args` may come again while its arguments go on, and `--` ends them; so the deployer's
/// win over the robot's, whether or not the robot's were ended.
fn command_line(
    program: &str,
    robots: impl Iterator<Item = String>,
    given: Vec<String>,
    identity: &Identity,
) -> Vec<String> {
    let program = std::iter::once(program.to_owned()).chain(robots);
    let given = given.into_iter().chain(identity.arguments.iter().cloned());
    program.chain(given).collect()
}

/// The revision's own nodes that run this executable.
pub(crate) fn running<'a>(
    recorded: &'a Recorded,
    executable: &str,
) -> impl Iterator<Item = &'a NodeSpec> {
    recorded.nodes.iter().filter(move |planned| {
        let mut programs = planned.argv.iter().map(Path::new);
        programs.any(|path| path.file_name().is_some_and(|name| *name == *executable))
    })
}

/// What a program is told of its nodes' names: nothing that the robot has not said, but for what the push has told the node that the stub is called by, so that one
/// whose own name is another each time, say, has one. What it has told others of the same program (`name=` of a second one) is nothing to this one.
fn told(recorded: &Recorded, node: &Node) -> Naming {
    if !node.named_by_argv {
        return Naming::default();
    }
    let planned: Vec<_> = running(recorded, &node.executable).collect();
    match arguments::named_by_program(planned, |planned| &planned.argv) {
        Some(planned) => recorded.flavour.says_to_all(&planned.argv),
        None => Naming {
            name: false,
            namespace: false,
        },
    }
}

#[async_trait]
impl Nodes for LinkedNodes {
    fn service(&self) -> &str {
        &self.recorded.service
    }

    async fn start(&self, node: &Node, run: &str) -> Result<(), String> {
        let tenant = self.told.tenant()?;
        self.told.observer().fits(node.revision, &node.image)?;
        let program = program(&self.recorded, node)?;
        self.end_planned(&*tenant).await;
        let says = told(&self.recorded, node);
        let identity = self.recorded.flavour.of_a_robot(&node.name, says);
        let mut given = self.recorded.parameters.clone();
        given.extend(self.parameters(node));
        let robots = node.argv.iter();
        let robots = robots.map(|argument| self.translate(node, argument));
        let flavour = &self.recorded.flavour;
        let argv = command_line(
            program,
            robots,
            flavour.arguments(&node.name, &given),
            &identity,
        );
        let directory = self.directory(node, program);
        let mut environment = identity.environment;
        if !run.is_empty() {
            environment.insert(RUN.to_owned(), run.to_owned());
        }
        let spec = NodeSpec {
            name: node.name.clone(),
            argv,
            environment,
            directory,
            respawn: false,
            respawn_delay: 0.0,
            required: false,
        };
        let started = self.container.start_node(spec).await;
        started.map_err(|error| format!("{} cannot be started: {error}", node.name))?;
        self.started.lock().insert(node.name.clone(), node.clone());
        Ok(())
    }

    fn run(&self, node: &str) -> Option<String> {
        self.container.run(node)
    }

    async fn running(&self) -> Vec<Linked> {
        let started: Vec<Node> = self.started.lock().values().cloned().collect();
        let mut running = Vec::new();
        for node in started {
            if self.is_running(&node.name).await {
                let given = self.parameters(&node);
                running.push(Linked { node, given });
            }
        }
        running
    }

    async fn signal(&self, node: &str, signal: i32) -> Result<(), String> {
        let sent = self.container.signal_node(node, signal).await;
        sent.map_err(|error| error.to_string())
    }

    async fn ended(&self, node: &str) -> Exit {
        let limits = self
            .told
            .tenant()
            .map(|tenant| tenant.limits())
            .unwrap_or_default();
        match self.container.wait_node(node).await {
            Ok(exit) => Exit {
                code: exit.code,
                signal: exit.signal,
                text: format!("{node} {}", how_it_ended(&exit, &limits)),
            },
            Err(error) => Exit {
                text: error.to_string(),
                ..Exit::default()
            },
        }
    }

    async fn is_running(&self, node: &str) -> bool {
        let ended: Option<Result<NodeExit, _>> = self.container.wait_node(node).now_or_never();
        ended.is_none()
    }

    fn parameters(&self, node: &Node) -> Vec<(String, ParamValue)> {
        let plan = &self.recorded;
        let Some(planned) = running(plan, &node.executable).next() else {
            return Vec::new();
        };
        let private = format!("{}/", planned.name);
        let given = plan.parameters.iter().filter_map(|(key, value)| {
            let below = key.strip_prefix(&private)?;
            Some((format!("{}/{below}", node.name), value.clone()))
        });
        given.collect()
    }

    fn translate(&self, node: &Node, text: &str) -> String {
        if node.share.is_empty() || !text.contains(&node.share) {
            return text.to_owned();
        }
        let own = node.package == self.recorded.package;
        let packages = &self.recorded.inventory.packages;
        match packages.get(&node.package).filter(|_| own) {
            Some(package) => text.replace(&node.share, &package.share),
            None => text.to_owned(),
        }
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

    fn bind(&self, tenant: Weak<dyn Tenant>) {
        self.told.bind(tenant);
    }

    fn lines(&self, node: &str) -> mpsc::Receiver<(bool, String)> {
        let mut all = self.container.follow(LogStart::Now);
        let (sender, lines) = mpsc::channel(LINES);
        let node = node.to_owned();
        tokio::spawn(async move {
            loop {
                tokio::select! {
                    line = all.recv() => match line {
                        Some(line) if line.node == node => {
                            // The log waits meanwhile: the link alone leaves lines out, and counts them.
                            if sender.send((line.stream == "stderr", line.line)).await.is_err() {
                                return;
                            }
                        }
                        Some(_) => {}
                        None => return,
                    },
                    () = sender.closed() => return,
                }
            }
        });
        lines
    }
}

#[cfg(test)]
mod tests {
    use package::inventory::Inventory;
    use ros::flavour::{Flavour, Version};

    use super::*;

    fn recorded() -> Recorded {
        Recorded {
            service: "vision".into(),
            package: "vision".into(),
            flavour: Default::default(),
            environment: Default::default(),
            nodes: Vec::new(),
            parameters: Default::default(),
            components: Default::default(),
            inventory: Arc::new(Inventory {
                programs: [
                    ("see", "/opt/mine/lib/vision/see"),
                    ("look.py", "/opt/mine/share/vision/scripts/look.py"),
                ]
                .map(|(name, path)| (name.to_owned(), path.to_owned()))
                .into(),
                ..Inventory::default()
            }),
            registry: Default::default(),
            egress: Vec::new(),
        }
    }

    fn asks(package: &str, executable: &str) -> Option<String> {
        let node = Node {
            name: "/see".into(),
            package: package.into(),
            executable: executable.into(),
            argv: Vec::new(),
            namespace: "/".into(),
            share: String::new(),
            directory: String::new(),
            revision: None,
            image: String::new(),
            named_by_argv: false,
        };
        program(&recorded(), &node).ok().cloned()
    }

    #[test]
    fn a_stub_starts_what_its_push_recorded_and_nothing_else() {
        let path = |text: &str| Some(text.to_owned());
        assert_eq!(asks("vision", "see"), path("/opt/mine/lib/vision/see"));
        assert_eq!(
            asks("vision", "look.py"),
            path("/opt/mine/share/vision/scripts/look.py")
        );
        for (package, executable) in [
            ("vision", "/bin/sh"),
            ("vision", "../../../../bin/sh"),
            ("vision", "./see"),
            ("vision", "nice"),
            ("vision", "other"),
            ("vision", ""),
            ("topic_tools", "relay"),
            ("../lib/vision", "see"),
            ("/bin", "sh"),
        ] {
            assert_eq!(asks(package, executable), None, "{package} {executable}");
        }
    }

    #[test]
    fn the_deployers_parameters_come_behind_the_robots() {
        let given = BTreeMap::from([("/camera/see/gain".to_owned(), ParamValue::Int(2))]);
        let started = |ros, argv: &[&str]| {
            let flavour = Flavour {
                ros,
                ..Flavour::default()
            };
            let robots = argv.iter().map(|argument| (*argument).to_owned());
            let given = flavour.arguments("/camera/see", &given);
            let identity = flavour.of_a_robot("/camera/see", Naming::default());
            command_line("/opt/see", robots, given, &identity).join(" ")
        };
        let robots = ["plain", "--ros-args", "-p", "gain:=1", "-r", "scan:=/front"];
        assert_eq!(
            started(Version::Ros2, &robots),
            "/opt/see plain --ros-args -p gain:=1 -r scan:=/front --ros-args -p gain:=2 -- --ros-args -r __node:=see -r __ns:=/camera --enclave /cloudroid_link/camera/see"
        );
        // Those of ROS 1 are on the parameter server.
        assert_eq!(
            started(Version::Ros1, &["_gain:=1", "scan:=/front"]),
            "/opt/see _gain:=1 scan:=/front __name:=see"
        );
    }

    #[test]
    fn nodes_keep_the_names_of_their_program_unless_the_robot_or_the_push_says_others() {
        let mut recorded = recorded();
        recorded.flavour.ros = Version::Ros2;
        let planned = |argv: &str| NodeSpec {
            name: "/front/see".into(),
            argv: argv.split(' ').map(str::to_owned).collect(),
            environment: BTreeMap::new(),
            directory: String::new(),
            respawn: false,
            respawn_delay: 0.0,
            required: false,
        };
        let mut said = |argv: &[&str], named_by_argv| {
            recorded.nodes = argv.iter().map(|argv| planned(argv)).collect();
            let node = Node {
                name: "/front/see".into(),
                executable: "see".into(),
                named_by_argv,
                ..Node::default()
            };
            let Naming { name, namespace } = told(&recorded, &node);
            (name, namespace)
        };
        let plain = "/opt/mine/lib/vision/see -v";
        assert_eq!(said(&[plain], true), (false, false));
        // As earlier stubs mean it.
        assert_eq!(said(&[plain], false), (true, true));
        let renamed = format!("{plain} --ros-args -r __node:=see");
        assert_eq!(said(&[&renamed], true), (true, false));
        let moved = format!("{plain} --ros-args -r __ns:=/front");
        assert_eq!(said(&[&moved], true), (false, true));
        let second = format!("{plain} --ros-args -r see:__node:=see_2");
        assert_eq!(said(&[plain, &second], true), (false, false));
        // What another of the same program is told it is told alone.
        assert_eq!(said(&[plain, &renamed], true), (false, false));
        assert_eq!(said(&[&moved, &renamed], true), (false, true));
        let other = "/opt/mine/lib/vision/look.py --ros-args -r __node:=look";
        assert_eq!(said(&[plain, other], true), (false, false));
    }
}
