//! The robot is a place on this machine: a control group with little processor time and memory, in a network namespace whose only way
//! out is a cable with the delay, the rate and the losses of a network. The cloud is the rest of the machine.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use serde::{Deserialize, Serialize};
use servant::cgroup::{Cgroup, Parent};
use servant::container::{ContainerSpec, Profile};
use servant::spec::Limits;
use support::cable::{Badness, Cable};

use crate::robot::Plan;
use crate::trace::Trace;
use crate::{interrupt, sweep};

/// How long the kernel may take to end what runs in a place.
const END: Duration = Duration::from_secs(20);
/// Between two looks at whether the robot has ended.
const LOOK: Duration = Duration::from_millis(50);
const GIB: u64 = 1 << 30;
/// The answer to a robot that asked for another network.
const DONE: &str = "done";

/// A kind of robot computer.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Class {
    /// Cores of this machine.
    pub cores: f64,
    /// Bytes.
    pub memory: u64,
}

impl Class {
    /// A quarter of a core and 1 GiB.
    pub const PI: Self = Self {
        cores: 0.25,
        memory: GIB,
    };
    /// Half a core and 4 GiB.
    pub const ULTRABOOK: Self = Self {
        cores: 0.5,
        memory: 4 * GIB,
    };

    /// As tables name it.
    pub fn name(self) -> &'static str {
        if self == Self::PI { "Pi" } else { "ultrabook" }
    }
}

/// Between a robot and the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Network {
    /// 1 ms each way, 100 Mbit/s.
    Lan,
    /// 30 ms each way, 20 Mbit/s.
    Wan,
    /// 5 ms each way, more or less 4 ms, 40 Mbit/s, one packet in a hundred is lost.
    Wifi,
    /// 100 ms each way, 2 Mbit/s, one packet in a hundred is lost: what the benchmark `failover` calls bad.
    Bad,
}

impl Network {
    /// Each of them.
    pub const ALL: [Self; 4] = [Self::Lan, Self::Wan, Self::Wifi, Self::Bad];

    /// As tables name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Lan => "LAN",
            Self::Wan => "WAN",
            Self::Wifi => "Wi-Fi",
            Self::Bad => "bad",
        }
    }

    /// In each direction.
    pub fn rules(self) -> Badness {
        let (rate, delay, jitter, loss) = match self {
            Self::Lan => (100_000, 1, 0, 0.0),
            Self::Wan => (20_000, 30, 0, 0.0),
            Self::Wifi => (40_000, 5, 4, 0.01),
            Self::Bad => (2000, 100, 0, 0.01),
        };
        Badness {
            rate,
            delay,
            jitter,
            loss,
            limit: if self == Self::Bad { 100 } else { 1000 },
        }
    }

    /// Its rules in words.
    pub fn told(self) -> String {
        let rules = self.rules();
        let mut told = format!("{} ms each way", rules.delay);
        if rules.jitter > 0 {
            told += &format!(", more or less {} ms", rules.jitter);
        }
        told += &format!(", {} Mbit/s", f64::from(rules.rate) / 1e3);
        if rules.loss > 0.0 {
            told += &format!(", {} % of packets lost", rules.loss * 100.0);
        }
        told
    }

    /// Seconds that so many bytes take to be sent, at its rate.
    pub fn takes(self, bytes: usize) -> f64 {
        8.0 * bytes as f64 / (f64::from(self.rules().rate) * 1e3)
    }
}

/// What a run took beside what its robot saw.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// Processor time of everything on the robot, seconds.
    pub robot_cpu: f64,
    /// Bytes of packets from the robot.
    pub sent: u64,
    /// Bytes of packets to it.
    pub received: u64,
    /// Processes of the robot that the kernel has ended for want of memory.
    pub killed_for_memory: u64,
    /// What made the network what it was.
    pub network: String,
}

/// A robot's place. What is in it ends with it.
pub struct Place {
    /// Where the server is reached from inside.
    cable: Cable,
    cgroup: Cgroup,
    /// What runs in it: this very program, unless a test says otherwise.
    pub program: PathBuf,
}

impl Place {
    /// Makes one, and reads back that its limits are in force.
    pub fn new(portal: &str, class: Class, network: Network) -> Result<Self> {
        let cable = Cable::with_robot_inside(portal).context("the robot's network")?;
        cable.degrade(network.rules())?;
        let parent = Parent::find().context("control groups, which a robot's place needs")?;
        ensure!(
            parent.version != 0,
            "no control groups can be made here ({}): a robot's place needs their limits; run it as root where they are delegated",
            parent.reason
        );
        let limits = Limits {
            cpus: Some(class.cores),
            memory: Some(class.memory),
            ..Limits::default()
        };
        let name = cable.namespace();
        let name = name.file_name().and_then(|name| name.to_str());
        let cgroup = Cgroup::planned(&parent, &spec(name.unwrap_or("robot"), &limits));
        cgroup.create()?;
        let place = Self {
            cable,
            cgroup,
            // By the process: the file may have been replaced meanwhile.
            program: format!("/proc/{}/exe", std::process::id()).into(),
        };
        let now = place.cgroup.set(&limits).limits;
        let cores = now.cpus.unwrap_or(f64::INFINITY);
        ensure!(
            (cores - class.cores).abs() < 0.01 && now.memory == Some(class.memory),
            "the limits of a robot are not in force here: asked for {} cores and {} bytes, the kernel says {:?} and {:?}",
            class.cores,
            class.memory,
            now.cpus,
            now.memory
        );
        Ok(place)
    }

    /// Where a stub on this robot finds the server.
    pub fn server(&self) -> String {
        format!("ws://{}", self.cable.server)
    }

    /// Processes of the robot that the kernel has ended for want of memory.
    pub fn killed_for_memory(&self) -> u64 {
        self.cgroup.oom_kills()
    }

    /// Runs a robot in it to its end.
    ///
    /// # Errors
    /// The robot is lost (ended by a signal, or by the kernel for want of memory), says why it cannot go on, or takes longer than its
    /// plan has patience for.
    pub fn runs(&self, plan: &Plan, directory: &Path) -> Result<(Trace, Cost)> {
        let [order, answer, log] =
            ["plan.json", "trace.json", "log"].map(|name| directory.join(name));
        let plan = Plan {
            server: self.server(),
            ..plan.clone()
        };
        std::fs::write(&order, serde_json::to_vec(&(&plan, &self.cgroup))?)?;
        let begun = (self.cgroup.usage(), self.cable.carried()?);
        let said = File::create(&log)?;
        let mut child = Command::new("nsenter")
            .arg(format!("--net={}", self.cable.namespace().display()))
            .arg("--")
            .arg(&self.program)
            .arg("robot")
            .args([&order, &answer])
            // What a robot that is killed leaves goes with the run's directory.
            .env("TMPDIR", directory)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(said)
            .spawn()
            .context("nsenter, of util-linux")?;
        let (wishes, answers) = (child.stdout.take(), child.stdin.take());
        let ended = std::thread::scope(|scope| {
            if let (Some(wishes), Some(answers)) = (wishes, answers) {
                scope.spawn(|| self.changes(BufReader::new(wishes), answers));
            }
            waits(&mut child, Duration::from_secs_f64(plan.patience))
        });
        let killed = self.cgroup.oom_kills();
        if let Err(error) = ended {
            let said = std::fs::read_to_string(&log).unwrap_or_default();
            // Whatever it had started.
            for pid in self.cgroup.processes() {
                let _ = nix::sys::signal::kill(
                    nix::unistd::Pid::from_raw(pid),
                    nix::sys::signal::Signal::SIGKILL,
                );
            }
            let memory = if killed > 0 {
                "; the kernel has ended a process of it for want of memory"
            } else {
                ""
            };
            bail!("{error:#}{memory}; its last words: {}", last_words(&said));
        }
        let trace = serde_json::from_slice(&std::fs::read(&answer)?)?;
        let (usage, carried) = (self.cgroup.usage(), self.cable.carried()?);
        let cost = Cost {
            robot_cpu: (usage.cpu_usec - begun.0.cpu_usec) as f64 / 1e6,
            sent: carried.0 - begun.1.0,
            received: carried.1 - begun.1.1,
            killed_for_memory: killed,
            network: self.cable.means().to_owned(),
        };
        Ok((trace, cost))
    }

    /// Makes the network what the robot asks for in lines of its output, until that ends, and answers each when it is done. A robot
    /// that hears no answer goes no further.
    fn changes(&self, wishes: impl BufRead, mut answers: impl Write) {
        for line in wishes.lines().map_while(Result::ok) {
            let Ok(network) = serde_json::from_str::<Network>(&line) else {
                eprintln!("the robot said: {line}");
                continue;
            };
            // What waits in the network that was goes with it, as on a robot that changes its access point.
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

/// The robot's side of a wish for another network: returns when it is there.
pub fn asks_for(network: Network) -> Result<()> {
    println!("{}", serde_json::to_string(&network)?);
    let mut answer = String::new();
    std::io::stdin().read_line(&mut answer)?;
    ensure!(answer.trim() == DONE, "the network could not be changed");
    Ok(())
}

impl Drop for Place {
    fn drop(&mut self) {
        if let Err(error) = self.cgroup.destroy(END) {
            eprintln!("the robot's control group is left: {error}");
        }
    }
}

/// Takes away places of processes that are no more; tells which, each in a line.
pub fn sweep() -> Vec<String> {
    let Ok(parent) = Parent::find() else {
        return Vec::new();
    };
    let entries = std::fs::read_dir("/run/netns").into_iter().flatten();
    let names = entries
        .flatten()
        .filter_map(|entry| entry.file_name().into_string().ok());
    let mut told = Vec::new();
    for name in names {
        let Some((pid, number)) = owner(&name) else {
            continue;
        };
        if Path::new(&format!("/proc/{pid}")).exists() {
            continue;
        }
        let cgroup = Cgroup::planned(&parent, &spec(&name, &Limits::default()));
        if let Err(error) = cgroup.destroy(END) {
            told.push(format!("the robot's place {name} is left: {error}"));
            continue;
        }
        sweep::ip(&["link", "del", &format!("cr{pid}-{number}")]);
        sweep::ip(&["netns", "del", &name]);
        told.push(format!("the robot's place {name}: taken away"));
    }
    told
}

/// Of which process a namespace is, by its name, and its number there.
fn owner(name: &str) -> Option<(u32, u32)> {
    let (pid, number) = name.strip_prefix("cloudroid-cable-")?.split_once('-')?;
    Some((pid.parse().ok()?, number.parse().ok()?))
}

fn waits(child: &mut Child, patience: Duration) -> Result<()> {
    let deadline = Instant::now() + patience;
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if interrupt::asked() {
            let _ = child.kill();
            let _ = child.wait();
            bail!("the evaluation was asked to end while this was measured");
        }
        if Instant::now() > deadline {
            let _ = child.kill();
            let _ = child.wait();
            bail!(
                "the robot was not done after {:.0} s",
                patience.as_secs_f64()
            );
        }
        std::thread::sleep(LOOK);
    };
    match status.signal() {
        Some(signal) => bail!("the robot's place was ended by signal {signal}"),
        None if !status.success() => bail!("the robot could not go on ({status})"),
        None => Ok(()),
    }
}

/// The end of what it printed, in one line.
fn last_words(said: &str) -> String {
    let lines: Vec<&str> = said
        .lines()
        .filter(|line| !line.trim().is_empty())
        .collect();
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
        assert_eq!(Network::Lan.told(), "1 ms each way, 100 Mbit/s");
        assert_eq!(
            Network::Wifi.told(),
            "5 ms each way, more or less 4 ms, 40 Mbit/s, 1 % of packets lost"
        );
        assert!((Network::Bad.takes(250_000) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_robot_that_is_killed_is_named() {
        let mut child = Command::new("sleep").arg("60").spawn().expect("sleep");
        child.kill().expect("it is ours");
        let error = waits(&mut child, END).expect_err("it was killed");
        assert!(error.to_string().contains("signal 9"), "{error}");
    }

    #[test]
    fn a_robot_that_takes_too_long_is_ended() {
        let mut child = Command::new("sleep").arg("60").spawn().expect("sleep");
        let error = waits(&mut child, Duration::ZERO).expect_err("it takes a minute");
        assert!(error.to_string().contains("not done"), "{error}");
        assert!(child.try_wait().expect("it was waited for").is_some());
    }

    #[test]
    fn a_place_is_of_the_process_in_its_name() {
        assert_eq!(owner("cloudroid-cable-12-3"), Some((12, 3)));
        assert_eq!(owner("cloudroid-cable-12"), None);
        assert_eq!(owner("somebody's-12-3"), None);
    }

    #[test]
    fn last_words_are_one_line() {
        let said = "1\n2\n\n3\n4\n5\n6\n7\n";
        assert_eq!(last_words(said), "2 | 3 | 4 | 5 | 6 | 7");
    }
}
