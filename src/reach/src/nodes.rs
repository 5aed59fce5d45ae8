//! Control of a servant's nodes by its robot's stubs: nodes are started and stopped individually, as roslaunch does on
//! the robot.

mod planned;
mod stub_events;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Weak};

use async_trait::async_trait;
use futures_util::FutureExt;
use link::control::{Decision, Exit, NodeLaunch};
use package::interface::Interface;
use parking_lot::Mutex;
use ros::bus::ParamValue;
use ros::flavour::{Naming, NodeIdentity};
use ros::ros2::arguments;
use servant::engine::{LogStart, NodeExit, ServantHandle};
use servant::spec::{NodeSpec, RUN};
use tokio::sync::mpsc;

use crate::links::{MeasuredRequest, NodeController, NodeError};
use crate::{Observer, RecordedRevision, Tenant, describe_exit};

use planned::OwnNodes;

pub(crate) use stub_events::RobotEvents;

/// Number of lines queued for a slow link; the others are lost but are in the servant's log.
const LINES: usize = 256;

/// The nodes of one servant.
pub struct LinkedNodes {
    recorded: RecordedRevision,
    told: RobotEvents,
    container: Arc<dyn ServantHandle>,
    planned: OwnNodes,
    /// Last started nodes by name.
    started: Mutex<BTreeMap<String, NodeLaunch>>,
}

impl LinkedNodes {
    /// Creates the control of a running container's nodes.
    pub(crate) fn new(
        recorded: RecordedRevision,
        container: &Arc<dyn ServantHandle>,
        observer: Arc<dyn Observer>,
    ) -> LinkedNodes {
        LinkedNodes {
            recorded,
            told: RobotEvents::new(container.id(), observer),
            container: Arc::clone(container),
            planned: OwnNodes::default(),
            started: Mutex::default(),
        }
    }

    /// Returns the working directory of the program: as on the robot, or the default of ROS.
    fn working_directory(&self, node: &NodeLaunch, program: &str) -> String {
        let overlay = Path::new(&node.share).parent().and_then(Path::parent);
        let beside = overlay.is_some_and(|overlay| Path::new(&node.directory).starts_with(overlay.join("lib")));
        if beside {
            let parent = Path::new(program).parent().unwrap_or(Path::new("/"));
            return parent.to_string_lossy().into_owned();
        }
        let translated = self.translate(node, &node.directory);
        if translated != node.directory {
            return translated;
        }
        let RecordedRevision { flavour, environment, .. } = &self.recorded;
        flavour.home(environment).to_owned()
    }

    /// Ends the revision's own nodes, which a stub's nodes replace.
    async fn end_own_nodes(&self, tenant: &dyn Tenant) {
        let ending = || planned::end_all(&*self.container, &self.recorded.nodes);
        self.planned.end_once(tenant.take_over(), ending).await;
    }
}

/// Finds the program for a stub's node. Because a robot names it, only programs recorded by the push are run, and no
/// others of the image by any path.
pub(crate) fn find_program<'a>(recorded: &'a RecordedRevision, node: &NodeLaunch) -> Result<&'a String, NodeError> {
    let same = node.package == recorded.package;
    let programs = &recorded.inventory.programs;
    let known = programs.get(&node.executable).filter(|_| same);
    known.ok_or_else(|| NodeError::NotPushed {
        service: recorded.service.clone(),
        executable: node.executable.clone(),
        package: node.package.clone(),
    })
}

/// Returns the command line: the robot's own arguments, then the deployer's, then those that give the node its
/// identity. In ROS 2 (rcl's arguments.c) the later of two values of a parameter counts, `--ros-args` may be repeated
/// within its arguments, and `--` ends them; so the deployer's values override the robot's, whether or not the robot's
/// list was ended.
fn command_line(
    program: &str,
    robots: impl Iterator<Item = String>,
    given: Vec<String>,
    identity: &NodeIdentity,
) -> Vec<String> {
    let program = std::iter::once(program.to_owned()).chain(robots);
    let given = given.into_iter().chain(identity.arguments.iter().cloned());
    program.chain(given).collect()
}

/// Returns the revision's own nodes that run this executable.
pub(crate) fn nodes_running<'a>(
    recorded: &'a RecordedRevision,
    executable: &str,
) -> impl Iterator<Item = &'a NodeSpec> {
    recorded.nodes.iter().filter(move |planned| {
        let mut programs = planned.argv.iter().map(Path::new);
        programs.any(|path| path.file_name().is_some_and(|name| *name == *executable))
    })
}

/// Decides which names are imposed on a program's nodes: none that the robot has not given, except those that the push
/// has given to the node for which the stub is named, for example because the program's own name is different each
/// time. Names that the push gave to other nodes of the same program do not apply.
fn naming_for(recorded: &RecordedRevision, node: &NodeLaunch) -> Naming {
    if !node.named_by_argv {
        return Naming::default();
    }
    let planned: Vec<_> = nodes_running(recorded, &node.executable).collect();
    match arguments::node_for_stub(planned, |planned| &planned.argv) {
        Some(planned) => recorded.flavour.global_naming(&planned.argv),
        None => Naming { name: false, namespace: false },
    }
}

#[async_trait]
impl NodeController for LinkedNodes {
    fn service(&self) -> &str {
        &self.recorded.service
    }

    fn interface(&self) -> Option<&Interface> {
        Some(&self.recorded.interface)
    }

    async fn start(&self, node: &NodeLaunch, run: &str) -> Result<(), NodeError> {
        let tenant = self.told.tenant().ok_or(NodeError::ServantEnded)?;
        self.told.observer().check_stub(node.revision, &node.image).await?;
        let program = find_program(&self.recorded, node)?;
        self.end_own_nodes(&*tenant).await;
        let says = naming_for(&self.recorded, node);
        let identity = self.recorded.flavour.robot_identity(&node.name, says);
        let mut given = self.recorded.parameters.clone();
        given.extend(self.parameters(node));
        let robots = node.argv.iter();
        let robots = robots.map(|argument| self.translate(node, argument));
        let flavour = &self.recorded.flavour;
        let argv = command_line(program, robots, flavour.parameter_arguments(&node.name, &given), &identity);
        let directory = self.working_directory(node, program);
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
        started.map_err(|source| NodeError::Start { node: node.name.clone(), source })?;
        self.started.lock().insert(node.name.clone(), node.clone());
        Ok(())
    }

    fn last_run(&self, node: &str) -> Option<String> {
        self.container.run_id(node)
    }

    async fn running_nodes(&self) -> Vec<NodeLaunch> {
        let started: Vec<NodeLaunch> = self.started.lock().values().cloned().collect();
        let mut running = Vec::new();
        for node in started {
            if self.is_running(&node.name).await {
                running.push(node);
            }
        }
        running
    }

    async fn signal(&self, node: &str, signal: i32) -> Result<(), NodeError> {
        let sent = self.container.signal_node(node, signal).await;
        sent.map_err(NodeError::Signal)
    }

    async fn wait_exit(&self, node: &str) -> Exit {
        match self.container.wait_node(node).await {
            Ok(exit) => {
                let how = describe_exit(&exit, &self.container.enforced_limits().limits);
                Exit { code: exit.code, signal: exit.signal, text: format!("{node} {how}") }
            }
            Err(error) => Exit { text: error.to_string(), ..Exit::default() },
        }
    }

    async fn is_running(&self, node: &str) -> bool {
        let ended: Option<Result<NodeExit, _>> = self.container.wait_node(node).now_or_never();
        ended.is_none()
    }

    fn parameters(&self, node: &NodeLaunch) -> Vec<(String, ParamValue)> {
        let plan = &self.recorded;
        let Some(planned) = nodes_running(plan, &node.executable).next() else {
            return Vec::new();
        };
        let private = format!("{}/", planned.name);
        let given = plan.parameters.iter().filter_map(|(key, value)| {
            let below = key.strip_prefix(&private)?;
            Some((format!("{}/{below}", node.name), value.clone()))
        });
        given.collect()
    }

    fn translate(&self, node: &NodeLaunch, text: &str) -> String {
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

    fn on_decision(&self, node: &str, decision: &Decision) {
        self.told.record_decision(node, decision);
    }

    fn on_request_measured(&self, request: &MeasuredRequest<'_>) {
        self.told.record_request(request);
    }

    fn warn(&self, kind: &str, text: &str) {
        self.told.warn(kind, text);
    }

    fn bind_tenant(&self, tenant: Weak<dyn Tenant>) {
        self.told.bind_tenant(tenant);
    }

    fn output_lines(&self, node: &str) -> mpsc::Receiver<(bool, String)> {
        let mut all = self.container.follow(LogStart::Now);
        let (sender, lines) = mpsc::channel(LINES);
        let node = node.to_owned();
        tokio::spawn(async move {
            loop {
                tokio::select! {
                    line = all.recv() => match line {
                        Some(line) if line.node == node => {
                            // The log waits meanwhile; only the link omits lines, and counts them.
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

    fn test_revision() -> RecordedRevision {
        RecordedRevision {
            service: "vision".into(),
            package: "vision".into(),
            flavour: Default::default(),
            environment: Default::default(),
            nodes: Vec::new(),
            parameters: Default::default(),
            components: Default::default(),
            interface: Default::default(),
            inventory: Arc::new(Inventory {
                programs: [("see", "/opt/mine/lib/vision/see"), ("look.py", "/opt/mine/share/vision/scripts/look.py")]
                    .map(|(name, path)| (name.to_owned(), path.to_owned()))
                    .into(),
                ..Inventory::default()
            }),
            registry: Default::default(),
            egress: Vec::new(),
        }
    }

    fn program_of(package: &str, executable: &str) -> Option<String> {
        let node = NodeLaunch {
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
        find_program(&test_revision(), &node).ok().cloned()
    }

    #[test]
    fn a_stub_starts_what_its_push_recorded_and_nothing_else() {
        let path = |text: &str| Some(text.to_owned());
        assert_eq!(program_of("vision", "see"), path("/opt/mine/lib/vision/see"));
        assert_eq!(program_of("vision", "look.py"), path("/opt/mine/share/vision/scripts/look.py"));
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
            assert_eq!(program_of(package, executable), None, "{package} {executable}");
        }
    }

    #[test]
    fn the_deployers_parameters_come_behind_the_robots() {
        let given = BTreeMap::from([("/camera/see/gain".to_owned(), ParamValue::Int(2))]);
        let started = |ros, argv: &[&str]| {
            let flavour = Flavour { ros, ..Flavour::default() };
            let robots = argv.iter().map(|argument| (*argument).to_owned());
            let given = flavour.parameter_arguments("/camera/see", &given);
            let identity = flavour.robot_identity("/camera/see", Naming::default());
            command_line("/opt/see", robots, given, &identity).join(" ")
        };
        let robots = ["plain", "--ros-args", "-p", "gain:=1", "-r", "scan:=/front"];
        assert_eq!(
            started(Version::Ros2, &robots),
            "/opt/see plain --ros-args -p gain:=1 -r scan:=/front --ros-args -p gain:=2 -- --ros-args -r __node:=see \
             -r __ns:=/camera --enclave /cloudroid_link/camera/see"
        );
        // In ROS 1 they are on the parameter server.
        assert_eq!(started(Version::Ros1, &["_gain:=1", "scan:=/front"]), "/opt/see _gain:=1 scan:=/front __name:=see");
    }

    #[test]
    fn nodes_keep_the_names_of_their_program_unless_the_robot_or_the_push_says_others() {
        let mut recorded = test_revision();
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
            let node = NodeLaunch {
                name: "/front/see".into(),
                executable: "see".into(),
                named_by_argv,
                ..NodeLaunch::default()
            };
            let Naming { name, namespace } = naming_for(&recorded, &node);
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
        // Names given to another node of the same program do not apply to this one.
        assert_eq!(said(&[plain, &renamed], true), (false, false));
        assert_eq!(said(&[&moved, &renamed], true), (false, true));
        let other = "/opt/mine/lib/vision/look.py --ros-args -r __node:=look";
        assert_eq!(said(&[plain, other], true), (false, false));
    }
}
