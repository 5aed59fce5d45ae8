//! Records in a servant's directory: from the daemon to its shim, and from the shim to later daemons.
//!
//! | file | written by | content |
//! |---|---|---|
//! | `spec.json` | daemon, before the shim starts | [`LaunchRecord`] |
//! | `runtime.json` | shim, first thing | [`RuntimeRecord`]: what to end and remove if the shim cannot |
//! | `shim.sock` | shim | socket for daemons |
//! | `log.jsonl`, `log.jsonl.1` | shim | output of the nodes; moved by the daemon if it is kept |
//! | `shim.log` | shim | its own error messages |
//! | `exit.json` | shim, last thing | [`ExitRecord`] |
//! | `daemon.json` | daemon, while it runs | state for the next daemon ([`LocalServant::save_handover`]) |
//!
//! [`LocalServant::save_handover`]: crate::local::LocalServant::save_handover

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::Error;
use crate::cgroup::{Cgroup, CgroupParent};
use crate::container::{ContainerSpec, Profile};
use crate::engine::ContainerState;
use crate::process::ProcessIdentity;
use crate::protocol::NodeStatus;
use crate::quotas::Quotas;
use crate::spec::Limits;

/// File of the [`LaunchRecord`].
pub const SPEC: &str = "spec.json";
/// File of the [`RuntimeRecord`].
pub const RUNTIME: &str = "runtime.json";
/// File of the [`ExitRecord`].
pub const EXIT: &str = "exit.json";
/// File of a daemon's state for the next one.
pub const DAEMON: &str = "daemon.json";
/// Socket of the shim.
pub const SOCKET: &str = "shim.sock";
/// Standard error of the shim.
pub const SHIM_LOG: &str = "shim.log";

/// Cores that a shim may use, however few its servant has.
const SHIM_CPUS: f64 = 0.1;

/// Policy for servants some of whose limits cannot be enforced.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Isolation {
    /// Refuse to start if any limit cannot be put in force.
    #[default]
    Require,
    /// Start, and report the limits that are not in force.
    BestEffort,
}

/// Time for nodes to end by themselves.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct GracePeriods {
    /// Time from SIGINT to SIGTERM.
    pub interrupt: Duration,
    /// Time from SIGTERM to SIGKILL.
    pub terminate: Duration,
}

impl Default for GracePeriods {
    fn default() -> Self {
        Self { interrupt: Duration::from_secs(3), terminate: Duration::from_secs(2) }
    }
}

/// Everything a shim needs to know.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct LaunchRecord {
    /// Description of the container, with the engine's default limits filled in.
    pub spec: ContainerSpec,
    /// First host uid and number of uids.
    pub uid_range: (u32, u32),
    /// Parent of its cgroup.
    pub parent: CgroupParent,
    /// Limits of the shim itself; its processor time is also bounded by its servant's.
    #[serde(default)]
    pub shim_limits: Limits,
    /// Bounds on what a servant writes.
    #[serde(default)]
    pub quotas: Quotas,
    /// Isolation policy.
    pub isolation: Isolation,
    /// Time for nodes to end by themselves.
    pub grace: GracePeriods,
    /// Path of the static init.
    pub init: PathBuf,
}

impl LaunchRecord {
    /// Returns the bounds on what this container writes.
    pub(crate) fn quotas(&self) -> Quotas {
        match self.spec.profile {
            Profile::Servant => self.quotas,
            Profile::Compile | Profile::Install => Quotas::for_build(),
        }
    }

    /// Returns the limits of the shim of a servant with these limits.
    pub fn shim_limits_for(&self, servant: &Limits) -> Limits {
        // The Master must be able to answer at all.
        let most = servant.cpus.map(|cpus| cpus.max(SHIM_CPUS));
        let cpus = self.shim_limits.cpus.into_iter().chain(most);
        Limits { cpus: cpus.reduce(f64::min), ..self.shim_limits }
    }
}

/// Resources to end and remove if a shim was killed.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct RuntimeRecord {
    /// Identity of the shim.
    pub shim: ProcessIdentity,
    /// Cgroup of the servant.
    pub cgroup: Cgroup,
    /// Cgroup of the shim; `None` if an earlier version started it.
    #[serde(default)]
    pub shim_cgroup: Option<Cgroup>,
    /// First host uid and number of uids.
    pub uid_range: (u32, u32),
}

/// Final record of a servant.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ExitRecord {
    /// Final state.
    pub state: ContainerState,
    /// Nodes by name.
    pub nodes: BTreeMap<String, NodeStatus>,
}

/// Reads a record; `None` if the file does not exist.
pub fn read_record<T: DeserializeOwned>(path: &Path) -> Result<Option<T>, Error> {
    let text = match fs::read(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        result => result.map_err(Error::file("read", path))?,
    };
    let value = serde_json::from_slice(&text);
    value.map(Some).map_err(|error| Error::Malformed { path: path.into(), reason: error.to_string() })
}

/// Writes a record atomically.
pub fn write_record<T: Serialize>(path: &Path, value: &T) -> Result<(), Error> {
    let text =
        serde_json::to_vec(value).map_err(|error| Error::Malformed { path: path.into(), reason: error.to_string() })?;
    let half = path.with_extension("half");
    // The record may contain an environment with secrets.
    let mut options = fs::File::options();
    options.write(true).create(true).truncate(true).mode(0o600);
    let mut file = options.open(&half).map_err(Error::file("make", &half))?;
    file.write_all(&text).map_err(Error::file("write", &half))?;
    fs::rename(&half, path).map_err(Error::file("write", path))
}
