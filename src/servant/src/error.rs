//! Errors of starting, reaching and ending servants.

use std::io;
use std::path::{Path, PathBuf};

/// An error of this crate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file operation failed.
    #[error("could not {action} {path}: {source}")]
    File {
        /// Operation that failed, as a verb.
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// Error of the system call.
        source: io::Error,
    },
    /// A system call without a path failed.
    #[error("{call} failed: {source}")]
    Call {
        /// The system call and its purpose.
        call: &'static str,
        /// Error of the system call.
        source: io::Error,
    },
    /// The spec is invalid.
    #[error("servant {id}: {reason}")]
    InvalidSpec {
        /// Id of the spec.
        id: String,
        /// Description of the fault.
        reason: String,
    },
    /// A servant with this id exists already.
    #[error("servant {id} exists already: stop it first or choose another id")]
    Exists {
        /// The id.
        id: String,
    },
    /// The servant could not be started.
    #[error("servant {id} could not be started: {reason}")]
    Start {
        /// The id.
        id: String,
        /// Reason, as reported by the step that failed.
        reason: String,
    },
    /// The servant has ended.
    #[error("servant {id} has ended: {reason}")]
    Ended {
        /// The id.
        id: String,
        /// Reason, as far as known.
        reason: String,
    },
    /// The shim refused a command.
    #[error("servant {id}: {reason}")]
    Refused {
        /// The id.
        id: String,
        /// Reason of the refusal.
        reason: String,
    },
    /// The shim runs but does not answer.
    #[error("servant {id}: its shim does not answer; check whether it is stopped or starved, or stop the servant")]
    Unanswered {
        /// The id.
        id: String,
    },
    /// There is no node of that name.
    #[error("servant {id} has no node {node}: see its nodes in its state")]
    NoNode {
        /// Id of the servant.
        id: String,
        /// Name that was asked for.
        node: String,
    },
    /// An entry among the servants' directories is not one of them.
    #[error("{} is not a servant's directory and was left untouched; move it elsewhere", path.display())]
    Stray {
        /// Path of the unknown entry.
        path: PathBuf,
    },
    /// Something is left of a servant after its end.
    #[error("servant {id} left {what}: remove it by hand and report this")]
    LeftOver {
        /// Id of the servant.
        id: String,
        /// Description of what is left.
        what: String,
    },
    /// A limit could not be put in force although isolation is required.
    #[error(
        "this host does not enforce {missing} ({reason}): enable the controller, or set isolation = \"best-effort\""
    )]
    Isolation {
        /// Names of the limits.
        missing: String,
        /// Reason, with the cgroup version.
        reason: String,
    },
    /// A file system does not support idmapped mounts.
    #[error(
        "{path} is on {filesystem}, which cannot be mounted with shifted user ids ({source}): \
         put the layers on ext4, xfs or btrfs, or use a newer kernel"
    )]
    IdmapUnsupported {
        /// Path of the layer.
        path: PathBuf,
        /// Type of the file system.
        filesystem: String,
        /// Error of the kernel.
        source: io::Error,
    },
    /// All uid ranges are taken.
    #[error("all {ranges} user id ranges from {base} on are taken: stop servants or change uid_base")]
    NoUidRange {
        /// First uid of the first range.
        base: u32,
        /// Number of ranges.
        ranges: u32,
    },
    /// Something that is not granted was asked for.
    #[error(transparent)]
    Grant(#[from] crate::grant_error::GrantError),
    /// The layers of an image are not available.
    #[error("image {image} cannot be used: {source}")]
    Image {
        /// Digest of the image.
        image: String,
        /// Error of the image store.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A record of another process is malformed.
    #[error("{path} has unexpected content: {reason}")]
    Malformed {
        /// Path of the record.
        path: PathBuf,
        /// Description of the fault.
        reason: String,
    },
}

impl Error {
    /// Wraps an I/O error with the operation and the path.
    pub(crate) fn file(action: &'static str, path: impl AsRef<Path>) -> impl FnOnce(io::Error) -> Self {
        let path = path.as_ref().to_path_buf();
        move |source| Self::File { action, path, source }
    }

    /// Wraps the error of a system call without a path.
    pub(crate) fn call(call: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Call { call, source }
    }

    /// Wraps a nix error of a system call without a path.
    pub(crate) fn nix(call: &'static str) -> impl FnOnce(nix::Error) -> Self {
        move |source| Self::Call { call, source: source.into() }
    }
}
