//! A robot's side of a link: a ROS system, the robot's own nodes, and stubs in place of nodes that run in the cloud.

use std::collections::BTreeSet;
use std::fs::File;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use bytes::Bytes;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use ros::bus::{Bus, Graph, Publisher, QosProfile, RosVersion, SerializedMessage, Subscription, WireFormat, WireType};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::schema::MessageType;
use tokio::runtime::Runtime;

use crate::binaries;
use crate::cable::run_in_namespace;
use crate::daemon::Daemon;
use crate::deployer::path_str;
use crate::patience::{self, Deadline, patience};
use crate::ros_system::{Domain, HasBus, RosSystem};
use crate::world::Directory;

/// Time within which an expected message nearly always arrives.
const MOMENT: Duration = Duration::from_millis(200);

/// A robot.
pub struct Site {
    /// Runtime of its nodes in this process.
    pub runtime: Runtime,
    /// ROS system of the robot.
    pub system: RosSystem,
    /// Network namespace of its processes, if not this machine's own.
    namespace: Option<PathBuf>,
    place: Directory,
}

/// A node that runs as a process: a stub, or an original.
pub struct NodeProcess {
    child: Child,
    log: PathBuf,
}

impl Site {
    /// Creates a robot of ROS 1 with nothing but a Master.
    pub fn new() -> anyhow::Result<Self> {
        Self::with_ros(RosVersion::One)
    }

    /// Creates a robot of this version of ROS, without nodes.
    pub fn with_ros(version: RosVersion) -> anyhow::Result<Self> {
        Self::build(None, |runtime| RosSystem::new(version, runtime))
    }

    /// Creates a robot of ROS 2 whose processes run in a network namespace; nodes of this process cannot join them.
    pub fn in_namespace(namespace: PathBuf, domain: Domain) -> anyhow::Result<Self> {
        Self::build(Some(namespace), |_| Ok(RosSystem::Domain(domain)))
    }

    fn build(
        namespace: Option<PathBuf>,
        system: impl FnOnce(&Runtime) -> anyhow::Result<RosSystem>,
    ) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let place = Directory::new("site")?;
        Ok(Self { system: system(&runtime)?, runtime, namespace, place })
    }

    /// Returns the address of its Master.
    pub fn master(&self) -> anyhow::Result<SocketAddr> {
        self.system.master().context("a robot of ROS 1")
    }

    /// Starts a Master, at the address of the previous one if there was one.
    pub fn start_master(&mut self) -> anyhow::Result<()> {
        self.system.start_master(&self.runtime)
    }

    /// Stops the Master, which loses all registrations.
    pub fn end_master(&mut self) {
        self.system.end_master(&self.runtime);
    }

    /// Creates a node in this process, on a robot of ROS 1.
    pub fn node(&self, name: &str) -> anyhow::Result<Arc<Ros1Bus>> {
        let joined = Ros1Bus::connect(Arc::new(HostSockets), self.master()?, name);
        Ok(self.runtime.block_on(joined)?)
    }

    /// Creates a node in this process, on a robot of either version of ROS.
    pub fn join(&self, name: &str) -> anyhow::Result<Arc<dyn Bus>> {
        self.runtime.block_on(self.system.join(name))
    }

    /// Waits until the graph satisfies `wanted`.
    pub fn wait_for_graph(
        &self,
        node: &(impl HasBus + ?Sized),
        what: &str,
        wanted: impl Fn(&Graph) -> bool,
    ) -> anyhow::Result<Graph> {
        let mut graphs = node.bus().graph();
        let found = self.runtime.block_on(async {
            let found = patience::wait_for(graphs.wait_for(|graph| wanted(graph)));
            found.await.map(|found| found.map(|graph| (**graph).clone()))
        });
        match found {
            Ok(graph) => Ok(graph?),
            Err(error) => bail!("{what}: {error}: {:#?}", node.bus().graph().borrow()),
        }
    }

    /// Advertises a topic of strings.
    pub fn advertise_strings(
        &self,
        node: &(impl HasBus + ?Sized),
        topic: &str,
        latch: bool,
    ) -> anyhow::Result<Box<dyn Publisher>> {
        let of = string_type(self.system.version())?;
        let qos = QosProfile::keep_last(100).latching(latch);
        Ok(self.runtime.block_on(node.bus().advertise(topic, of, qos))?)
    }

    /// Subscribes to a topic of any type.
    pub fn subscribe(&self, node: &(impl HasBus + ?Sized), topic: &str) -> anyhow::Result<Subscription> {
        let subscribed = node.bus().subscribe(topic, WireType::any(), QosProfile::keep_last(100));
        Ok(self.runtime.block_on(subscribed)?)
    }

    /// Subscribes to a topic including latched messages, which a late subscriber of ROS 2 has to request.
    pub fn subscribe_latched(&self, node: &(impl HasBus + ?Sized), topic: &str) -> anyhow::Result<Subscription> {
        let qos = QosProfile::keep_last(100).latching(true);
        let subscribed = node.bus().subscribe(topic, WireType::any(), qos);
        Ok(self.runtime.block_on(subscribed)?)
    }

    /// Returns the next message.
    pub fn next_message(&self, subscription: &mut Subscription) -> anyhow::Result<SerializedMessage> {
        let next = self.runtime.block_on(patience::wait_for(subscription.messages.recv()));
        next.context("a message should come")?.context("the topic ended")
    }

    /// Returns the next message, if one arrives in time.
    pub fn next_message_within(
        &self,
        subscription: &mut Subscription,
        time: Duration,
    ) -> anyhow::Result<Option<SerializedMessage>> {
        let next = async { tokio::time::timeout(time, subscription.messages.recv()).await };
        match self.runtime.block_on(next) {
            Ok(next) => Ok(Some(next.context("the topic ended")?)),
            Err(_) => Ok(None),
        }
    }

    /// Repeats a request until a wanted message arrives: as in every ROS, messages are lost until both sides are
    /// connected. Further answers may arrive later.
    pub fn ask_until(
        &self,
        subscription: &mut Subscription,
        mut ask: impl FnMut() -> anyhow::Result<()>,
        mut wanted: impl FnMut(&SerializedMessage) -> anyhow::Result<bool>,
    ) -> anyhow::Result<SerializedMessage> {
        let deadline = Deadline::begin();
        loop {
            ask()?;
            while let Some(message) = self.next_message_within(subscription, patience::scale(MOMENT))? {
                if wanted(&message)? {
                    return Ok(message);
                }
                deadline.check(|| format!("{message:?} came last, and is not what should"))?;
            }
            deadline.check(|| "nothing came that was asked for".to_owned())?;
        }
    }

    /// Waits until `count` subscribers are connected.
    pub fn wait_for_subscribers(&self, publisher: &dyn Publisher, count: usize) -> anyhow::Result<()> {
        let mut now = publisher.matched_subscribers();
        let reached = self
            .runtime
            .block_on(async { patience::wait_for(now.wait_for(|now| now.connected_count() == count)).await.is_ok() });
        ensure!(
            reached,
            "{count} subscribers should be connected, not {}",
            publisher.matched_subscribers().borrow().connected_count()
        );
        Ok(())
    }

    /// Waits until `count` publishers are connected.
    pub fn wait_for_publishers(&self, subscription: &Subscription, count: usize) -> anyhow::Result<()> {
        let mut now = subscription.matched.clone();
        let reached = self
            .runtime
            .block_on(async { patience::wait_for(now.wait_for(|now| now.connected_count() == count)).await.is_ok() });
        ensure!(
            reached,
            "{count} publishers should be connected, not {}",
            subscription.matched.borrow().connected_count()
        );
        Ok(())
    }

    /// Calls a service.
    pub fn call_service(&self, node: &(impl HasBus + ?Sized), service: &str, request: &[u8]) -> anyhow::Result<Bytes> {
        let request = Bytes::copy_from_slice(request);
        let called = node.bus().call(service, request, patience());
        Ok(self.runtime.block_on(called)?)
    }

    /// Starts a stub for an executable of a service of the daemon, as robot `robot`.
    pub fn start_stub(
        &self,
        daemon: &Daemon,
        (service, package, executable): (&str, &str, &str),
        robot: &str,
        argv: &[&str],
    ) -> anyhow::Result<NodeProcess> {
        let toml = format!(
            "server = \"ws://{}\"\nservice = \"{service}\"\nrobot = \"{robot}\"\nlocal = \"none\"\n",
            daemon.address
        );
        self.start_stub_with_config(&toml, package, executable, argv)
    }

    /// Starts a stub with this `stub.toml`.
    pub fn start_stub_with_config(
        &self,
        toml: &str,
        package: &str,
        executable: &str,
        argv: &[&str],
    ) -> anyhow::Result<NodeProcess> {
        self.start_stub_with_environment(&[], toml, package, executable, argv)
    }

    /// Starts a stub with this `stub.toml` and these environment variables.
    pub fn start_stub_with_environment(
        &self,
        environment: &[(&str, &str)],
        toml: &str,
        package: &str,
        executable: &str,
        argv: &[&str],
    ) -> anyhow::Result<NodeProcess> {
        let overlay = tempfile::Builder::new().prefix("stub").tempdir_in(self.place.path())?.keep();
        let share = overlay.join("share").join(package);
        std::fs::create_dir_all(&share)?;
        std::fs::write(share.join("stub.toml"), toml)?;
        let ros = self.system.version().number();
        std::fs::write(share.join("revision.toml"), format!("ros = {ros}\n"))?;
        let mut command = Command::new(binaries::path("stubs/x86_64/cloudroid-stub"));
        command
            .args(["run", "--package", package, "--node", executable, "--share"])
            .arg(&share)
            .arg("--")
            .args(argv)
            .envs(environment.iter().copied());
        self.start(command, &overlay.join("log"))
    }

    /// Installs a stub of a service from the archive for this robot's ROS, with `settings` appended to its `stub.toml`;
    /// returns the overlay.
    pub fn install_stub(&self, daemon: &Daemon, service: &str, settings: &str) -> anyhow::Result<PathBuf> {
        self.install_stub_for(daemon, service, std::env::consts::ARCH, settings)
    }

    /// Installs a stub for another architecture.
    pub fn install_stub_for(
        &self,
        daemon: &Daemon,
        service: &str,
        architecture: &str,
        settings: &str,
    ) -> anyhow::Result<PathBuf> {
        let place = tempfile::Builder::new().prefix("installed").tempdir_in(self.place.path())?.keep();
        let directory = path_str(&place);
        let ros = self.system.version().number().to_string();
        let words = ["stub", service, "--arch", architecture, "--ros", &ros, "-o", directory];
        daemon.deployer().run(&words)?.expect_success()?;
        let archive = File::open(place.join(format!("{service}.tar.gz")))?;
        tar::Archive::new(flate2::read::GzDecoder::new(archive)).unpack(&place)?;
        let overlay = place.join(format!("{service}-stub"));
        for package in std::fs::read_dir(overlay.join("share"))? {
            let path = package?.path().join("stub.toml");
            // The resource index of ROS 2 is outside of the package's directory.
            if !path.exists() {
                continue;
            }
            let text = std::fs::read_to_string(&path)?;
            std::fs::write(path, format!("{text}{settings}"))?;
        }
        Ok(overlay)
    }

    /// Starts an executable of an installed stub.
    pub fn start_installed(
        &self,
        overlay: &Path,
        package: &str,
        executable: &str,
        argv: &[&str],
    ) -> anyhow::Result<NodeProcess> {
        self.start_installed_with_environment(&[], overlay, package, executable, argv)
    }

    /// Starts an executable of an installed stub with these environment variables.
    pub fn start_installed_with_environment(
        &self,
        environment: &[(&str, &str)],
        overlay: &Path,
        package: &str,
        executable: &str,
        argv: &[&str],
    ) -> anyhow::Result<NodeProcess> {
        let mut command = Command::new(overlay.join("lib").join(package).join(executable));
        command.args(argv).envs(environment.iter().copied());
        let log = tempfile::Builder::new().tempfile_in(self.place.path())?;
        self.start(command, &log.into_temp_path().keep()?)
    }

    /// Starts an executable of an installed stub with an emulator, which needs the arguments that a launcher would
    /// pass.
    pub fn start_emulated(
        &self,
        emulator: &str,
        overlay: &Path,
        package: &str,
        executable: &str,
        argv: &[&str],
    ) -> anyhow::Result<NodeProcess> {
        let mut command = Command::new(emulator);
        command
            .arg(overlay.join("lib").join(package).join("cloudroid-stub"))
            .args(["run", "--package", package, "--node", executable, "--share"])
            .arg(overlay.join("share").join(package))
            .arg("--")
            .args(argv);
        let log = tempfile::Builder::new().tempfile_in(self.place.path())?;
        self.start(command, &log.into_temp_path().keep()?)
    }

    /// Starts an original in the root file system of a service's image, in this machine's network.
    pub fn start_original(
        &self,
        daemon: &Daemon,
        service: &str,
        program: &str,
        argv: &[&str],
    ) -> anyhow::Result<NodeProcess> {
        let script = self.image_shell(daemon, service)?;
        let argv: Vec<String> = argv.iter().map(|word| (*word).to_owned()).collect();
        self.start_in_image(&script, program, &argv)
    }

    /// Installs an executable of a service's image on the robot: returns a workspace for CMAKE_PREFIX_PATH, or
    /// AMENT_PREFIX_PATH in ROS 2, whose program runs the original in the image's root file system.
    pub fn install_original(
        &self,
        daemon: &Daemon,
        service: &str,
        (package, executable): (&str, &str),
        program: &str,
    ) -> anyhow::Result<PathBuf> {
        let prefix = self.place.path().join("installed").join(package);
        let launcher = prefix.join("lib").join(package).join(executable);
        std::fs::create_dir_all(launcher.parent().context("a directory")?)?;
        let script = self.image_shell(daemon, service)?;
        let variables = match self.system.version() {
            RosVersion::One => {
                std::fs::write(prefix.join(".catkin"), "")?;
                "HOME=/root".to_owned()
            }
            RosVersion::Two => {
                let index = prefix.join("share/ament_index/resource_index/packages");
                std::fs::create_dir_all(&index)?;
                std::fs::write(index.join(package), "")?;
                format!("HOME=/root {}", image_environment(daemon, service)?)
            }
        };
        let text = format!("#!/bin/sh\nexec unshare --mount sh -c '{script}' sh env {variables} {program} \"$@\"\n");
        std::fs::write(&launcher, text)?;
        let executable = std::os::unix::fs::PermissionsExt::from_mode(0o755);
        std::fs::set_permissions(&launcher, executable)?;
        Ok(prefix)
    }

    /// Returns shell commands that execute their arguments in a service's root file system.
    fn image_shell(&self, daemon: &Daemon, service: &str) -> anyhow::Result<String> {
        image_shell(daemon, service, &self.place.path().join("root"))
    }

    /// Starts a program in a root file system, through the commands of [`image_shell`].
    pub fn start_in_image(&self, script: &str, program: &str, argv: &[String]) -> anyhow::Result<NodeProcess> {
        let mut command = Command::new("unshare");
        command.args(["--mount", "sh", "-c", script, "sh", program]).args(argv);
        command.env("HOME", "/root").env("ROS_IP", "127.0.0.1");
        let name = program.rsplit('/').next().unwrap_or(program);
        self.start(command, &self.place.path().join(format!("{name}-in-image.log")))
    }

    fn start(&self, mut command: Command, log: &Path) -> anyhow::Result<NodeProcess> {
        let file = File::create(log)?;
        self.system.configure(&mut command);
        command.stdin(Stdio::null()).stdout(file.try_clone()?).stderr(file);
        let spawned = match &self.namespace {
            Some(namespace) => run_in_namespace(namespace, || command.spawn())?,
            None => command.spawn(),
        };
        let child = spawned.context("starting a node")?;
        Ok(NodeProcess { child, log: log.to_owned() })
    }
}

/// Returns shell commands that mount a service's root file system at `root` and execute their arguments in it; for a
/// private mount namespace.
pub fn image_shell(daemon: &Daemon, service: &str, root: &Path) -> anyhow::Result<String> {
    let config = image_config(daemon, service)?;
    let diffs = config["rootfs"]["diff_ids"].as_array().context("layers")?;
    std::fs::create_dir_all(root)?;
    let layers = diffs.iter().rev().filter_map(|diff| diff.as_str());
    let layers: Vec<PathBuf> = layers.map(|diff| layer_path(&daemon.home, diff)).collect::<anyhow::Result<_>>()?;
    let lowers: Vec<String> = layers.iter().map(|layer| layer.display().to_string()).collect();
    Ok(format!(
        "mount -t overlay overlay -o lowerdir={} {root} && mount --rbind /dev {root}/dev && mount -t proc proc \
         {root}/proc && mount -t tmpfs none {root}/root && mount -t tmpfs none {root}/tmp && exec chroot {root} \"$@\"",
        lowers.join(":"),
        root = root.display(),
    ))
}

/// Returns the configuration of a service's image (OCI image specification, config.md).
pub fn image_config(daemon: &Daemon, service: &str) -> anyhow::Result<serde_json::Value> {
    let manifest = daemon.get_json(&format!("/v2/{service}/manifests/latest"))?;
    let config = manifest["config"]["digest"].as_str().context("a config")?;
    daemon.get_json(&format!("/v2/{service}/blobs/{config}"))
}

/// Returns the environment of a service's image as arguments of `env`, without the variables that select a ROS system.
fn image_environment(daemon: &Daemon, service: &str) -> anyhow::Result<String> {
    let config = image_config(daemon, service)?;
    let variables = config["config"]["Env"].as_array().context("variables")?;
    let variables = variables.iter().filter_map(|variable| variable.as_str());
    let kept = variables
        .filter(|variable| !["ROS_DOMAIN_ID", "ROS_AUTOMATIC", "HOME="].iter().any(|own| variable.starts_with(own)));
    let quoted = kept.map(|variable| format!("'{}'", variable.replace('\'', "")));
    Ok(quoted.collect::<Vec<_>>().join(" "))
}

/// Returns the directory of an extracted layer.
fn layer_path(home: &Path, diff: &str) -> anyhow::Result<PathBuf> {
    let layers = home.join("layers");
    let hex = diff.trim_start_matches("sha256:");
    [layers.join(hex), layers.join(diff), layers.join("sha256").join(hex)]
        .into_iter()
        .find(|path| path.is_dir())
        .with_context(|| format!("layer {diff} below {}", layers.display()))
}

impl NodeProcess {
    /// Returns its pid.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Returns its output.
    pub fn output(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// Waits until its output contains these words.
    pub fn wait_for_output(&self, words: &str) -> anyhow::Result<()> {
        self.wait_for_output_times(words, 1)
    }

    /// Waits until its output contains these words a number of times.
    pub fn wait_for_output_times(&self, words: &str, times: usize) -> anyhow::Result<()> {
        crate::wait_until(&format!("{words:?}, {times} times"), || {
            let said = self.output();
            let enough = said.matches(words).count() >= times;
            Ok(if enough { Ok(()) } else { Err(said) })
        })
    }

    /// Sends it a signal.
    pub fn signal(&self, signal: Signal) -> anyhow::Result<()> {
        Ok(kill(Pid::from_raw(i32::try_from(self.child.id())?), signal)?)
    }

    /// Waits for its end.
    pub fn wait_for_exit(&mut self) -> anyhow::Result<ExitStatus> {
        crate::wait_until("its end", || {
            let ended = self.child.try_wait()?;
            Ok(ended.ok_or_else(|| self.output()))
        })
    }
}

impl Drop for NodeProcess {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("{}", self.output());
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Returns the registrations of `node` as comparable lines: names and types.
pub fn registrations(graph: &Graph, node: &str) -> BTreeSet<String> {
    let node = node.to_owned();
    let mut lines = BTreeSet::new();
    for (topic, ends) in &graph.topics {
        if ends.publishers.contains(&node) {
            lines.insert(format!("publishes {topic} [{}]", ends.type_name));
        }
        if ends.subscribers.contains(&node) {
            lines.insert(format!("subscribes {topic} [{}]", ends.type_name));
        }
    }
    for (service, server) in &graph.services {
        if *server == node {
            lines.insert(format!("serves {service}"));
        }
    }
    lines
}

/// Returns the type of strings in either version of ROS.
pub fn string_type(version: RosVersion) -> anyhow::Result<WireType> {
    let name = match version {
        RosVersion::One => "std_msgs/String",
        RosVersion::Two => "std_msgs/msg/String",
    };
    let of = MessageType::parse_full_text(version, name, "string data\n")?;
    Ok(WireType::from_message(&of))
}

/// Serializes a std_msgs/String of ROS 1.
pub fn string(text: &str) -> Bytes {
    string_in(WireFormat::Ros1, text)
}

/// Serializes a string in this format.
pub fn string_in(format: WireFormat, text: &str) -> Bytes {
    let (header, end): (&[u8], &[u8]) = match format {
        WireFormat::Ros1 => (&[], &[]),
        // Little endian; strings end with a zero byte.
        WireFormat::Cdr => (&[0, 1, 0, 0], &[0]),
    };
    let length = u32::try_from(text.len() + end.len()).unwrap_or(0);
    [header, &length.to_le_bytes(), text.as_bytes(), end].concat().into()
}

/// Returns the string at the end of a message, after `flags` bytes.
pub fn string_text(version: RosVersion, message: &[u8], flags: usize) -> anyhow::Result<String> {
    let at = match version {
        RosVersion::One => flags + 4,
        RosVersion::Two => 4 + flags.next_multiple_of(4) + 4,
    };
    let text = message.get(at..).context("too short")?;
    let text = String::from_utf8_lossy(text);
    Ok(text.trim_end_matches('\0').to_owned())
}
