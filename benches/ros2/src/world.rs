//! A network that nobody else is in, with a /dev/shm of its own, as a servant has it; and the programs that are run there.

use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

/// What holds the namespaces; it ends when its standard input does, so that none outlives this program.
const HOLD: &str = "ip link set lo up && mount -t tmpfs none /dev/shm && echo '{}' && exec cat";
/// Where rclpy is.
pub(crate) const PREFIX: &str = "CLOUDROID_ROS2_PREFIX";
/// Most that is asked for takes milliseconds; what takes longer says how long.
const PATIENCE: Duration = Duration::from_secs(30);

/// How rclpy's nodes reach each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Transport {
    /// As they come: by shared memory where they can, else by UDP.
    Stock,
    /// By UDP alone.
    Udp,
}

/// On which cores programs run. A robot and a server are two machines, whose programs never share a core. Where the kernel chooses, two
/// programs that answer each other are on one core or on two by chance, and a way then takes twice or half of what it took before.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Host {
    /// The first core that this program may use.
    Robot,
    /// All others.
    Server,
}

impl Host {
    /// As `taskset` takes them; none where there is only one.
    fn cores(self) -> Result<Option<String>> {
        let allowed = nix::sched::sched_getaffinity(nix::unistd::Pid::from_raw(0))?;
        let is_allowed = |core: &usize| allowed.is_set(*core).unwrap_or_default();
        let mut cores = (0..nix::sched::CpuSet::count()).filter(is_allowed);
        let first = cores.next().map(|core| core.to_string());
        let others: Vec<String> = cores.map(|core| core.to_string()).collect();
        Ok(match self {
            _ if others.is_empty() => None,
            Self::Robot => first,
            Self::Server => Some(others.join(",")),
        })
    }
}

/// Both namespaces.
pub(crate) struct World {
    holder: Program,
    cores: Option<String>,
}

impl World {
    /// New ones, with `lo` up.
    pub(crate) fn new() -> Result<Self> {
        let mut holder = Command::new("unshare");
        holder.args(["--net", "--mount", "sh", "-c", HOLD]);
        Ok(Self {
            holder: Program::start(holder, "a network namespace")?,
            cores: None,
        })
    }

    /// Where what is started from now on runs.
    pub(crate) fn place(&mut self, host: Host) -> Result<()> {
        self.cores = host.cores()?;
        Ok(())
    }

    /// What a program's words are added to that is to run there.
    pub(crate) fn inside(&self) -> Command {
        let mut command = Command::new("nsenter");
        for (option, file) in [("net", "net"), ("mount", "mnt")] {
            command.arg(format!("--{option}=/proc/{}/ns/{file}", self.holder.pid()));
        }
        command.arg("--");
        if let Some(cores) = &self.cores {
            command.args(["taskset", "--cpu-list", cores]);
        }
        command
    }

    /// Runs a role of this program (see `roles.rs`).
    pub(crate) fn ours(&self, words: &[&str]) -> Result<Program> {
        let mut command = self.inside();
        command
            .arg(std::env::current_exe()?)
            .arg("inside")
            .args(words);
        Program::start(command, &format!("ours, {}", words.join(" ")))
    }

    /// Runs a role of `peer.py`.
    pub(crate) fn rclpy(&self, transport: Transport, words: &[&str]) -> Result<Program> {
        let mut command = self.inside();
        command
            .arg(python()?)
            .arg(bench_report::root().join("benches/ros2/peer.py"))
            .args(words);
        // Only its errors: a node that starts warns of what is left of others.
        command
            .env("RCUTILS_LOGGING_SEVERITY_THRESHOLD", "40")
            .env("ROS_DOMAIN_ID", "0");
        if transport == Transport::Udp {
            command.env("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4");
        }
        Program::start(command, &format!("rclpy, {}", words.join(" ")))
    }
}

/// Where the wheels are (`scripts/ros2-wheels`).
pub(crate) fn prefix() -> Result<PathBuf> {
    let prefix = std::env::var_os(PREFIX).map(PathBuf::from);
    prefix.with_context(|| format!("{PREFIX} is not set; make bench sets it"))
}

/// The Python that has rclpy.
pub(crate) fn python() -> Result<PathBuf> {
    let python = prefix()?.join("bin/python");
    ensure!(
        python.exists(),
        "{} is missing: run scripts/ros2-wheels",
        python.display()
    );
    Ok(python)
}

/// A program that answers in lines of JSON; the first says that it is ready. It is killed when this is dropped.
pub(crate) struct Program {
    name: String,
    child: Child,
    lines: Receiver<String>,
}

impl Program {
    fn start(mut command: Command, name: &str) -> Result<Self> {
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command
            .spawn()
            .with_context(|| format!("starting {name}"))?;
        let (sender, lines) = channel();
        let output = child.stdout.take().context("its output")?;
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    break;
                }
            }
        });
        let mut program = Self {
            name: name.to_owned(),
            child,
            lines,
        };
        program.answer()?;
        Ok(program)
    }

    /// A program that says nothing that is for us.
    pub(crate) fn start_quietly(mut command: Command, name: &str) -> Result<Self> {
        command.stdin(Stdio::piped()).stdout(Stdio::null());
        let child = command
            .spawn()
            .with_context(|| format!("starting {name}"))?;
        let (_, lines) = channel();
        Ok(Self {
            name: name.to_owned(),
            child,
            lines,
        })
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Its next line.
    pub(crate) fn answer(&mut self) -> Result<Value> {
        self.answer_within(PATIENCE)
    }

    /// Its next line, which may take so long.
    pub(crate) fn answer_within(&mut self, patience: Duration) -> Result<Value> {
        let name = &self.name;
        match self.lines.recv_timeout(patience) {
            Ok(line) => serde_json::from_str(&line).with_context(|| format!("{name} says {line}")),
            Err(RecvTimeoutError::Timeout) => bail!("{name} says nothing for {patience:?}"),
            Err(RecvTimeoutError::Disconnected) => {
                bail!("{name} has ended: {:?}", self.child.try_wait())
            }
        }
    }

    /// Asks it what it has found so far.
    pub(crate) fn tell(&mut self) -> Result<Value> {
        let input = self.child.stdin.as_mut().context("its input")?;
        input
            .write_all(b"\n")
            .with_context(|| format!("asking {}", self.name))?;
        self.answer()
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A number of an answer.
pub(crate) fn number(answer: &Value, name: &str) -> Result<f64> {
    answer[name]
        .as_f64()
        .with_context(|| format!("{name} is no number in {answer}"))
}
