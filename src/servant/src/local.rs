//! The engine of this host.

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use crate::spec::Limits;

/// Where each servant's uid range is taken from by default: 1879048192, the first of the 4094 ranges that systemd's
/// documentation of user ids lists as unused. Ranges for `/etc/subuid` grow from 100000, those of systemd-nspawn from
/// 524288; both would collide sooner or later with one that we picked among them.
pub const DEFAULT_UID_BASE: u32 = 0x7000_0000;

/// Whether a servant may run with less than was asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Isolation {
    /// Refuse to start when any limit cannot be put in force.
    #[default]
    Require,
    /// Start, and say what is not in force.
    BestEffort,
}

/// Below which cgroup servants live.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum CgroupParent {
    /// On v2 `cloudroid-servants.service` if it is there, otherwise what can be delegated; on v1 below our own in each
    /// hierarchy.
    #[default]
    Auto,
    /// This one, as seen from the root of the hierarchy (each hierarchy on v1), such as
    /// `/system.slice/cloudroid-servants.service`.
    Path(PathBuf),
}

/// How long the nodes have to end by themselves.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Grace {
    /// From SIGINT to SIGTERM.
    pub interrupt: Duration,
    /// From SIGTERM to SIGKILL.
    pub terminate: Duration,
}

impl Default for Grace {
    fn default() -> Self {
        Self {
            interrupt: Duration::from_secs(3),
            terminate: Duration::from_secs(2),
        }
    }
}

/// What the local engine needs to know.
#[derive(Debug, Clone)]
pub struct LocalEngineConfig {
    /// Where each servant has its directory; owned by this engine alone. Absolute.
    pub home_servants_dir: PathBuf,
    /// The program, and its arguments, that calls [`crate::shim::run`], such as `[/usr/bin/cloudroidd, shim]`.
    pub shim_command: Vec<OsString>,
    /// The static `cloudroid-init`.
    pub init: PathBuf,
    /// For what a spec leaves open.
    pub default_limits: Limits,
    /// First uid of the first range; see [`DEFAULT_UID_BASE`].
    pub uid_base: u32,
    /// Below which cgroup.
    pub cgroup_parent: CgroupParent,
    /// Whether less isolation than asked for is accepted.
    pub isolation: Isolation,
    /// How long nodes have to end when the servant is stopped.
    pub grace: Grace,
}

impl LocalEngineConfig {
    /// With defaults for everything else: 1 GiB of memory, 512 processes, no bound on cores.
    pub fn new(home_servants_dir: PathBuf, shim_command: Vec<OsString>, init: PathBuf) -> Self {
        Self {
            home_servants_dir,
            shim_command,
            init,
            default_limits: Limits {
                cpus: None,
                cpu_weight: None,
                memory: Some(1 << 30),
                pids: Some(512),
            },
            uid_base: DEFAULT_UID_BASE,
            cgroup_parent: CgroupParent::Auto,
            isolation: Isolation::Require,
            grace: Grace::default(),
        }
    }
}
