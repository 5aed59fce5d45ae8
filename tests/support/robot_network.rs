//! A robot's own network: its computer and a second machine that runs its application.
//!
//! ```text
//!  portal ══ a cable ══ the robot's computer, 10.77.0.1 ── virtual network ── the other machine, 10.77.0.2
//! ```
//! Both machines are network namespaces.

use std::io::{BufRead, BufReader, Write};
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};

use anyhow::{Context, ensure};
use serde_json::Value;

use crate::binaries;
use crate::cable::{Cable, ip, run_in_namespace};
use crate::patience;
use crate::ros_system::Domain;
use crate::site::Site;

/// Address of the other machine.
pub const OTHER: Ipv4Addr = Ipv4Addr::new(10, 77, 0, 2);
/// `ROS_DOMAIN_ID` of all processes.
const DOMAIN: u16 = 7;
/// Name of the device on both machines that connects them.
const CARD: &str = "lan";
/// A discovery server that is a Fast DDS node.
const SERVER: &str = "src/reach/tests/ros2/server.py";
/// Programs of a machine have a private /dev/shm, which disappears with them: names in it are derived from ports, which
/// are the same on other machines.
const WITHIN: &str = r#"mount -t tmpfs shm /dev/shm && exec "$@""#;

/// The network; removed on drop.
pub struct RobotNetwork {
    cable: Cable,
    robot: String,
    other: String,
    servers: Option<String>,
}

impl RobotNetwork {
    /// Creates a network whose programs discover each other by multicast.
    pub fn new(portal: &str) -> anyhow::Result<Self> {
        Self::create(portal, None)
    }

    /// Creates a network whose programs discover each other through a discovery server, which is to run on the other
    /// machine.
    pub fn with_discovery_server(portal: &str) -> anyhow::Result<Self> {
        Self::create(portal, Some(format!("{OTHER}:11811")))
    }

    fn create(portal: &str, servers: Option<String>) -> anyhow::Result<Self> {
        let cable = Cable::with_robot_inside(portal)?;
        let robot = cable.namespace();
        let robot = robot.file_name().and_then(|name| name.to_str());
        let robot = robot.context("a name")?.to_owned();
        let other = format!("{robot}-other");
        ip(&["netns", "add", &other])?;
        let network = Self { cable, robot, other, servers };
        network.create_links()?;
        Ok(network)
    }

    fn create_links(&self) -> anyhow::Result<()> {
        let [robot, other] = [&*self.robot, &*self.other];
        ip(&["-n", robot, "link", "add", CARD, "type", "veth", "peer", "name", CARD, "netns", other])?;
        ip(&["-n", other, "link", "set", "lo", "up"])?;
        for (machine, address) in [(robot, "10.77.0.1/24"), (other, "10.77.0.2/24")] {
            ip(&["-n", machine, "addr", "add", address, "dev", CARD])?;
            ip(&["-n", machine, "link", "set", CARD, "up"])?;
        }
        for machine in [robot, other] {
            wait_for_carrier(machine)?;
        }
        Ok(())
    }

    /// Returns the portal's address for the robot.
    pub fn portal(&self) -> SocketAddr {
        self.cable.server
    }

    fn domain(&self) -> Domain {
        Domain::for_network(DOMAIN, self.servers.as_deref())
    }

    /// Returns the robot's computer.
    pub fn robot(&self) -> anyhow::Result<Site> {
        Site::in_namespace(self.cable.namespace(), self.domain())
    }

    fn other_namespace(&self) -> PathBuf {
        Path::new("/run/netns").join(&self.other)
    }

    /// Starts a program of `tests/robots` on the other machine.
    pub fn start_application(&self, program: &str, arguments: &[&str]) -> anyhow::Result<RobotProgram> {
        let mut command = python(&Path::new("tests/robots").join(program));
        command.args(arguments);
        self.domain().configure(&mut command);
        RobotProgram::start(command, &self.other_namespace())
    }

    /// Starts the discovery server.
    pub fn start_discovery_server(&self) -> anyhow::Result<RobotProgram> {
        let mut command = python(Path::new(SERVER));
        command.args(["0", &OTHER.to_string()]);
        Domain::for_network(DOMAIN, None).configure(&mut command);
        RobotProgram::start(command, &self.other_namespace())
    }
}

impl Drop for RobotNetwork {
    fn drop(&mut self) {
        let _ = ip(&["netns", "del", &self.other]);
    }
}

fn python(program: &Path) -> Command {
    let mut command = Command::new("unshare");
    command
        .args(["--mount", "sh", "-c", WITHIN, "sh"])
        .arg(binaries::ros2().join("bin/python"))
        .arg(binaries::checkout().join(program));
    command
}

/// Waits until the kernel reports the device as up, which takes up to a second: Fast DDS ignores devices that are down,
/// and checks only once.
fn wait_for_carrier(machine: &str) -> anyhow::Result<()> {
    crate::wait_until("a network", || {
        let mut command = Command::new("ip");
        command.args(["-n", machine, "-brief", "link", "show", CARD]);
        let told = String::from_utf8(command.output()?.stdout)?;
        let is_up = told.split_whitespace().nth(1) == Some("UP");
        Ok(if is_up { Ok(()) } else { Err(told) })
    })
}

/// A program that reads orders as lines and answers with lines of JSON, `[ORDER, ANSWER]`; the first answer is
/// `["ready"]`.
pub struct RobotProgram {
    child: Child,
    orders: ChildStdin,
    lines: Receiver<String>,
}

impl RobotProgram {
    /// Starts it and waits until it is ready.
    fn start(mut command: Command, namespace: &Path) -> anyhow::Result<Self> {
        patience::tell_patience(&mut command).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = run_in_namespace(namespace, || command.spawn())?.context("starting a program")?;
        let (said, lines) = channel();
        let output = child.stdout.take().context("its output")?;
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                let _ = said.send(line);
            }
        });
        let application = Self { orders: child.stdin.take().context("its input")?, child, lines };
        application.read_answer("ready")?;
        Ok(application)
    }

    fn read_answer(&self, what: &str) -> anyhow::Result<Value> {
        let line = patience::receive(&self.lines);
        let line = line.with_context(|| format!("an application should say {what}"))?;
        let words: Value = serde_json::from_str(&line).with_context(|| line.clone())?;
        ensure!(words[0] == what, "{words} instead of {what}");
        Ok(words[1].clone())
    }

    /// Sends an order and returns the answer.
    pub fn send_order(&mut self, order: &str) -> anyhow::Result<Value> {
        writeln!(self.orders, "{order}")?;
        self.read_answer(order.split(' ').next().unwrap_or_default())
    }

    /// Kills it with SIGKILL.
    pub fn kill(mut self) -> anyhow::Result<()> {
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }
}

impl Drop for RobotProgram {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
