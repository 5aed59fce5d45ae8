//! A robot is simulated by a sandbox on this machine: a cgroup with little processor time and memory, in a network
//! namespace whose only connection is a cable with the delay, rate and loss of a network. The cloud is the rest of the
//! machine.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use serde::{Deserialize, Serialize};
use servant::cgroup::{Cgroup, CgroupParent};
use servant::container::{ContainerSpec, Profile};
use servant::spec::{Limits, Size};
use support::cable::{self, Cable};

use crate::deadline;
pub use crate::network::NetworkProfile;
use crate::robot::RobotPlan;
use crate::trace::Trace;

/// Maximum time for the kernel to end the processes of a sandbox.
const END: Duration = Duration::from_secs(20);
const GIB: u64 = 1 << 30;
/// Response to a robot that requested another network.
const DONE: &str = "done";

/// A class of robot computers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RobotHardware {
    pub cores: f64,
    /// Memory in bytes.
    pub memory: u64,
}

impl RobotHardware {
    /// A Raspberry Pi: a quarter of a core and 1 GiB.
    pub const PI: Self = Self { cores: 0.25, memory: GIB };
    /// An ultrabook: half a core and 4 GiB.
    pub const ULTRABOOK: Self = Self { cores: 0.5, memory: 4 * GIB };

    pub fn name(self) -> &'static str {
        if self == Self::PI { "Pi" } else { "ultrabook" }
    }
}

/// Resources used by a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RunCost {
    /// Processor time of all processes on the robot, in seconds.
    pub robot_cpu: f64,
    pub sent: u64,
    pub received: u64,
    /// Number of the robot's processes that the kernel's OOM killer ended.
    pub killed_for_memory: u64,
    pub network: String,
}

/// The sandbox of a robot. Its processes end on drop.
pub struct RobotSandbox {
    cable: Cable,
    cgroup: Cgroup,
}

impl RobotSandbox {
    /// Creates a sandbox, and checks that its limits are in force.
    pub fn new(portal: &str, class: RobotHardware, network: NetworkProfile) -> Result<Self> {
        let cable = Cable::with_robot_inside(portal).context("the robot's network")?;
        cable.degrade(network.rules())?;
        let parent = CgroupParent::find().context("control groups, which a robot's place needs")?;
        ensure!(
            parent.version != 0,
            "no control groups can be made here ({}): a robot's place needs their limits; run it as root where they \
             are delegated",
            parent.reason
        );
        let limits = Limits { cpus: Some(class.cores), memory: Some(Size(class.memory)), ..Limits::default() };
        let name = cable.namespace();
        let name = name.file_name().and_then(|name| name.to_str());
        let cgroup = Cgroup::for_servant(&parent, &spec(name.unwrap_or("robot"), &limits));
        cgroup.create().context("control groups, which a robot's place needs")?;
        let place = Self { cable, cgroup };
        let now = place.cgroup.set_limits(&limits).limits;
        let cores = now.cpus.unwrap_or(f64::INFINITY);
        ensure!(
            (cores - class.cores).abs() < 0.01 && now.memory == Some(Size(class.memory)),
            "the limits of a robot are not in force here: asked for {} cores and {} bytes, the kernel says {:?} and \
             {:?}",
            class.cores,
            class.memory,
            now.cpus,
            now.memory
        );
        Ok(place)
    }

    /// Returns the server's address for a stub on this robot.
    pub fn server(&self) -> String {
        format!("ws://{}", self.cable.server)
    }

    /// Returns how many of the robot's processes the kernel's OOM killer has ended.
    pub fn killed_for_memory(&self) -> u64 {
        self.cgroup.oom_kills()
    }

    /// Runs a robot in the sandbox to its end.
    ///
    /// # Errors
    /// If the robot was killed (by a signal, or by the kernel for lack of memory), reports why it cannot continue, or
    /// exceeds the time limit of its plan.
    pub fn run(&self, plan: &RobotPlan, directory: &Path) -> Result<(Trace, RunCost)> {
        let [order, answer, log] = ["plan.json", "trace.json", "log"].map(|name| directory.join(name));
        let plan = RobotPlan { server: self.server(), ..plan.clone() };
        std::fs::write(&order, serde_json::to_vec(&(&plan, &self.cgroup))?)?;
        let begun = (self.cgroup.usage(), self.cable.transferred_bytes()?);
        let said = File::create(&log)?;
        let mut child = Command::new("nsenter")
            .arg(format!("--net={}", self.cable.namespace().display()))
            .arg("--")
            // Through the process, because the file may have been replaced meanwhile.
            .arg(format!("/proc/{}/exe", std::process::id()))
            .arg("robot")
            .args([&order, &answer])
            // Leftovers of a killed robot are removed together with the run's directory.
            .env("TMPDIR", directory)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(said)
            .spawn()
            .context("nsenter, of util-linux")?;
        let (wishes, answers) = (child.stdout.take(), child.stdin.take());
        let ended = std::thread::scope(|scope| {
            if let (Some(wishes), Some(answers)) = (wishes, answers) {
                scope.spawn(|| self.serve_network_changes(BufReader::new(wishes), answers));
            }
            wait_for_robot(&mut child, Duration::from_secs_f64(plan.patience))
        });
        let killed = self.cgroup.oom_kills();
        if let Err(error) = ended {
            let said = std::fs::read_to_string(&log).unwrap_or_default();
            // Also ends processes that the robot has started.
            for pid in self.cgroup.processes() {
                let _ = nix::sys::signal::kill(nix::unistd::Pid::from_raw(pid), nix::sys::signal::Signal::SIGKILL);
            }
            let memory = if killed > 0 { "; the kernel has ended a process of it for want of memory" } else { "" };
            bail!("{error:#}{memory}; its last words: {}", output_tail(&said));
        }
        let trace = serde_json::from_slice(&std::fs::read(&answer)?)?;
        let (usage, carried) = (self.cgroup.usage(), self.cable.transferred_bytes()?);
        let cost = RunCost {
            robot_cpu: (usage.cpu_usec - begun.0.cpu_usec) as f64 / 1e6,
            sent: carried.0 - begun.1.0,
            received: carried.1 - begun.1.1,
            killed_for_memory: killed,
            network: self.cable.mechanism().to_owned(),
        };
        Ok((trace, cost))
    }

    /// Changes the network as the robot requests in lines of its output, until that ends, and confirms each change. A
    /// robot that gets no confirmation does not continue.
    fn serve_network_changes(&self, wishes: impl BufRead, mut answers: impl Write) {
        for line in wishes.lines().map_while(Result::ok) {
            let Ok(network) = serde_json::from_str::<NetworkProfile>(&line) else {
                eprintln!("the robot said: {line}");
                continue;
            };
            // Packets queued in the old network are lost with it, as when a robot changes its access point.
            let made = self.cable.restore();
            let made = made.and_then(|()| self.cable.degrade(network.rules()));
            if let Err(error) = made {
                eprintln!("the network cannot be changed: {error:#}");
                return;
            }
            if writeln!(answers, "{DONE}").is_err() {
                return;
            }
        }
    }
}

/// Requests another network, on the robot's side; returns once it is in place.
pub fn request_network(network: NetworkProfile) -> Result<()> {
    println!("{}", serde_json::to_string(&network)?);
    let mut answer = String::new();
    std::io::stdin().read_line(&mut answer)?;
    ensure!(answer.trim() == DONE, "the network could not be changed");
    Ok(())
}

impl Drop for RobotSandbox {
    fn drop(&mut self) {
        if let Err(error) = self.cgroup.destroy(END) {
            eprintln!("the robot's control group is left: {error}");
        }
    }
}

/// Removes sandboxes of processes that no longer exist; returns a line for each.
pub fn remove_abandoned() -> Vec<String> {
    let Ok(parent) = CgroupParent::find() else {
        return Vec::new();
    };
    let mut told = Vec::new();
    for name in cable::find_abandoned() {
        let cgroup = Cgroup::for_servant(&parent, &spec(&name, &Limits::default()));
        let removed = cgroup.destroy(END).map_err(anyhow::Error::from);
        told.push(match removed.and_then(|()| cable::remove_namespace(&name)) {
            Ok(()) => format!("the robot's place {name}: taken away"),
            Err(error) => format!("the robot's place {name} is left: {error:#}"),
        });
    }
    told
}

fn wait_for_robot(child: &mut Child, patience: Duration) -> Result<()> {
    let status = deadline::wait_for_exit(child, "the robot", patience)?;
    match status.signal() {
        Some(signal) => bail!("the robot's place was ended by signal {signal}"),
        None if !status.success() => bail!("the robot could not go on ({status})"),
        None => Ok(()),
    }
}

fn output_tail(said: &str) -> String {
    let lines: Vec<&str> = said.lines().filter(|line| !line.trim().is_empty()).collect();
    let from = lines.len().saturating_sub(6);
    lines[from..].join(" | ")
}

fn spec(id: &str, limits: &Limits) -> ContainerSpec {
    ContainerSpec {
        id: id.to_owned(),
        layers: Vec::new(),
        writable: None,
        profile: Profile::Servant,
        limits: *limits,
        environment: BTreeMap::new(),
        nodes: Vec::new(),
        owned_directories: Vec::new(),
        mounts: Vec::new(),
        hosts: Vec::new(),
        resident: serde_json::Value::Null,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_network_is_told_by_its_rules() {
        assert_eq!(NetworkProfile::Lan.describe(), "1 ms each way, 100 Mbit/s");
        assert_eq!(NetworkProfile::Wifi.describe(), "5 ms each way, more or less 4 ms, 40 Mbit/s, 1 % of packets lost");
        assert!((NetworkProfile::Bad.transfer_time(250_000) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_robot_that_is_killed_is_named() {
        let mut child = Command::new("sleep").arg("60").spawn().expect("sleep");
        child.kill().expect("it is ours");
        let error = wait_for_robot(&mut child, END).expect_err("it was killed");
        assert!(error.to_string().contains("signal 9"), "{error}");
    }

    #[test]
    fn last_words_are_one_line() {
        let said = "1\n2\n\n3\n4\n5\n6\n7\n";
        assert_eq!(output_tail(said), "2 | 3 | 4 | 5 | 6 | 7");
    }
}
