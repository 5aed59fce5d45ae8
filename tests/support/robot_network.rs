//! A robot's own network: its computer and another machine of its, on which its application runs.
//!
//! ```text
//!  portal ══ a cable ══ the robot's computer, 10.77.0.1 ── virtual cards ── the other machine, 10.77.0.2
//! ```
//! Both are network namespaces.

use std::io::{BufRead, BufReader, Write};
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};

use anyhow::{Context, ensure};
use serde_json::Value;

use crate::binaries;
use crate::cable::{Cable, ip, within};
use crate::patience;
use crate::ros_system::Domain;
use crate::site::Site;

/// The other machine.
pub const OTHER: Ipv4Addr = Ipv4Addr::new(10, 77, 0, 2);
/// `ROS_DOMAIN_ID` of all.
const DOMAIN: u16 = 7;
/// What the two are joined by is called so on both.
const CARD: &str = "lan";
/// A discovery server that is a node of Fast DDS.
const SERVER: &str = "src/reach/tests/ros2/server.py";
/// Programs of one machine have shared memory of their own, of which nothing stays: names of it are those of ports, which others have, too.
const WITHIN: &str = r#"mount -t tmpfs shm /dev/shm && exec "$@""#;

/// It is taken down when dropped.
pub struct RobotNetwork {
    cable: Cable,
    robot: String,
    other: String,
    servers: Option<String>,
}

impl RobotNetwork {
    /// One whose programs find each other by multicast.
    pub fn new(portal: &str) -> anyhow::Result<Self> {
        Self::with(portal, None)
    }

    /// One whose programs find each other by a discovery server, which is to be on the other machine.
    pub fn of_server(portal: &str) -> anyhow::Result<Self> {
        Self::with(portal, Some(format!("{OTHER}:11811")))
    }

    fn with(portal: &str, servers: Option<String>) -> anyhow::Result<Self> {
        let cable = Cable::with_robot_inside(portal)?;
        let robot = cable.namespace();
        let robot = robot.file_name().and_then(|name| name.to_str());
        let robot = robot.context("a name")?.to_owned();
        let other = format!("{robot}-other");
        ip(&["netns", "add", &other])?;
        let network = Self {
            cable,
            robot,
            other,
            servers,
        };
        network.lay()?;
        Ok(network)
    }

    fn lay(&self) -> anyhow::Result<()> {
        let [robot, other] = [&*self.robot, &*self.other];
        ip(&[
            "-n", robot, "link", "add", CARD, "type", "veth", "peer", "name", CARD, "netns", other,
        ])?;
        ip(&["-n", other, "link", "set", "lo", "up"])?;
        for (machine, address) in [(robot, "10.77.0.1/24"), (other, "10.77.0.2/24")] {
            ip(&["-n", machine, "addr", "add", address, "dev", CARD])?;
            ip(&["-n", machine, "link", "set", CARD, "up"])?;
        }
        for machine in [robot, other] {
            carries(machine)?;
        }
        Ok(())
    }

    /// Where the robot reaches the portal.
    pub fn portal(&self) -> SocketAddr {
        self.cable.server
    }

    fn domain(&self) -> Domain {
        Domain::of_network(DOMAIN, self.servers.as_deref())
    }

    /// The robot's computer.
    pub fn robot(&self) -> anyhow::Result<Site> {
        Site::inside(self.cable.namespace(), self.domain())
    }

    fn other(&self) -> PathBuf {
        Path::new("/run/netns").join(&self.other)
    }

    /// Starts a program of `tests/robots` on the other machine.
    pub fn application(&self, program: &str, arguments: &[&str]) -> anyhow::Result<Application> {
        let mut command = python(&Path::new("tests/robots").join(program));
        command.args(arguments);
        self.domain().is_of(&mut command);
        Application::starts(command, &self.other())
    }

    /// Starts the discovery server.
    pub fn server(&self) -> anyhow::Result<Application> {
        let mut command = python(Path::new(SERVER));
        command.args(["0", &OTHER.to_string()]);
        Domain::of_network(DOMAIN, None).is_of(&mut command);
        Application::starts(command, &self.other())
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

/// Waits until the kernel says that a card carries, up to a second later: Fast DDS uses none for which it does not, and looks once.
fn carries(machine: &str) -> anyhow::Result<()> {
    crate::until("a network", || {
        let mut command = Command::new("ip");
        command.args(["-n", machine, "-brief", "link", "show", CARD]);
        let told = String::from_utf8(command.output()?.stdout)?;
        let is_up = told.split_whitespace().nth(1) == Some("UP");
        Ok(if is_up { Ok(()) } else { Err(told) })
    })
}

/// A program that takes orders as lines and answers by lines of JSON, `[ORDER, ANSWER]`; the first is `["ready"]`.
pub struct Application {
    child: Child,
    orders: ChildStdin,
    lines: Receiver<String>,
}

impl Application {
    /// Starts it; returns when it says that it is ready.
    fn starts(mut command: Command, namespace: &Path) -> anyhow::Result<Self> {
        patience::tell_patience(&mut command)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped());
        let mut child = within(namespace, || command.spawn())?.context("starting a program")?;
        let (said, lines) = channel();
        let output = child.stdout.take().context("its output")?;
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                let _ = said.send(line);
            }
        });
        let application = Self {
            orders: child.stdin.take().context("its input")?,
            child,
            lines,
        };
        application.hears("ready")?;
        Ok(application)
    }

    fn hears(&self, what: &str) -> anyhow::Result<Value> {
        let line = patience::receive(&self.lines);
        let line = line.with_context(|| format!("an application should say {what}"))?;
        let words: Value = serde_json::from_str(&line).with_context(|| line.clone())?;
        ensure!(words[0] == what, "{words} instead of {what}");
        Ok(words[1].clone())
    }

    /// Has it do something; its answer.
    pub fn does(&mut self, order: &str) -> anyhow::Result<Value> {
        writeln!(self.orders, "{order}")?;
        self.hears(order.split(' ').next().unwrap_or_default())
    }

    /// As by `kill -9`.
    pub fn is_killed(mut self) -> anyhow::Result<()> {
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }
}

impl Drop for Application {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
