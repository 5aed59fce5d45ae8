//! A private network with a /dev/shm of its own, like a servant's; and the programs that run in it.

use std::fmt;
use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

/// Script that holds the namespaces; it ends with its standard input, so that it does not outlive this program.
const HOLD: &str = "ip link set lo up && mount -t tmpfs none /dev/shm && echo '{}' && exec cat";
/// Environment variable with the location of rclpy.
pub(crate) const PREFIX: &str = "CLOUDROID_ROS2_PREFIX";
/// Default timeout; most requests take milliseconds, and slower ones pass a timeout of their own.
const PATIENCE: Duration = Duration::from_secs(30);

/// Transport between rclpy nodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Transport {
    /// Default settings: shared memory if possible, otherwise UDP.
    Stock,
    /// UDP only.
    Udp,
}

impl fmt::Display for Transport {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(if *self == Self::Stock { "shared memory" } else { "UDP" })
    }
}

/// Cores on which programs run. Robot and server never share one: if the kernel chose, the same path would take twice
/// or half as long by chance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Host {
    /// The first core that this program may use.
    Robot,
    /// All other cores.
    Server,
}

impl Host {
    /// Returns a CPU list for `taskset`; `None` if there is only one core.
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

/// A network and a mount namespace.
pub(crate) struct BenchNetwork {
    holder: BenchProgram,
    cores: Option<String>,
}

impl BenchNetwork {
    /// Creates the namespaces, with `lo` up.
    pub(crate) fn new() -> Result<Self> {
        let mut holder = Command::new("unshare");
        holder.args(["--net", "--mount", "sh", "-c", HOLD]);
        Ok(Self { holder: BenchProgram::start(holder, "a network namespace")?, cores: None })
    }

    /// Selects the cores for the programs that are started from now on.
    pub(crate) fn pin_to(&mut self, host: Host) -> Result<()> {
        self.cores = host.cores()?;
        Ok(())
    }

    /// Returns a command that runs a program in the namespaces; its words are appended.
    pub(crate) fn command(&self) -> Command {
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

    /// Starts a role of this program (see `roles.rs`).
    pub(crate) fn start_role(&self, words: &[&str]) -> Result<BenchProgram> {
        let mut command = self.command();
        command.arg(std::env::current_exe()?).arg("inside").args(words);
        BenchProgram::start(command, &format!("ours, {}", words.join(" ")))
    }

    /// Starts a role of `peer.py`.
    pub(crate) fn start_rclpy(&self, transport: Transport, words: &[&str]) -> Result<BenchProgram> {
        let mut command = self.command();
        command.arg(python_path()?).arg(bench_report::root().join("benches/ros2/peer.py")).args(words);
        // Errors only: a starting node warns about the leftovers of others.
        command.env("RCUTILS_LOGGING_SEVERITY_THRESHOLD", "40").env("ROS_DOMAIN_ID", "0");
        if transport == Transport::Udp {
            command.env("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4");
        }
        BenchProgram::start(command, &format!("rclpy, {}", words.join(" ")))
    }
}

/// Keeps the cores awake by loops of the lowest priority, as long as the result exists: waking a halted core of a
/// virtual machine takes longer than what is measured, and medians would differ by a factor of three.
pub(crate) fn keep_cores_awake() -> Result<Vec<BenchProgram>> {
    let one = |core: usize| {
        let mut command = Command::new("setpriv");
        command.args(["--pdeathsig", "KILL", "chrt", "--idle", "0", "sh", "-c", "while :; do :; done"]);
        BenchProgram::start_quietly(command, &format!("what keeps core {core} awake"))
    };
    (0..std::thread::available_parallelism()?.get()).map(one).collect()
}

/// Returns the directory of the wheels (`scripts/ros2-wheels`).
pub(crate) fn wheels_prefix() -> Result<PathBuf> {
    let prefix = std::env::var_os(PREFIX).map(PathBuf::from);
    prefix.with_context(|| format!("{PREFIX} is not set; make bench sets it"))
}

/// Returns the path of the Python that has rclpy.
pub(crate) fn python_path() -> Result<PathBuf> {
    let python = wheels_prefix()?.join("bin/python");
    ensure!(python.exists(), "{} is missing: run scripts/ros2-wheels", python.display());
    Ok(python)
}

/// A program that prints lines of JSON; the first line says that it is ready. It is killed on drop.
pub(crate) struct BenchProgram {
    name: String,
    child: Child,
    lines: Receiver<String>,
}

impl BenchProgram {
    fn start(mut command: Command, name: &str) -> Result<Self> {
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().with_context(|| format!("starting {name}"))?;
        let (sender, lines) = channel();
        let output = child.stdout.take().context("its output")?;
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    break;
                }
            }
        });
        let mut program = Self { name: name.to_owned(), child, lines };
        program.answer()?;
        Ok(program)
    }

    /// Starts a program whose output is ignored.
    pub(crate) fn start_quietly(mut command: Command, name: &str) -> Result<Self> {
        command.stdin(Stdio::piped()).stdout(Stdio::null());
        let child = command.spawn().with_context(|| format!("starting {name}"))?;
        let (_, lines) = channel();
        Ok(Self { name: name.to_owned(), child, lines })
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Returns its next line.
    pub(crate) fn answer(&mut self) -> Result<Value> {
        self.answer_within(PATIENCE)
    }

    /// Returns its next line, waiting for at most `patience`.
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

    /// Asks it for its results so far.
    pub(crate) fn request_answer(&mut self) -> Result<Value> {
        let input = self.child.stdin.as_mut().context("its input")?;
        input.write_all(b"\n").with_context(|| format!("asking {}", self.name))?;
        self.answer()
    }
}

impl Drop for BenchProgram {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Returns a number of an answer.
pub(crate) fn json_number(answer: &Value, name: &str) -> Result<f64> {
    answer[name].as_f64().with_context(|| format!("{name} is no number in {answer}"))
}
