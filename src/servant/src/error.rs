//! What can go wrong when servants are started, reached and ended.

use std::io;
use std::path::{Path, PathBuf};

/// Every error of this crate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file or directory could not be used.
    #[error("could not {action} {path}: {source}")]
    File {
        /// What was tried, as a verb.
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// Error of the system call.
        source: io::Error,
    },
    /// The kernel refused a call that names no file.
    #[error("{call} failed: {source}")]
    Call {
        /// The system call, and for what.
        call: &'static str,
        /// Error of the system call.
        source: io::Error,
    },
    /// The spec cannot be run as it is.
    #[error("servant {id}: {reason}")]
    InvalidSpec {
        /// The spec's id.
        id: String,
        /// What to change.
        reason: String,
    },
    /// A servant of this id is there already.
    #[error("servant {id} exists already: stop it first or choose another id")]
    Exists {
        /// The id.
        id: String,
    },
    /// It could not be started.
    #[error("servant {id} could not be started: {reason}")]
    Start {
        /// The id.
        id: String,
        /// What failed, in the words of whoever tried.
        reason: String,
    },
    /// Nothing answers for it any more.
    #[error("servant {id} has ended: {reason}")]
    Ended {
        /// The id.
        id: String,
        /// How, as far as known.
        reason: String,
    },
    /// Its shim refused a command.
    #[error("servant {id}: {reason}")]
    Refused {
        /// The id.
        id: String,
        /// Why it was refused.
        reason: String,
    },
    /// Its shim runs and does not answer.
    #[error(
        "servant {id}: its shim does not answer; look whether it is stopped or starved, or end the servant"
    )]
    Unanswered {
        /// The id.
        id: String,
    },
    /// There is no node of that name.
    #[error("servant {id} has no node {node}: see its nodes in its state")]
    NoNode {
        /// The servant.
        id: String,
        /// The name asked for.
        node: String,
    },
    /// Something stands among the servants' directories that is none.
    #[error("{} is no servant's directory and was left alone; move it away", path.display())]
    Stray {
        /// Path of the entry that is none of ours.
        path: PathBuf,
    },
    /// Something of a servant is left after its end.
    #[error("servant {id} left {what}: remove it by hand and report this")]
    LeftOver {
        /// The servant.
        id: String,
        /// What is left.
        what: String,
    },
    /// A limit could not be put in force although isolation is required.
    #[error(
        "this host does not enforce {missing} ({reason}): enable the controller, or set isolation = \"best-effort\""
    )]
    Isolation {
        /// Which limits.
        missing: String,
        /// Why, and with which cgroup version.
        reason: String,
    },
    /// A filesystem does not know idmapped mounts.
    #[error(
        "{path} is on {filesystem}, which cannot be mounted with shifted user ids ({source}): \
         put the layers on ext4, xfs or btrfs, or use a newer kernel"
    )]
    IdmapUnsupported {
        /// The layer.
        path: PathBuf,
        /// Type of the file system.
        filesystem: String,
        /// What the kernel said.
        source: io::Error,
    },
    /// No uid range is free.
    #[error(
        "all {ranges} user id ranges from {base} on are taken: stop servants or change uid_base"
    )]
    NoUidRange {
        /// First uid of the first range.
        base: u32,
        /// How many ranges there are.
        ranges: u32,
    },
    /// Something is asked for that is not granted.
    #[error(transparent)]
    Grant(#[from] crate::local::grants::GrantError),
    /// The layers of an image cannot be had.
    #[error("image {image} cannot be used: {source}")]
    Image {
        /// Its digest.
        image: String,
        /// What the image store said.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// Something that was written by another process is not what it should be.
    #[error("{path} holds something unexpected: {reason}")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// In which way it is malformed.
        reason: String,
    },
}

impl Error {
    /// Wraps an I/O error with what was tried on which path.
    pub(crate) fn file(
        action: &'static str,
        path: impl AsRef<Path>,
    ) -> impl FnOnce(io::Error) -> Self {
        let path = path.as_ref().to_path_buf();
        move |source| Self::File {
            action,
            path,
            source,
        }
    }

    /// Wraps the error of a system call without a path.
    pub(crate) fn call(call: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Call { call, source }
    }

    /// The same for nix's errors.
    pub(crate) fn nix(call: &'static str) -> impl FnOnce(nix::Error) -> Self {
        move |source| Self::Call {
            call,
            source: source.into(),
        }
    }
}
