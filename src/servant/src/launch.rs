//! What the daemon leaves in a servant's directory for its shim, and the shim for a later daemon.
//!
//! | file | written by | holds |
//! |---|---|---|
//! | `spec.json` | daemon, before the shim starts | [`Launch`] |
//! | `runtime.json` | shim, first thing | [`Runtime`]: what to end and remove when the shim cannot |
//! | `shim.sock` | shim | where a daemon connects |
//! | `log.jsonl`, `log.jsonl.1` | shim | what nodes printed |
//! | `shim.log` | shim | its own complaints |
//! | `exit.json` | shim, last thing | [`Exit`] |
//! | `daemon.json` | daemon, while it runs | what it has to tell the next daemon ([`crate::local::LocalServant::leave`]) |

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::Error;
use crate::cgroup::{Cgroup, Parent};
use crate::container::{ContainerSpec, Profile};
use crate::engine::ContainerState;
use crate::process::Identity;
use crate::protocol::NodeStatus;
use crate::quotas::Quotas;
use crate::spec::Limits;

/// [`Launch`]'s file.
pub const SPEC: &str = "spec.json";
/// [`Runtime`]'s file.
pub const RUNTIME: &str = "runtime.json";
/// [`Exit`]'s file.
pub const EXIT: &str = "exit.json";
/// What a daemon leaves for the next one.
pub const DAEMON: &str = "daemon.json";
/// The shim's socket.
pub const SOCKET: &str = "shim.sock";
/// The shim's standard error.
pub const SHIM_LOG: &str = "shim.log";

/// Cores that a shim may use, however few its servant has.
const SHIM_CPUS: f64 = 0.1;

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

/// Everything a shim needs to know.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Launch {
    /// With the engine's default limits filled in.
    pub spec: ContainerSpec,
    /// First host uid and how many.
    pub uid_range: (u32, u32),
    /// Where its cgroup is made.
    pub parent: Parent,
    /// The shim's own limits; of processor time it never has more than its servant.
    #[serde(default)]
    pub shim_limits: Limits,
    /// Bounds of what a servant writes.
    #[serde(default)]
    pub quotas: Quotas,
    /// Whether every limit must be in force.
    pub isolation: Isolation,
    /// How long nodes have to end.
    pub grace: Grace,
    /// The static init.
    pub init: PathBuf,
}

impl Launch {
    /// Bounds of what this container writes.
    pub(crate) fn quotas(&self) -> Quotas {
        match self.spec.profile {
            Profile::Servant => self.quotas,
            Profile::Compile | Profile::Install => Quotas::of_build(),
        }
    }

    /// What the shim may take beside a servant with these limits.
    pub fn limits_of_shim(&self, servant: &Limits) -> Limits {
        // The Master must be able to answer at all.
        let most = servant.cpus.map(|cpus| cpus.max(SHIM_CPUS));
        let cpus = self.shim_limits.cpus.into_iter().chain(most);
        Limits {
            cpus: cpus.reduce(f64::min),
            ..self.shim_limits
        }
    }
}

/// What is left when a shim is gone without a word.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Runtime {
    /// The shim.
    pub shim: Identity,
    /// The servant's cgroup.
    pub cgroup: Cgroup,
    /// The shim's own; none where an earlier version started it.
    #[serde(default)]
    pub shim_cgroup: Option<Cgroup>,
    /// First host uid and how many.
    pub uid_range: (u32, u32),
}

/// How a servant ended.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Exit {
    /// Its last state.
    pub state: ContainerState,
    /// Its nodes by name.
    pub nodes: BTreeMap<String, NodeStatus>,
}

/// Reads a file of ours; none when there is none.
pub fn read<T: DeserializeOwned>(path: &Path) -> Result<Option<T>, Error> {
    let text = match fs::read(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        result => result.map_err(Error::file("read", path))?,
    };
    let value = serde_json::from_slice(&text);
    value.map(Some).map_err(|error| Error::Malformed {
        path: path.into(),
        reason: error.to_string(),
    })
}

/// Writes a file of ours, whole or not at all.
pub fn write<T: Serialize>(path: &Path, value: &T) -> Result<(), Error> {
    let text = serde_json::to_vec(value).map_err(|error| Error::Malformed {
        path: path.into(),
        reason: error.to_string(),
    })?;
    let half = path.with_extension("half");
    // It may hold an environment, and with it secrets.
    let mut options = fs::File::options();
    options.write(true).create(true).truncate(true).mode(0o600);
    let mut file = options.open(&half).map_err(Error::file("make", &half))?;
    file.write_all(&text).map_err(Error::file("write", &half))?;
    fs::rename(&half, path).map_err(Error::file("write", path))
}
