//! What a container of this host is to be: extracted layers, a writable directory, mounts. The local engine makes it of a
//! [`Spec`](crate::spec::Spec); builds make it themselves. Serializable, because the shim that runs it is another process and
//! must be able to outlive the daemon: what an earlier version has written must stay readable.

use std::collections::BTreeMap;
use std::io;
use std::net::IpAddr;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::PathBuf;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::spec::{Limits, NodeSpec};

/// Everything that the shim needs to know of its container.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ContainerSpec {
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
