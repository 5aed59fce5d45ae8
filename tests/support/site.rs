//! A robot's side of a link: a ROS system, the robot's own nodes, and stubs in place of what runs in the cloud.

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
use ros::bus::{
    Bus, Graph, Message, Publisher, Qos, RosVersion, Subscription, WireFormat, WireType,
};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::schema::MessageType;
use tokio::runtime::Runtime;

use crate::binaries;
use crate::cable::within;
use crate::daemon::Daemon;
use crate::deployer::path_str;
use crate::patience::{self, Deadline, patience};
use crate::ros_system::{Domain, Node, RosSystem};
use crate::world::Directory;

/// A message that will come is nearly always there by then.
const MOMENT: Duration = Duration::from_millis(200);

/// A robot.
pub struct Site {
    /// Where its nodes of this process run.
    pub runtime: Runtime,
    /// Its ROS.
    pub system: RosSystem,
    /// Where its processes run, if not in this machine's own network.
    namespace: Option<PathBuf>,
    place: Directory,
}

/// A node that runs as a process: a stub, or an original.
pub struct Running {
    child: Child,
    log: PathBuf,
}

impl Site {
    /// A robot of ROS 1 with nothing but a Master.
    pub fn new() -> anyhow::Result<Self> {
        Self::of(RosVersion::One)
    }

    /// A robot of this ROS, without a node.
    pub fn of(version: RosVersion) -> anyhow::Result<Self> {
        Self::made(None, |runtime| RosSystem::new(version, runtime))
    }

    /// A robot of ROS 2 whose processes run in a network namespace; none of this process can join them.
    pub fn inside(namespace: PathBuf, domain: Domain) -> anyhow::Result<Self> {
        Self::made(Some(namespace), |_| Ok(RosSystem::Domain(domain)))
    }

    fn made(
        namespace: Option<PathBuf>,
        system: impl FnOnce(&Runtime) -> anyhow::Result<RosSystem>,
    ) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()?;
        let place = Directory::new("site")?;
        Ok(Self {
            system: system(&runtime)?,
            runtime,
            namespace,
            place,
        })
    }

    /// Where its Master listens.
    pub fn master(&self) -> anyhow::Result<SocketAddr> {
        self.system.master().context("a robot of ROS 1")
    }

    /// Starts a Master, where the last one was if there was one.
    pub fn start_master(&mut self) -> anyhow::Result<()> {
        self.system.start_master(&self.runtime)
    }

    /// Ends the Master; what was registered there is forgotten.
    pub fn end_master(&mut self) {
        self.system.end_master(&self.runtime);
    }

    /// A node of this process, on a robot of ROS 1.
    pub fn node(&self, name: &str) -> anyhow::Result<Arc<Ros1Bus>> {
        let joined = Ros1Bus::connect(Arc::new(HostSockets), self.master()?, name);
        Ok(self.runtime.block_on(joined)?)
    }

    /// A node of this process, on a robot of either ROS.
    pub fn joins(&self, name: &str) -> anyhow::Result<Arc<dyn Bus>> {
        self.runtime.block_on(self.system.join(name))
    }

    /// Waits until the graph is as wanted.
    pub fn until(
        &self,
        node: &(impl Node + ?Sized),
        what: &str,
        wanted: impl Fn(&Graph) -> bool,
    ) -> anyhow::Result<Graph> {
        let mut graphs = node.bus().graph();
        let found = self.runtime.block_on(async {
            let found = patience::wait_for(graphs.wait_for(|graph| wanted(graph)));
            found
                .await
                .map(|found| found.map(|graph| (**graph).clone()))
        });
        match found {
            Ok(graph) => Ok(graph?),
            Err(error) => bail!("{what}: {error}: {:#?}", node.bus().graph().borrow()),
        }
    }

    /// Advertises a topic of strings.
    pub fn says(
        &self,
        node: &(impl Node + ?Sized),
        topic: &str,
        latch: bool,
    ) -> anyhow::Result<Box<dyn Publisher>> {
        let of = string_type(self.system.version())?;
        let qos = Qos::keep_last(100).latching(latch);
        Ok(self
            .runtime
            .block_on(node.bus().advertise(topic, of, qos))?)
    }

    /// Subscribes to a topic of any type.
    pub fn hears(&self, node: &(impl Node + ?Sized), topic: &str) -> anyhow::Result<Subscription> {
        let subscribed = node
            .bus()
            .subscribe(topic, WireType::any(), Qos::keep_last(100));
        Ok(self.runtime.block_on(subscribed)?)
    }

    /// The same, with what publishers have latched, which a newcomer of ROS 2 has to ask for.
    pub fn hears_latched(
        &self,
        node: &(impl Node + ?Sized),
        topic: &str,
    ) -> anyhow::Result<Subscription> {
        let qos = Qos::keep_last(100).latching(true);
        let subscribed = node.bus().subscribe(topic, WireType::any(), qos);
        Ok(self.runtime.block_on(subscribed)?)
    }

    /// The next message.
    pub fn next(&self, subscription: &mut Subscription) -> anyhow::Result<Message> {
        let next = self
            .runtime
            .block_on(patience::wait_for(subscription.messages.recv()));
        next.context("a message should come")?
            .context("the topic ended")
    }

    /// The next message, if one comes in time.
    pub fn next_within(
        &self,
        subscription: &mut Subscription,
        time: Duration,
    ) -> anyhow::Result<Option<Message>> {
        let next = async { tokio::time::timeout(time, subscription.messages.recv()).await };
        match self.runtime.block_on(next) {
            Ok(next) => Ok(Some(next.context("the topic ended")?)),
            Err(_) => Ok(None),
        }
    }

    /// Asks again and again until a message comes that is wanted: as in every ROS, what is said before all are connected is lost.
    /// Of those that were asked for more than once some may come later.
    pub fn asks_until(
        &self,
        subscription: &mut Subscription,
        mut ask: impl FnMut() -> anyhow::Result<()>,
        mut wanted: impl FnMut(&Message) -> anyhow::Result<bool>,
    ) -> anyhow::Result<Message> {
        let deadline = Deadline::begin();
        loop {
            ask()?;
            while let Some(message) = self.next_within(subscription, patience::scale(MOMENT))? {
                if wanted(&message)? {
                    return Ok(message);
                }
                deadline.check(|| format!("{message:?} came last, and is not what should"))?;
            }
            deadline.check(|| "nothing came that was asked for".to_owned())?;
        }
    }

    /// Waits until so many subscribers are connected.
    pub fn connected(&self, publisher: &dyn Publisher, count: usize) -> anyhow::Result<()> {
        let mut now = publisher.matched();
        let reached = self.runtime.block_on(async {
            patience::wait_for(now.wait_for(|now| now.connected() == count))
                .await
                .is_ok()
        });
        ensure!(
            reached,
            "{count} subscribers should be connected, not {}",
            publisher.matched().borrow().connected()
        );
        Ok(())
    }

    /// Waits until so many publishers are connected.
    pub fn fed(&self, subscription: &Subscription, count: usize) -> anyhow::Result<()> {
        let mut now = subscription.matched.clone();
        let reached = self.runtime.block_on(async {
            patience::wait_for(now.wait_for(|now| now.connected() == count))
                .await
                .is_ok()
        });
        ensure!(
            reached,
            "{count} publishers should be connected, not {}",
            subscription.matched.borrow().connected()
        );
        Ok(())
    }

    /// Calls a service.
    pub fn calls(
        &self,
        node: &(impl Node + ?Sized),
        service: &str,
        request: &[u8],
    ) -> anyhow::Result<Bytes> {
        let request = Bytes::copy_from_slice(request);
        let called = node.bus().call(service, request, patience());
        Ok(self.runtime.block_on(called)?)
    }

    /// Starts a stub for an executable of a service of the daemon, as robot `robot`.
    pub fn stub(
        &self,
        daemon: &Daemon,
        (service, package, executable): (&str, &str, &str),
        robot: &str,
        argv: &[&str],
    ) -> anyhow::Result<Running> {
        let toml = format!(
            "server = \"ws://{}\"\nservice = \"{service}\"\nrobot = \"{robot}\"\nlocal = \"none\"\n",
            daemon.address
        );
        self.stub_with(&toml, package, executable, argv)
    }

    /// The same with a `stub.toml` of one's own.
    pub fn stub_with(
        &self,
        toml: &str,
        package: &str,
        executable: &str,
        argv: &[&str],
    ) -> anyhow::Result<Running> {
        self.stub_among(&[], toml, package, executable, argv)
    }

    /// The same, with these variables in its environment.
    pub fn stub_among(
        &self,
        environment: &[(&str, &str)],
        toml: &str,
        package: &str,
        executable: &str,
        argv: &[&str],
    ) -> anyhow::Result<Running> {
        let overlay = tempfile::Builder::new()
            .prefix("stub")
            .tempdir_in(self.place.path())?
            .keep();
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

    /// Installs a stub of a service as its archive comes, with `settings` added to its `stub.toml`; gives the overlay.
    pub fn installs(
        &self,
        daemon: &Daemon,
        service: &str,
        settings: &str,
    ) -> anyhow::Result<PathBuf> {
        self.installs_for(daemon, service, std::env::consts::ARCH, settings)
    }

    /// The same for another architecture.
    pub fn installs_for(
        &self,
        daemon: &Daemon,
        service: &str,
        architecture: &str,
        settings: &str,
    ) -> anyhow::Result<PathBuf> {
        let place = tempfile::Builder::new()
            .prefix("installed")
            .tempdir_in(self.place.path())?
            .keep();
        let directory = path_str(&place);
        let words = ["stub", service, "--arch", architecture, "-o", directory];
        daemon.deployer().types(&words)?.succeeded()?;
        let archive = File::open(place.join(format!("{service}.tar.gz")))?;
        tar::Archive::new(flate2::read::GzDecoder::new(archive)).unpack(&place)?;
        let overlay = place.join(format!("{service}-stub"));
        for package in std::fs::read_dir(overlay.join("share"))? {
            let path = package?.path().join("stub.toml");
            // The index of ROS 2 stands beside the package.
            if !path.exists() {
                continue;
            }
            let text = std::fs::read_to_string(&path)?;
            std::fs::write(path, format!("{text}{settings}"))?;
        }
        Ok(overlay)
    }

    /// Starts an executable of an installed stub.
    pub fn runs(
        &self,
        overlay: &Path,
        package: &str,
        executable: &str,
        argv: &[&str],
    ) -> anyhow::Result<Running> {
        self.runs_among(&[], overlay, package, executable, argv)
    }

    /// The same, with these variables in its environment.
    pub fn runs_among(
        &self,
        environment: &[(&str, &str)],
        overlay: &Path,
        package: &str,
        executable: &str,
        argv: &[&str],
    ) -> anyhow::Result<Running> {
        let mut command = Command::new(overlay.join("lib").join(package).join(executable));
        command.args(argv).envs(environment.iter().copied());
        let log = tempfile::Builder::new().tempfile_in(self.place.path())?;
        self.start(command, &log.into_temp_path().keep()?)
    }

    /// The same by an emulator, which has to be told what a launcher would.
    pub fn emulates(
        &self,
        emulator: &str,
        overlay: &Path,
        package: &str,
        executable: &str,
        argv: &[&str],
    ) -> anyhow::Result<Running> {
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
    pub fn original(
        &self,
        daemon: &Daemon,
        service: &str,
        program: &str,
        argv: &[&str],
    ) -> anyhow::Result<Running> {
        let script = self.in_image(daemon, service)?;
        let argv: Vec<String> = argv.iter().map(|word| (*word).to_owned()).collect();
        self.starts_in_image(&script, program, &argv)
    }

    /// Installs an executable of a service's image on the robot: a workspace to stand on CMAKE_PREFIX_PATH, or of ROS 2 on
    /// AMENT_PREFIX_PATH, whose program becomes the original in the image's root file system.
    pub fn installs_original(
        &self,
        daemon: &Daemon,
        service: &str,
        (package, executable): (&str, &str),
        program: &str,
    ) -> anyhow::Result<PathBuf> {
        let prefix = self.place.path().join("installed").join(package);
        let launcher = prefix.join("lib").join(package).join(executable);
        std::fs::create_dir_all(launcher.parent().context("a directory")?)?;
        let script = self.in_image(daemon, service)?;
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
        let text = format!(
            "#!/bin/sh\nexec unshare --mount sh -c '{script}' sh env {variables} {program} \"$@\"\n"
        );
        std::fs::write(&launcher, text)?;
        let executable = std::os::unix::fs::PermissionsExt::from_mode(0o755);
        std::fs::set_permissions(&launcher, executable)?;
        Ok(prefix)
    }

    /// A shell's commands that execute their arguments in a service's root file system.
    fn in_image(&self, daemon: &Daemon, service: &str) -> anyhow::Result<String> {
        in_image(daemon, service, &self.place.path().join("root"))
    }

    /// Starts a program in a root file system, by commands of [`in_image`].
    pub fn starts_in_image(
        &self,
        script: &str,
        program: &str,
        argv: &[String],
    ) -> anyhow::Result<Running> {
        let mut command = Command::new("unshare");
        command
            .args(["--mount", "sh", "-c", script, "sh", program])
            .args(argv);
        command.env("HOME", "/root").env("ROS_IP", "127.0.0.1");
        self.start(command, &self.place.path().join("original.log"))
    }

    fn start(&self, mut command: Command, log: &Path) -> anyhow::Result<Running> {
        let file = File::create(log)?;
        self.system.is_of(&mut command);
        command
            .stdin(Stdio::null())
            .stdout(file.try_clone()?)
            .stderr(file);
        let spawned = match &self.namespace {
            Some(namespace) => within(namespace, || command.spawn())?,
            None => command.spawn(),
        };
        let child = spawned.context("starting a node")?;
        Ok(Running {
            child,
            log: log.to_owned(),
        })
    }
}

/// A shell's commands that execute their arguments in a service's root file system, which is mounted at `root`; for a mount namespace of
/// its own.
pub fn in_image(daemon: &Daemon, service: &str, root: &Path) -> anyhow::Result<String> {
    let config = image_config(daemon, service)?;
    let diffs = config["rootfs"]["diff_ids"].as_array().context("layers")?;
    std::fs::create_dir_all(root)?;
    let layers = diffs.iter().rev().filter_map(|diff| diff.as_str());
    let layers: Vec<PathBuf> = layers
        .map(|diff| layer(&daemon.home, diff))
        .collect::<anyhow::Result<_>>()?;
    let lowers: Vec<String> = layers
        .iter()
        .map(|layer| layer.display().to_string())
        .collect();
    Ok(format!(
        "mount -t overlay overlay -o lowerdir={} {root} && mount --rbind /dev {root}/dev && mount -t proc proc {root}/proc && mount -t tmpfs none {root}/root && mount -t tmpfs none {root}/tmp && exec chroot {root} \"$@\"",
        lowers.join(":"),
        root = root.display(),
    ))
}

/// The configuration of a service's image (OCI image specification, config.md).
pub fn image_config(daemon: &Daemon, service: &str) -> anyhow::Result<serde_json::Value> {
    let manifest = daemon.get_json(&format!("/v2/{service}/manifests/latest"))?;
    let config = manifest["config"]["digest"].as_str().context("a config")?;
    daemon.get_json(&format!("/v2/{service}/blobs/{config}"))
}

/// The variables of a service's image as `env` takes them, but for those that say which ROS system is joined.
fn image_environment(daemon: &Daemon, service: &str) -> anyhow::Result<String> {
    let config = image_config(daemon, service)?;
    let variables = config["config"]["Env"].as_array().context("variables")?;
    let variables = variables.iter().filter_map(|variable| variable.as_str());
    let kept = variables.filter(|variable| {
        !["ROS_DOMAIN_ID", "ROS_AUTOMATIC", "HOME="]
            .iter()
            .any(|own| variable.starts_with(own))
    });
    let quoted = kept.map(|variable| format!("'{}'", variable.replace('\'', "")));
    Ok(quoted.collect::<Vec<_>>().join(" "))
}

/// Where a layer is extracted.
fn layer(home: &Path, diff: &str) -> anyhow::Result<PathBuf> {
    let layers = home.join("layers");
    let hex = diff.trim_start_matches("sha256:");
    [
        layers.join(hex),
        layers.join(diff),
        layers.join("sha256").join(hex),
    ]
    .into_iter()
    .find(|path| path.is_dir())
    .with_context(|| format!("layer {diff} below {}", layers.display()))
}

impl Running {
    /// Its process.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// What it printed.
    pub fn said(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// Waits until it has printed these words.
    pub fn says(&self, words: &str) -> anyhow::Result<()> {
        self.says_times(words, 1)
    }

    /// Waits until it has printed these words so many times.
    pub fn says_times(&self, words: &str, times: usize) -> anyhow::Result<()> {
        crate::until(&format!("{words:?}, {times} times"), || {
            let said = self.said();
            let enough = said.matches(words).count() >= times;
            Ok(if enough { Ok(()) } else { Err(said) })
        })
    }

    /// Sends it a signal.
    pub fn signal(&self, signal: Signal) -> anyhow::Result<()> {
        Ok(kill(
            Pid::from_raw(i32::try_from(self.child.id())?),
            signal,
        )?)
    }

    /// Waits for its end.
    pub fn ends(&mut self) -> anyhow::Result<ExitStatus> {
        crate::until("its end", || {
            let ended = self.child.try_wait()?;
            Ok(ended.ok_or_else(|| self.said()))
        })
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("{}", self.said());
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What `node` has registered, as lines that can be compared: names and types.
pub fn registered(graph: &Graph, node: &str) -> BTreeSet<String> {
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

/// The type of strings in either ROS.
pub fn string_type(version: RosVersion) -> anyhow::Result<WireType> {
    let name = match version {
        RosVersion::One => "std_msgs/String",
        RosVersion::Two => "std_msgs/msg/String",
    };
    let of = MessageType::of_full_text(version, name, "string data\n")?;
    Ok(WireType::of(&of))
}

/// A serialized std_msgs/String of ROS 1.
pub fn string(text: &str) -> Bytes {
    string_of(WireFormat::Ros1, text)
}

/// A serialized string in this format.
pub fn string_of(format: WireFormat, text: &str) -> Bytes {
    let (header, end): (&[u8], &[u8]) = match format {
        WireFormat::Ros1 => (&[], &[]),
        // Little endian, and strings that end with a zero.
        WireFormat::Cdr => (&[0, 1, 0, 0], &[0]),
    };
    let length = u32::try_from(text.len() + end.len()).unwrap_or(0);
    [header, &length.to_le_bytes(), text.as_bytes(), end]
        .concat()
        .into()
}

/// The text that a message ends with, behind so many bytes of flags.
pub fn text_of(version: RosVersion, message: &[u8], flags: usize) -> anyhow::Result<String> {
    let at = match version {
        RosVersion::One => flags + 4,
        RosVersion::Two => 4 + flags.next_multiple_of(4) + 4,
    };
    let text = message.get(at..).context("too short")?;
    let text = String::from_utf8_lossy(text);
    Ok(text.trim_end_matches('\0').to_owned())
}
