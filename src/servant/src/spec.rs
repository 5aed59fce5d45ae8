//! What a servant is to be: layers, limits, nodes. Serializable, because the shim that runs it is another
//! process and must be able to outlive the daemon.

use std::collections::BTreeMap;
use std::io;
use std::net::IpAddr;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::PathBuf;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

/// Everything the engine needs to know.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Spec {
    /// Unique on this host; `[a-z0-9-]`, at most 48 characters. Becomes the host name, the cgroup's and the
    /// state directory's name.
    pub id: String,
    /// Extracted layer trees, lowest first.
    pub layers: Vec<PathBuf>,
    /// Where changes go. A servant has none (read-only root); a build has a directory that becomes a layer.
    #[serde(default)]
    pub writable: Option<PathBuf>,
    /// Which rights its processes have.
    pub profile: Profile,
    /// Hard limits.
    #[serde(default)]
    pub limits: Limits,
    /// Environment of every process.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
    /// Processes to start, in order, once the container runs.
    #[serde(default)]
    pub nodes: Vec<NodeSpec>,
    /// Directories made in `writable` before the first process runs, owned by the compile user (1000:1000).
    #[serde(default)]
    pub owned_directories: Vec<PathBuf>,
    /// Extra mounts, such as model files.
    #[serde(default)]
    pub mounts: Vec<Mount>,
    /// Names that mean an address of its own loopback, for `/etc/hosts`.
    #[serde(default)]
    pub hosts: Vec<(IpAddr, String)>,
    /// Handed as it is to the shim's resident (the composed ROS Master): initial parameters and the like.
    #[serde(default)]
    pub resident: serde_json::Value,
}

/// Which rights a container has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Profile {
    /// Other people's code for a robot: no capabilities, seccomp allow-list, read-only root, tmpfs scratch.
    Servant,
    /// Compiling other people's code: as a servant, with a writable root, as uid 1000, without network.
    Compile,
    /// Installing packages (dpkg): CHOWN, DAC_OVERRIDE, FOWNER, FSETID, SETUID, SETGID, SETFCAP; without network.
    Install,
}

/// Hard limits; none means the engine's default.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Limits {
    /// Cores, such as 1.5.
    pub cpus: Option<f64>,
    /// Relative share when cores are scarce, 1..10000, 100 by default (`cpu.weight`).
    pub cpu_weight: Option<u64>,
    /// Bytes of memory, swap not included (`memory.max`; there is no swap). A servant that needs more is killed, whole.
    pub memory: Option<u64>,
    /// Bytes of memory above which it is slowed down and made to give back (`memory.high`; v2 only).
    pub memory_high: Option<u64>,
    /// Processes and threads.
    pub pids: Option<u64>,
    /// Bytes a second read from the disk that holds the layers (`io.max`).
    pub io_read: Option<u64>,
    /// Bytes a second written to it.
    pub io_write: Option<u64>,
    /// On which cores it may run, bit n of word n / 64 for core n (`cpuset.cpus`).
    pub cpuset: Option<[u64; 4]>,
}

impl Limits {
    /// These, with `default` where nothing is said.
    pub fn or(self, default: &Self) -> Self {
        Self {
            cpus: self.cpus.or(default.cpus),
            cpu_weight: self.cpu_weight.or(default.cpu_weight),
            memory: self.memory.or(default.memory),
            memory_high: self.memory_high.or(default.memory_high),
            pids: self.pids.or(default.pids),
            io_read: self.io_read.or(default.io_read),
            io_write: self.io_write.or(default.io_write),
            cpuset: self.cpuset.or(default.cpuset),
        }
    }
}

/// One process to run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeSpec {
    /// Its name in logs and events, such as `/people_detect`. Unique within the servant.
    pub name: String,
    /// Absolute path of the executable inside, then its arguments.
    pub argv: Vec<String>,
    /// Added to the servant's environment.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
    /// Working directory inside; `/` when empty.
    #[serde(default)]
    pub directory: String,
    /// Start it again when it ends, whatever its status (roslaunch's `respawn`).
    #[serde(default)]
    pub respawn: bool,
    /// Seconds before that.
    #[serde(default)]
    pub respawn_delay: f64,
    /// When it ends the whole servant ends (roslaunch's `required`).
    #[serde(default)]
    pub required: bool,
}

/// A bind mount.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Mount {
    /// On the host.
    pub source: PathBuf,
    /// Inside; absolute.
    pub target: PathBuf,
    /// Whether processes may write there.
    pub writable: bool,
    /// It is a device node, to be used as such; elsewhere device nodes are dead.
    #[serde(default)]
    pub device: bool,
    /// What is mounted, whatever is found at `source` by then; without it `source` is looked up when the servant is made.
    #[serde(skip)]
    pub opened: Option<Opened>,
}

impl Mount {
    /// Whether it is a directory.
    pub(crate) fn is_directory(&self) -> io::Result<bool> {
        let mode = match &self.opened {
            Some(opened) => nix::sys::stat::fstat(opened.as_fd())?.st_mode,
            None => return Ok(std::fs::metadata(&self.source)?.is_dir()),
        };
        Ok(mode & libc::S_IFMT == libc::S_IFDIR)
    }
}

/// A file or directory that was opened (O_PATH is enough), to be mounted. Two are equal when they are the same descriptor.
#[derive(Debug, Clone)]
pub struct Opened(Arc<OwnedFd>);

impl Opened {
    /// Takes the descriptor.
    pub fn new(descriptor: OwnedFd) -> Self {
        Self(Arc::new(descriptor))
    }
}

impl AsFd for Opened {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

impl PartialEq for Opened {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}
