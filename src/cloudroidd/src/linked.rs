//! What a servant does for its robot's stubs: nodes are started and ended one by one, as roslaunch does on the robot.

mod planned;

use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};
use std::sync::{Arc, OnceLock, Weak};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use catalogue::stubs;
use foreign::Tree;
use futures_util::FutureExt;
use link::cloud::Nodes;
use link::control::{Decision, Exit, Node, Request, Sla};
use parking_lot::Mutex;
use ros::bus::ParamValue;
use servant::engine::{NodeExit, Servant};
use servant::spec::NodeSpec;
use tokio::sync::mpsc;

use crate::choreographer::{Handle, Inner, how_it_ended};
use crate::request_times::RequestTimes;
use store::Journal;
use store::{NewEvent, RevisionRecord, State};

use planned::Planned;

/// Lines that wait for a slow link; more are lost, and stand in the servant's log.
const LINES: usize = 256;
/// So many decisions of a robot become events within this time; more are left out, for a robot can tell any number.
const DECISIONS: (u32, Duration) = (60, Duration::from_secs(60));
/// Characters of what a robot says in an event.
const WORDS: usize = 400;

/// Kinds of a robot's decisions that are known.
const KINDS: [&str; 6] = [
    "local-takes-over",
    "local-hands-back",
    "local-answers-too",
    "cloud-answers-alone",
    "local-missing",
    "local-crashed",
];

/// Whether a servant that an earlier daemon started runs for stubs: it never knew the revision's own nodes.
pub fn has_no_planned_node(handle: &Handle, container: &Arc<dyn Servant>) -> bool {
    let mut planned = handle.revision.plan.nodes.iter();
    planned.all(|node| {
        matches!(
            container.wait_node(&node.name).now_or_never(),
            Some(Err(servant::Error::NoNode { .. }))
        )
    })
}

/// The nodes of one servant.
pub struct LinkedNodes {
    revision: RevisionRecord,
    state: Arc<State>,
    journal: Journal,
    request_times: Arc<RequestTimes>,
    /// Decisions since then.
    decisions: Mutex<(Instant, u32)>,
    /// A container is made before anybody asks for it.
    handle: OnceLock<Weak<Handle>>,
    container: Arc<dyn Servant>,
    planned: Planned,
    /// Extracted layers, lowest first.
    layers: Vec<PathBuf>,
}

impl LinkedNodes {
    /// Those of a running container.
    pub async fn new(
        inner: &Inner,
        revision: &RevisionRecord,
        container: &Arc<dyn Servant>,
    ) -> LinkedNodes {
        let layers = inner.catalogue.layers(revision).await;
        LinkedNodes {
            revision: revision.clone(),
            state: Arc::clone(&inner.state),
            journal: inner.journal.clone(),
            request_times: Arc::clone(&inner.request_times),
            decisions: Mutex::new((Instant::now(), 0)),
            handle: OnceLock::new(),
            container: Arc::clone(container),
            planned: Planned::default(),
            layers: layers.unwrap_or_default(),
        }
    }

    /// From now on it is this servant's.
    pub fn bind(&self, handle: &Arc<Handle>) {
        let _ = self.handle.set(Arc::downgrade(handle));
    }

    /// Where the image has a file, as seen from inside.
    fn has(&self, path: &Path) -> bool {
        let below = path.strip_prefix("/").unwrap_or(path);
        let mut layers = self.layers.iter().rev();
        let found = layers.find_map(|layer| Tree::open(layer).ok()?.kind_in_root(below));
        // A character device is a whiteout.
        found.is_some_and(|found| found.is_file() || found.is_dir() || found.is_symlink())
    }

    /// Install spaces, as the image's environment and its nodes name them.
    fn prefixes(&self) -> Vec<PathBuf> {
        let plan = &self.revision.plan;
        let paths = plan
            .environment
            .get("CMAKE_PREFIX_PATH")
            .map_or("", String::as_str);
        let mut prefixes: Vec<PathBuf> = std::env::split_paths(paths).collect();
        let programs = plan.nodes.iter().filter_map(|node| node.argv.first());
        prefixes.extend(
            programs.filter_map(|program| Some(Path::new(program).ancestors().nth(3)?.to_owned())),
        );
        prefixes.push("/usr".into());
        for layer in &self.layers {
            let distributions = catalogue::directories(layer, "opt/ros");
            prefixes.extend(distributions.iter().map(|path| Path::new("/").join(path)));
        }
        let mut seen = BTreeSet::new();
        let below = |prefix: &PathBuf| {
            let mut parts = prefix.components();
            prefix.is_absolute() && parts.all(|part| part != Component::ParentDir)
        };
        prefixes.retain(|prefix| below(prefix) && seen.insert(prefix.clone()));
        prefixes
    }

    fn handle(&self) -> Result<Arc<Handle>, String> {
        self.handle
            .get()
            .and_then(Weak::upgrade)
            .ok_or_else(|| "the servant has ended".to_owned())
    }

    fn share(&self, node: &Node) -> Option<PathBuf> {
        if node.package != self.revision.package {
            return None;
        }
        let shares = self
            .prefixes()
            .into_iter()
            .map(|prefix| prefix.join("share").join(&node.package));
        shares.into_iter().find(|share| self.has(share))
    }

    /// Where the program runs: as on the robot, or where ROS's own default leads.
    fn directory(&self, node: &Node, program: &Path) -> String {
        let overlay = Path::new(&node.share).parent().and_then(Path::parent);
        let beside = overlay
            .is_some_and(|overlay| Path::new(&node.directory).starts_with(overlay.join("lib")));
        if beside {
            let parent = program.parent().unwrap_or(Path::new("/"));
            return parent.to_string_lossy().into_owned();
        }
        let translated = self.translate(node, &node.directory);
        if translated != node.directory {
            return translated;
        }
        let home = self.revision.plan.environment.get("ROS_HOME").cloned();
        home.unwrap_or_default()
    }

    /// The revision's own nodes end: a stub's take their place.
    async fn end_planned(&self, handle: &Handle) {
        let ending = || planned::end_all(&*self.container, &self.revision.plan.nodes);
        self.planned.end(|| handle.set_linked(), ending).await;
    }
}

/// The program that a stub's node stands for. A robot says which, so nothing but what the push recorded is run: other
/// programs of the image, by whatever path, are not.
fn program(revision: &RevisionRecord, node: &Node) -> Option<PathBuf> {
    if node.package != revision.package {
        return None;
    }
    stubs::programs(revision).remove(&node.executable)
}

#[async_trait]
impl Nodes for LinkedNodes {
    async fn start(&self, node: &Node, _sla: &Sla) -> Result<(), String> {
        let handle = self.handle()?;
        let (state, revision, made_of) = (&self.state, &self.revision, node.revision);
        catalogue::fits(state, revision, made_of, &node.image)?;
        let Some(program) = program(&self.revision, node) else {
            return Err(format!(
                "service {} was not pushed with the executable {} of package {}: a stub starts what its push recorded; push it with that node",
                self.revision.service, node.executable, node.package
            ));
        };
        self.end_planned(&handle).await;
        let (namespace, name) = node.name.rsplit_once('/').unwrap_or(("", &node.name));
        let mut argv = vec![program.to_string_lossy().into_owned()];
        argv.extend(
            node.argv
                .iter()
                .map(|argument| self.translate(node, argument)),
        );
        argv.push(format!("__name:={name}"));
        let namespace = if namespace.is_empty() { "/" } else { namespace };
        let directory = self.directory(node, &program);
        let spec = NodeSpec {
            name: node.name.clone(),
            argv,
            environment: [("ROS_NAMESPACE".to_owned(), namespace.to_owned())].into(),
            directory,
            respawn: false,
            respawn_delay: 0.0,
            required: false,
        };
        let started = self.container.start_node(spec).await;
        started.map_err(|error| format!("{} cannot be started: {error}", node.name))
    }

    async fn signal(&self, node: &str, signal: i32) -> Result<(), String> {
        let sent = self.container.signal_node(node, signal).await;
        sent.map_err(|error| error.to_string())
    }

    async fn ended(&self, node: &str) -> Exit {
        let limits = self
            .handle()
            .map(|handle| handle.limits())
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
        let plan = &self.revision.plan;
        let same = |planned: &&NodeSpec| {
            let mut programs = planned.argv.iter().map(Path::new);
            programs.any(|path| {
                path.file_name()
                    .is_some_and(|name| *name == *node.executable)
            })
        };
        let Some(planned) = plan.nodes.iter().find(same) else {
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
        match self.share(node) {
            Some(share) => text.replace(&node.share, &share.to_string_lossy()),
            None => text.to_owned(),
        }
    }

    fn decided(&self, node: &str, decision: &Decision) {
        let Ok(handle) = self.handle() else { return };
        let count = {
            let mut decisions = self.decisions.lock();
            if decisions.0.elapsed() > DECISIONS.1 {
                *decisions = (Instant::now(), 0);
            }
            decisions.1 = decisions.1.saturating_add(1);
            decisions.1
        };
        if count > DECISIONS.0 {
            tracing::debug!(servant = handle.id, ?decision, "one of too many decisions");
            return;
        }
        let known = KINDS.iter().find(|kind| **kind == decision.kind);
        let kind = known.copied().unwrap_or("local-other");
        let text: String = decision.text.chars().take(WORDS).collect();
        let ago = match decision.ago {
            ago if (2.0..1e9).contains(&ago) => format!(", {ago:.0} s ago"),
            _ => String::new(),
        };
        let message = format!("robot {}: {node}: {text}{ago}", handle.robot);
        let about = handle.about();
        if decision.warning {
            self.journal.warning(kind, &message, &about);
        } else {
            self.journal.info(kind, &message, &about);
        }
    }

    fn measured(&self, request: &Request) {
        self.request_times.note(&self.revision.service, request);
    }

    fn warn(&self, kind: &str, text: &str) {
        let handle = self.handle();
        let about = NewEvent {
            service: Some(&self.revision.service),
            servant: Some(self.container.id()),
            robot: handle.as_ref().ok().map(|handle| handle.robot.as_str()),
        };
        self.journal.warning(kind, text, &about);
    }

    fn lines(&self, node: &str) -> mpsc::Receiver<(bool, String)> {
        let mut all = self.container.follow_log(false);
        let (sender, lines) = mpsc::channel(LINES);
        let node = node.to_owned();
        tokio::spawn(async move {
            loop {
                tokio::select! {
                    line = all.recv() => match line {
                        Some(line) if line.node == node => {
                            let _ = sender.try_send((line.stream == "stderr", line.line));
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
    use super::*;
    use store::Plan;

    fn revision() -> RevisionRecord {
        let node = |name: &str, argv: &[&str]| NodeSpec {
            name: name.to_owned(),
            argv: argv.iter().map(|word| (*word).to_owned()).collect(),
            environment: Default::default(),
            directory: String::new(),
            respawn: false,
            respawn_delay: 0.0,
            required: false,
        };
        RevisionRecord {
            service: "vision".into(),
            number: 1,
            image: "sha256:1".into(),
            published: 0,
            package: "vision".into(),
            source: String::new(),
            plan: Plan {
                nodes: vec![
                    node("/see", &["/opt/mine/lib/vision/see", "_rate:=10"]),
                    node(
                        "/look",
                        &["/bin/nice", "/opt/mine/share/vision/scripts/look.py"],
                    ),
                    node("/relay", &["/usr/lib/topic_tools/relay", "/a", "/b"]),
                ],
                ..Plan::default()
            },
            interface: Default::default(),
        }
    }

    fn asks(package: &str, executable: &str) -> Option<PathBuf> {
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
        };
        program(&revision(), &node)
    }

    #[test]
    fn a_stub_starts_what_its_push_recorded_and_nothing_else() {
        let path = |text: &str| Some(PathBuf::from(text));
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
}
