//! Description of a container on this host: extracted layers, a writable directory, mounts. The local engine creates it
//! from a [`Spec`](crate::spec::Spec); builds create it directly. Serializable, because the shim that runs it is
//! another process and can outlive the daemon: records written by earlier versions must stay readable.

use std::collections::BTreeMap;
use std::io;
use std::net::IpAddr;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::PathBuf;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::spec::{Limits, NodeSpec};

/// Everything that the shim needs to know about its container.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ContainerSpec {
    /// Id, unique on this host; `[a-z0-9-]`, at most 48 characters. Used as host name and as name of the cgroup and the
    /// state directory.
    pub id: String,
    /// Extracted layer trees, lowest first.
    pub layers: Vec<PathBuf>,
    /// Directory for changes. A servant has none (read-only root); that of a build becomes a layer.
    #[serde(default)]
    pub writable: Option<PathBuf>,
    /// Privileges of its processes.
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
    /// Directories to create in `writable` before the first process runs, owned by the compile user (1000:1000).
    #[serde(default)]
    pub owned_directories: Vec<PathBuf>,
    /// Extra mounts, such as model files.
    #[serde(default)]
    pub mounts: Vec<Mount>,
    /// Host names for `/etc/hosts` that stand for addresses of its own loopback.
    #[serde(default)]
    pub hosts: Vec<(IpAddr, String)>,
    /// Opaque configuration of the shim's resident (the ROS Master): initial parameters and the like.
    #[serde(default)]
    pub resident: serde_json::Value,
}

/// Privileges of a container.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Profile {
    /// Untrusted code for a robot: no capabilities, seccomp allow-list, read-only root, tmpfs scratch.
    Servant,
    /// Compiling untrusted code: as a servant, with a writable root, as uid 1000, without network.
    Compile,
    /// Installing packages (dpkg): CHOWN, DAC_OVERRIDE, FOWNER, FSETID, SETUID, SETGID, SETFCAP; without network.
    Install,
}

/// A bind mount.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Mount {
    /// Path on the host.
    pub source: PathBuf,
    /// Absolute path in the container.
    pub target: PathBuf,
    /// Writable for processes in the container.
    pub writable: bool,
    /// Allows access to a device node; in other mounts device nodes are disabled.
    #[serde(default)]
    pub device: bool,
    /// Open source of the mount, which is used whatever is at `source` by then; without it `source` is looked up when
    /// the servant is created.
    #[serde(skip)]
    pub opened: Option<OpenedSource>,
}

impl Mount {
    /// Returns whether the source is a directory.
    pub(crate) fn is_directory(&self) -> io::Result<bool> {
        let mode = match &self.opened {
            Some(opened) => nix::sys::stat::fstat(opened.as_fd())?.st_mode,
            None => return Ok(std::fs::metadata(&self.source)?.is_dir()),
        };
        Ok(mode & libc::S_IFMT == libc::S_IFDIR)
    }
}

/// An open file or directory (O_PATH is enough) to be mounted. Two are equal if they are the same descriptor.
#[derive(Debug, Clone)]
pub struct OpenedSource(Arc<OwnedFd>);

impl OpenedSource {
    /// Wraps the descriptor.
    pub fn new(descriptor: OwnedFd) -> Self {
        Self(Arc::new(descriptor))
    }
}

impl AsFd for OpenedSource {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

impl PartialEq for OpenedSource {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}
